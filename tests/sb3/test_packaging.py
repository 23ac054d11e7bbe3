"""Versions in lockstep; what is built is reproducible, complete, and works by itself."""

import configparser
import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path

import pytest
import regil_wrappers
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

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


def test_the_oldest_versions_that_are_tested_are_those_allowed():
    text = (ROOT / "constraints-oldest.txt").read_text("utf-8")
    pins = {canonicalize_name(n): Version(v) for n, v in re.findall(r"^(\S+)==(\S+)", text, re.M)}
    tried = 0
    for name in ("setup.cfg", "wrappers/setup.cfg"):
        setup = _setup(ROOT / name)
        runs = [setup["options"]["install_requires"]]
        extras = setup["options.extras_require"]
        runs += [wanted for extra, wanted in extras.items() if extra not in ("docs", "tests")]
        for requirement in map(Requirement, filter(None, "\n".join(runs).split("\n"))):
            for bound in requirement.specifier:
                if bound.operator == ">=":
                    allowed = Version(bound.version).release
                    tested = pins.get(canonicalize_name(requirement.name), Version("0")).release
                    assert tested[: len(allowed)] == allowed, f"pin the oldest {requirement}"
                    tried += 1
    assert tried > 30


def test_zoo_configs_are_found_where_the_package_is_installed():
    names = {path.name for path in files("regil_sb3.zoo_configs").iterdir()}
    assert "td3bc.yml" in names


@pytest.fixture(scope="module")
def dist(tmp_path_factory):
    """Wheels and sdists of both, as they would be released."""
    out = tmp_path_factory.mktemp("dist")
    _build(out)
    return out


def _build(out: Path) -> None:
    script = ROOT / ".ci/dist.py"
    done = subprocess.run(
        [sys.executable, script, out], capture_output=True, text=True, check=False, cwd=out
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("PASSED") == 4  # by twine


def _inside(path: Path) -> set[str]:
    if path.suffix == ".whl":
        with zipfile.ZipFile(path) as archive:
            return set(archive.namelist())
    with tarfile.open(path) as archive:
        top = path.name.removesuffix(".tar.gz") + "/"
        return {member.name.removeprefix(top) for member in archive if member.isfile()}


def test_two_builds_are_the_same_to_the_bit(dist, tmp_path):
    _build(tmp_path)
    names = sorted(path.name for path in dist.iterdir())
    assert names == sorted(
        f"{name}-{regil_sb3.__version__}{suffix}"
        for name in ("regil_sb3", "regil_wrappers")
        for suffix in (".tar.gz", "-py3-none-any.whl")
    )
    for name in names:
        assert (dist / name).read_bytes() == (tmp_path / name).read_bytes(), name


def test_distributions_hold_the_data_files_and_no_tests(dist):
    configs = {f"zoo_configs/{path.name}" for path in (ROOT / "zoo_configs").glob("*.yml")}
    for path in dist.glob("regil_sb3*"):
        wheel = path.suffix == ".whl"
        names = _inside(path)
        assert names >= {
            "regil_sb3/py.typed",
            "regil_sb3/report/page.html",
            "regil_sb3/report/run_page.py",
            "regil_sb3/envs/__init__.py",
            *(f"regil_sb3/{name}" if wheel else name for name in configs),
        }
        roots = {name.split("/")[0] for name in names}
        if wheel:
            assert roots == {"regil_sb3", f"regil_sb3-{regil_sb3.__version__}.dist-info"}
        assert not roots & {"tests", "wrappers", "custom_envs.py"}
        assert any(name.endswith("LICENSE") for name in names)
    for path in dist.glob("regil_wrappers*"):
        assert "regil_wrappers/py.typed" in _inside(path)
        assert any(name.endswith("LICENSE") for name in _inside(path))


@pytest.mark.timeout(600)
def test_installed_outside_the_repository_it_trains(dist, tmp_path):
    """What both depend on is this environment's; they themselves come from their wheels alone."""
    venv = tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", venv], check=True)
    python = next(venv.glob("[bS]*/python*"))
    paths = sysconfig.get_paths(vars={"base": str(venv), "platbase": str(venv)})
    # The folder is put on the path, and the .pth files inside, the checkout's own, are not read
    (Path(paths["purelib"]) / "needed.pth").write_text(sysconfig.get_paths()["purelib"])
    here = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "PYTEST"))}

    def run(*words: str | Path) -> str:
        done = subprocess.run(
            [python, *words], cwd=tmp_path, env=here, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    wheels = sorted(dist.glob("*.whl"))
    subprocess.run(
        [sys.executable, "-m", "pip", "-q", "--python", python, "install", "--no-deps", *wheels],
        check=True,
        env=here,
    )
    code = "import regil_sb3, regil_wrappers as w; print(regil_sb3.__file__, w.__file__, sep='\\n')"
    for where in run("-c", code).splitlines():
        assert Path(where).is_relative_to(venv)
    words = ["train", "--preset", "quick", "--env", "regil/metaworld-button-press-v0"]
    words += ["--steps", "140", "--episodes", "1", "--out", "run"]
    short = {"warmup_steps": 130, "bc_pretrain_steps": 2, "buffer_size": 300, "eval_episodes": 1}
    for key, value in short.items():
        words += ["--set", f"{key}={value}"]
    tiny = "import regil_sb3.training as t; t.BC_UPDATES = 2; from regil_sb3.cli import main; "
    run("-c", f"{tiny}import sys; sys.exit(main({words}))")
    assert (tmp_path / "run/report.html").stat().st_size > 0
    assert (tmp_path / "run/README.md").stat().st_size > 0
    assert "regil record" in run("-m", "regil_sb3.cli", "record", "--help")
