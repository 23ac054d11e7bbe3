"""The wheel stands alone: these tests pass in an environment that has no torch and no SB3."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
PROJECT = HERE.parents[1] / "wrappers"


@pytest.mark.packaging
@pytest.mark.timeout(900)
@pytest.mark.skipif(not (PROJECT / "setup.cfg").is_file(), reason="runs in the repository only")
def test_the_wheel_alone(tmp_path: Path) -> None:
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "PYTEST"))}

    def run(*command: str | Path) -> str:
        done = subprocess.run(
            [str(part) for part in command],
            cwd=tmp_path,
            env=clean,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout
        return done.stdout

    run(sys.executable, "-m", "venv", tmp_path / "venv")
    python = tmp_path / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
    # A copy: building in place leaves a folder that the next wheel would take up.
    built = shutil.ignore_patterns("build", "*.egg-info", "__pycache__")
    shutil.copytree(PROJECT, tmp_path / "project", ignore=built)
    run(python, "-m", "pip", "wheel", "-q", "--no-deps", "-w", tmp_path, tmp_path / "project")
    (wheel,) = tmp_path.glob("regil_wrappers-*.whl")
    inside = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0].split("-")[0] for name in inside} == {"regil_wrappers"}
    assert "regil_wrappers/py.typed" in inside
    assert any(name.endswith("LICENSE") for name in inside)

    run(python, "-m", "pip", "install", "-q", f"{wheel}[tests]")
    for absent in ("torch", "stable_baselines3", "timm"):
        code = f"import importlib.util as u, sys; sys.exit(u.find_spec({absent!r}) is not None)"
        run(python, "-c", code)
    report = run(
        *(python, "-m", "pytest", "-q", "-W", "error", "-m", "not packaging and not slow"),
        # The repository's own configuration asks for plugins that this environment lacks.
        *(
            "-c",
            os.devnull,
            "--rootdir",
            HERE,
            "-o",
            "markers=packaging: a wheel\nslow: minutes of work\ntimeout: seconds",
        ),
        *("-p", "no:cacheprovider", HERE),
    )
    assert " passed" in report
    assert "failed" not in report
