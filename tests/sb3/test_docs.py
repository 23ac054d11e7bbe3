"""The documentation: it builds, its Python runs, its commands parse, its tables are the code's."""

from __future__ import annotations

import ast
import configparser
import csv
import fnmatch
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from regil_wrappers import make_encoder
from regil_wrappers.encoders import cache, encoder_names, registry
from regil_wrappers.encoders.timm_networks import import_timm

from regil_sb3.cli import _parser, main
from regil_sb3.settings import make_settings

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = {
    str(page.relative_to(ROOT)): page.read_text(encoding="utf-8")
    for page in sorted([*ROOT.glob("*.md"), ROOT / "wrappers/README.md", *DOCS.glob("*.md")])
}
ENV = "regil/metaworld-button-press-v0"

# Numbers that are too long for a test: at most so many there
SHORTER = {"learn(": 40, "warmup_steps=": 20, "bc_pretrain_steps=": 2, "buffer_size=": 500}
LONG = re.compile(rf"\b({'|'.join(map(re.escape, SHORTER))})(\d[\d_]*)")
# What runs, in order: Python that a reader sees, and what it stands on ("hidden", a comment)
PYTHON = re.compile(r"^(?:<!-- hidden\n(.*?)^-->$|```python\n(.*?)^```$)", re.DOTALL | re.MULTILINE)
NEEDS = re.compile(r"<!-- needs (\w+) -->")  # a package that tests may lack: skipped without it


def shortened(code: str) -> str:
    return LONG.sub(lambda m: m[1] + str(min(int(m[2]), SHORTER[m[1]])), code)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("recorded") / "demo.hdf5"
    assert main(["record", ENV, "-o", str(path)]) == 0
    return path


@pytest.fixture
def fresh(monkeypatch, tmp_path):
    """A folder of one's own; nothing cached, registered or left behind."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(registry, "_factories", dict(registry._factories))
    monkeypatch.setattr(cache, "_cache", type(cache._cache)())
    make_encoder.cache_clear()
    known = dict(gym.registry)
    yield
    make_encoder.cache_clear()
    gym.registry.clear()
    gym.registry.update(known)


# SB3's progress bar is tqdm's rich one, which calls itself experimental
@pytest.mark.filterwarnings("ignore::tqdm.TqdmExperimentalWarning")
@pytest.mark.usefixtures("fresh")
@pytest.mark.parametrize("page", [name for name, text in PAGES.items() if "```python" in text])
def test_every_python_block_runs_in_order(page, recorded, toy_run):
    for module in NEEDS.findall(PAGES[page]):
        pytest.importorskip(module)
    Path("demos").mkdir()
    shutil.copy(recorded, f"demos/{ENV.rpartition('/')[2]}.hdf5")
    shutil.copytree(toy_run, "runs/first")
    blocks = PYTHON.findall(PAGES[page])
    assert sum(bool(seen) for _, seen in blocks) == PAGES[page].count("```python")
    names: dict[str, object] = {"__name__": page}
    for hidden, seen in blocks:
        exec(compile(shortened(hidden or seen), page, "exec"), names)


def test_what_is_shortened():
    assert shortened("learn(15_000, progress_bar=True)") == "learn(40, progress_bar=True)"
    assert shortened("success_buffer_size=5_000, buffer_size=1") == (
        "success_buffer_size=5_000, buffer_size=1"
    )


def commands() -> list[tuple[str, str]]:
    """Shell commands of all pages, (page, command): of `sh` blocks and of indented ones."""
    found = []
    for page, text in PAGES.items():
        blocks = re.findall(r"^```sh\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
        blocks += re.findall(
            r"^ {4}\S.*$", re.sub(r"^```.*?^```", "", text, flags=re.S | re.M), re.M
        )
        for line in "\n".join(blocks).replace("\\\n", " ").splitlines():
            found.append((page, re.sub(r"\$\w+", "0", line.strip())))
    return found


@pytest.mark.parametrize(
    ("page", "command"), [c for c in commands() if c[1].startswith("regil ") and "[" not in c[1]]
)
def test_every_regil_command_is_one(page, command):
    words = shlex.split(command, comments=True)[1:]
    args = _parser().parse_args(words)  # exits where it does not parse
    if args.command == "train" and args.env in gym.registry:
        make_settings(args.env, args.preset, args.seed, args.steps, args.set)


def test_other_commands_name_what_is_there():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    extras = {name: set(_extras(name)) for name in ("setup.cfg", "wrappers/setup.cfg")}
    tried = 0
    for page, command in commands():
        words = shlex.split(command, comments=True)
        if words[:1] == ["make"]:
            targets = [word for word in words[1:] if "=" not in word]
            assert all(f"\n{target}:" in makefile for target in targets), (page, command)
        elif words[:2] == ["pip", "install"]:
            for where, wanted in re.findall(r"(\S*)\[([\w,]+)\]", " ".join(words)):
                setup = "wrappers/setup.cfg" if "wrappers" in where else "setup.cfg"
                assert set(wanted.split(",")) <= extras[setup], (page, command)
        elif words[:1] == ["python"] and words[1].endswith(".py"):
            assert (ROOT / words[1]).is_file(), (page, command)
        else:
            continue
        tried += 1
    assert tried > 5


def _extras(setup: str) -> list[str]:
    parser = configparser.ConfigParser()
    parser.read_string((ROOT / setup).read_text(encoding="utf-8"))
    return list(parser["options.extras_require"])


def test_links_lead_somewhere():
    """Sphinx checks those between the pages of docs/, with their headings; here all files."""
    tried = 0
    for page, text in PAGES.items():
        for target in re.findall(r"\]\(([^)\s]+)\)", text):
            if target.startswith(("http:", "https:", "#")):
                continue
            assert ((ROOT / page).parent / target.partition("#")[0]).exists(), (page, target)
            tried += 1
    assert tried > 50


@pytest.mark.skipif(np.__version__.startswith("1."), reason="numpy 1 calls its types otherwise")
def test_sphinx_builds_without_a_warning(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", DOCS, tmp_path],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr  # a page without a toctree: name it in index.md
    pages = list(tmp_path.glob("*.html"))
    assert len(pages) > len(list(DOCS.glob("*.md")))
    loaded = re.compile(r"""<(?:script|img|link)\b[^>]*(?:src|href)="(?:https?:)?//[^"]*""")
    for page in pages:
        assert not loaded.findall(page.read_text(encoding="utf-8")), page.name


def rows(page: str) -> list[list[str]]:
    """The cells of each line of a page's tables."""
    lines = re.findall(r"^\| (.*) \|$", PAGES[page], re.MULTILINE)
    return [re.split(r" *(?<!\\)\| *", line) for line in lines]


