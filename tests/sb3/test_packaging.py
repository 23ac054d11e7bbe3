"""Versions in lockstep; what is built is reproducible, complete, and works by itself."""

import ast
import configparser
import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from collections.abc import Iterator
from email import message_from_bytes
from importlib.metadata import distribution, requires, version
from importlib.resources import files
from pathlib import Path

import pytest
import regil_wrappers
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import regil_sb3
from regil_sb3.bench.peers import LIBROSA_ON_COSTS, PEERS

ROOT = Path(__file__).parents[2]

# Import names of distributions that are not here, or here as a checkout: no list of files tells
IMPORTED_AS = {
    "franky-control": {"franky"},
    "pyrealsense2": {"pyrealsense2"},
    "regil-sb3": {"regil_sb3"},
    "regil-wrappers": {"regil_wrappers"},
}
# Modules that are for one extra alone import it at once; nothing else imports them
OF_AN_EXTRA = {"regil_sb3/zoo.py": "zoo", "regil_sb3/bench/hostile.py": "bench"}
# Installed with --no-deps (docs/libero.md, docs/robosuite.md), so of no extra
BY_HAND = {"libero", "robosuite"}
# Of regil-wrappers alone: what comes with another package, and is used only together with it
FROM = {"huggingface_hub": "timm"}

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


def _imports(node: ast.AST, lazy: bool = False) -> Iterator[tuple[str, bool, str | None]]:
    """Of each import: the package, whether it waits for a call, and the extra that it names."""
    for child in ast.iter_child_nodes(node):
        match child:
            case ast.Import(names=names):
                found = [(alias.name, None) for alias in names]
            case ast.ImportFrom(module=str(module), level=0):
                found = [(module, None)]
            case ast.Call(
                func=ast.Name(id="need"),
                args=[ast.Constant(value=str(module)), ast.Constant(value=str(extra)), *_],
            ):
                found = [(module, extra)]
            case ast.Call(
                func=ast.Name(id="import_module" | "find_spec")
                | ast.Attribute(attr="import_module" | "find_spec"),
                args=[ast.Constant(value=str(module)), *_],
            ):
                found = [(module, None)]
            case _:
                found = []
        for module, extra in found:
            yield module.partition(".")[0], lazy, extra
        waits = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) or (
            isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING"
        )
        yield from _imports(child, lazy or waits)


def _brought(wanted: dict[str, list[Requirement]], name: str, extra: str = "") -> set[str]:
    """Import names of what a distribution asks for itself: without an extra, or by that alone."""
    out = set()
    for requirement in wanted[name]:
        marker = requirement.marker
        asks, always = (marker is None or marker.evaluate({"extra": e}) for e in (extra, ""))
        if asks and always == (not extra):
            asked = canonicalize_name(requirement.name)
            if asked in wanted and requirement.extras:
                out |= set().union(*(_brought(wanted, asked, e) for e in requirement.extras))
            elif asked in IMPORTED_AS:
                out |= IMPORTED_AS[asked]
            else:
                out |= {file.parts[0].partition(".")[0] for file in distribution(asked).files}
    return out - {""}


def test_what_is_imported_is_asked_for(dist):
    """By the wheel itself, not only by what it depends on; what waits for a call, by an extra."""
    wanted, sources = {}, {}
    for wheel in dist.glob("*.whl"):
        with zipfile.ZipFile(wheel) as archive:
            inside = {name: archive.read(name) for name in archive.namelist()}
        name = canonicalize_name(wheel.name.partition("-")[0])
        (said,) = [text for path, text in inside.items() if path.endswith("/METADATA")]
        lines = message_from_bytes(said).get_all("Requires-Dist")
        wanted[name] = [Requirement(line) for line in lines]
        sources[name] = {p: ast.parse(text) for p, text in inside.items() if p.endswith(".py")}

    extras = {
        name: {extra: _brought(wanted, name, extra) for extra in _extras(of) - {"docs", "tests"}}
        for name, of in wanted.items()
    }
    wrappers, sb3 = "regil-wrappers", "regil-sb3"
    peers = {peer.module.partition(".")[0] for peer in (*PEERS, LIBROSA_ON_COSTS)}
    assert peers <= extras[sb3]["bench"]
    for package, of in FROM.items():
        assert package in {Requirement(line).name for line in requires(of)}
    some = {name: set().union(*extras[wrappers].values()) for name in wanted}
    some[wrappers] |= FROM.keys()
    some[sb3] |= BY_HAND.union(*extras[sb3].values())
    missing, tried = {}, set()
    for name, modules in sources.items():
        base = _brought(wanted, name) | IMPORTED_AS[name] | sys.stdlib_module_names
        for path, module in modules.items():
            at_once = extras[name].get(OF_AN_EXTRA.get(path, ""), set())
            for package, lazy, extra in _imports(module):
                also = extras[wrappers][extra] if extra else some[name] if lazy else at_once
                if package not in base | also:
                    missing.setdefault((name, package), path)
                tried.add((package, lazy))
    assert missing == {}
    assert {("numpy", False), ("rl_zoo3", False), ("av", True), ("metaworld", True)} <= tried


def _extras(requirements: list[Requirement]) -> set[str]:
    return set(re.findall(r'extra == "(\w+)"', " ".join(map(str, requirements))))


def test_what_is_for_an_extra_is_not_imported_without_it():
    code = "import sys, regil_sb3.cli, regil_sb3.training, regil_wrappers; "
    code += "from regil_sb3 import *; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert {"regil_sb3.td3bc", "regil_sb3.report", "regil_wrappers.wrappers"} <= loaded
    of_extras = {path.removesuffix(".py").replace("/", ".") for path in OF_AN_EXTRA}
    lazy = {"metaworld", "mujoco", "timm", "faiss", "av", "pyarrow", "ray", "rl_zoo3", "pygame"}
    assert not loaded & (of_extras | lazy)


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
