"""Versions in lockstep, and what the wheel of regil-sb3 carries."""

import configparser
import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path

import pytest
import regil_wrappers

import regil_sb3

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.packaging


def _setup(path: Path) -> configparser.ConfigParser:
    parser = configparser.ConfigParser()
    parser.read_string(path.read_text("utf-8"))
    return parser


def test_both_distributions_have_one_version():
    declared = {
        _setup(ROOT / name)["metadata"]["version"] for name in ("setup.cfg", "wrappers/setup.cfg")
    }
    modules = {regil_sb3.__version__, regil_wrappers.__version__}
    installed = {version("regil-sb3"), version("regil-wrappers")}
    assert declared == modules == installed
    assert len(declared) == 1


def test_regil_sb3_pins_regil_wrappers_to_its_own_version():
    setup = _setup(ROOT / "setup.cfg")
    wanted = [line for line in setup["options"]["install_requires"].split("\n") if "regil-" in line]
    assert [line.replace(" ", "") for line in wanted] == [
        f"regil-wrappers=={regil_sb3.__version__}"
    ]


def test_zoo_configs_are_found_where_the_package_is_installed():
    names = {path.name for path in files("regil_sb3.zoo_configs").iterdir()}
    assert "td3bc.yml" in names


def test_wheel_holds_the_data_files_and_no_tests(tmp_path):
    # A copy, so that a build folder left in the checkout cannot add files to the wheel.
    source = tmp_path / "source"
    shutil.copytree(
        ROOT,
        source,
        ignore=shutil.ignore_patterns(".*", "runs", "demos", "build", "dist", "*.egg-info"),
    )
    (source / "custom_envs.py").touch()
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--outdir", str(tmp_path), str(source)],
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert names >= {
        "regil_sb3/py.typed",
        "regil_sb3/report.html",
        "regil_sb3/report.py",
        "regil_sb3/envs/__init__.py",
        *(f"regil_sb3/zoo_configs/{path.name}" for path in (ROOT / "zoo_configs").glob("*.yml")),
    }
    roots = {name.split("/")[0] for name in names}
    assert roots == {"regil_sb3", f"regil_sb3-{regil_sb3.__version__}.dist-info"}
    assert any(name.endswith("licenses/LICENSE") for name in names)