def test_the_table_of_extras():
    listed: dict[str, set[str]] = {}
    of = ""
    for first, second, *_ in (row for row in rows("docs/install.md") if len(row) == 3):
        of = first or of
        listed.setdefault(of, set()).update(re.findall(r"`(\w+)`", second))
    assert listed["`regil-sb3`"] == set(_extras("setup.cfg"))
    assert listed["`regil-wrappers`"] == set(_extras("wrappers/setup.cfg"))


def test_the_tables_of_curves_and_files(toy_run):
    with (toy_run / "progress.csv").open(newline="") as file:
        logged = set(next(csv.reader(file)))
    listed = {name for row in rows("docs/curves.md") for name in re.findall(r"`(\w+/\w+)`", row[0])}
    assert listed == logged
    named = {
        pattern for row in rows("docs/start.md") for pattern in re.findall(r"`([\w.*]+)`", row[0])
    }
    files = {path.name for path in toy_run.iterdir()}
    present = {pattern for pattern in named if fnmatch.filter(files, pattern)}
    assert named - present == {"calibration.json"}  # of a guide that corrects itself
    assert all(any(fnmatch.fnmatch(file, pattern) for pattern in named) for file in files)


def test_troubles_are_the_programs_own_words():
    said = []
    for module in [*(ROOT / "regil_sb3").rglob("*.py"), *(ROOT / "wrappers").rglob("*.py")]:
        for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = [v.value if isinstance(v, ast.Constant) else "\0" for v in node.values]
                said.append("".join(map(str, parts)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                said.append(node.value)
    tried = 0
    for cell, *_ in rows("docs/troubles.md"):
        for words in re.findall(r'"([^"]+)"', cell):
            parts = [re.escape(part.strip()) for part in words.split("...")]
            assert any(re.search(".*".join(parts), text, re.DOTALL) for text in said), words
            tried += 1
    assert tried > 5


def test_the_readme_names_every_command():
    (subcommands,) = (a.choices for a in _parser()._subparsers._group_actions)
    assert set(re.findall(r"^\| `regil (\w+)", PAGES["README.md"], re.M)) == set(subcommands)


def test_the_table_of_encoders():
    timm = import_timm()
    row = re.compile(r"\| (`[^|]+`) \| `([^`]+)` \| ([\d.]+) \| (\d+) \| (\d+) \| ([\dx ]+) \|")
    listed = {}
    for names, *rest in row.findall(PAGES["docs/encoders.md"]):
        listed |= dict.fromkeys(re.findall(r"`([^`]+)`", names), rest)
    named = {name for name in encoder_names() if "<" not in name}
    assert listed.keys() == named - {"pixels"}
    for name, (model, millions, size, pooled, patches) in listed.items():
        if name in registry._TIMM_NAMES:
            made_from, fixed = registry._TIMM_NAMES[name]
            assert model == made_from
        else:
            fixed = {}
        with th.device("meta"):
            network = timm.create_model(model, pretrained=False)
        config = timm.get_pretrained_cfg(model)
        weights = sum(p.numel() for p in network.parameters())
        assert f"{weights / 1e6:.1f}" == millions, name
        assert fixed.get("size", config.input_size[-1]) == int(size), name
        dimension = network.num_classes if fixed.get("projection") else network.num_features
        assert dimension == int(pooled), name
        stride = network.feature_info[-1]["reduction"]
        high, wide, deep = map(int, patches.split(" x "))
        assert (high, wide) == (int(size) // stride,) * 2, name
        assert deep == network.num_features, name
