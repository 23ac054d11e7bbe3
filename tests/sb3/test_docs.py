"""The documentation: it builds, its Python and its commands run, its tables are the code's."""

from __future__ import annotations

import ast
import configparser
import csv
import doctest
import fnmatch
import importlib
import inspect
import re
import shlex
import shutil
import subprocess
import sys
from glob import glob
from pathlib import Path

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import pytest
import torch as th
from matplotlib import pyplot as plt
from regil_wrappers import (
    Demonstration,
    RetrievalGuideWrapper,
    RetrievalRewardWrapper,
    formats,
    make_encoder,
)
from regil_wrappers.encoders import cache, encoder_names, registry
from regil_wrappers.encoders.timm_networks import import_timm

from regil_sb3 import recording, training, zoo
from regil_sb3.bench import costs, throughput
from regil_sb3.bench.replay import check
from regil_sb3.checkpoint import ReplayableEpisode
from regil_sb3.cli import _parser, main
from regil_sb3.settings import ALGOS, make_settings

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


# What a reader sees as shell: `sh` blocks, and indented lines outside of other blocks and comments
SHELL = re.compile(
    r"^```(\w*)[^\n]*\n(.*?)^```$|<!--.*?-->|^ {4}((?:regil|python|pip|for) [^\n]*)$",
    re.DOTALL | re.MULTILINE,
)


def shell_blocks(page: str) -> list[str]:
    found = [m[2] if m[1] == "sh" else m[3] for m in SHELL.finditer(PAGES[page])]
    return [re.sub(r"\\\n\s*", "", block) for block in found if block]


def commands(page: str) -> list[str]:
    """A page's commands in order, but for scripts; of a loop those of its first turn."""
    found = []
    for block in shell_blocks(page):
        if block.startswith("#!"):
            continue
        turn = dict(re.findall(r"\bfor (\w+) in (\S+)", block))
        code = re.sub(r"(?m)(^|\s)#.*$|\bfor \w+ in [^;\n]*; *do\b|\bdone\b", "\n", block)
        code = re.sub(r" \.\.\.(?=\s|$)", "", code)
        code = re.sub(r"\$(\w+)", lambda m, turn=turn: turn[m[1]], code)
        found += [line.strip() for line in re.split(r"[;\n]", code) if line.strip()]
    return found


COMMANDS = [(page, command) for page in PAGES for command in commands(page)]


@pytest.mark.parametrize(
    ("page", "command"), [c for c in COMMANDS if c[1].startswith("regil ") and "[" not in c[1]]
)
def test_every_regil_command_is_one(page, command):
    """As it stands, with all its tasks and steps; below it runs with fewer."""
    args = _parser().parse_args(shlex.split(command)[1:])  # exits where it does not parse
    if args.command == "train" and args.env in gym.registry:
        make_settings(args.env, args.preset, args.seed, args.steps, args.set)
    if args.command == "bench" and args.table != "real-time":
        check(args.tasks or (), args.seeds or ())


# Commands that do not run here, and why
NOT_RUN = {
    r"make |\.ci/run": "makes or tests everything",
    r"(sudo|pip|hf) ": "installs, or needs the network",
    r"python docs/": "measures or draws for minutes to hours; that the script is there is tested",
    r"regil push ": "uploads: test_model_card.py has a stand-in for the hub",
    r"regil convert IN OUT ": "a synopsis; test_convert.py",
    r"regil record \S+ --teleop": "needs a window and a hand: test_teleoperation.py",
    r"regil train --preset paper ": "needs DINOv3's weights, a download: test_paper.py",
    r"regil bench ranking": "no option makes it short: test_bench_ranking.py",
    r"regil bench faults --kills": "kills a run again and again: test_bench_faults.py",
}
# Tables that say what they would do (--dry-run), and why
DRY = {
    "ablations": "each cell is a training run in a process of its own: test_runs.py makes some",
    "baselines": "likewise",
    "rewards": "likewise",
    "tuning": "likewise",
    "real-time": "at least 1,000 steps by the wall clock, twice: test_bench_real_time.py",
}
# Options that make a command small; argparse takes the last
FEW = {"tasks": "button-press", "seeds": "0", "episodes": "1", "steps": "20", "encoders": "pixels",
       "disturbances": "none"}  # fmt: skip
SMALL = {
    "guide": ["tasks", "seeds", "episodes", "disturbances"],
    "success-buffer": ["tasks", "seeds", "steps"],
    "sensitivity": ["tasks", "seeds", "episodes", "encoders"],
    "trajectories": ["episodes"],
    "latency": ["encoders"],
}
ALSO = {
    "latency": ["--frames", "20"],
    "memory": ["--frames", "200", "400", "--dims", "8"],
    "index": ["--frames", "300", "--dims", "8"],
    "faults": ["--numbers", "2"],
}
TRAIN = {"warmup_steps": 20, "bc_pretrain_steps": 2, "buffer_size": 500, "learning_starts": 10,
         "batch_size": 8, "eval_episodes": 1}  # fmt: skip
ZOO_ALSO = {
    "train": [
        "-n",
        "36",
        "--eval-freq",
        "30",
        "--eval-episodes",
        "1",
        "--n-trials",
        "1",
        "--n-evaluations",
        "1",
        "--env-kwargs",
        "max_steps:12",
        "-params",
        "learning_starts:10",
        "batch_size:8",
    ],
    "enjoy": ["-n", "10"],
    "record_video": ["-n", "10"],
    "plot": ["-w", "1"],
}
# Of docs/robot.md, in place of hardware: a simulated robot, and one alone
MY_ROBOT = """
import gymnasium
from regil_sb3.envs.rehearsal import RehearsalEnv

def make(**ignored):
    env = RehearsalEnv("reach", max_steps=60)
    env.metadata["regil"]["exists_once"] = True
    return env

gymnasium.register("my/reach-v0", make)
"""
STEPS = 12  # of an episode
STEPS_OF_DOCTOR = 50  # a guided success takes about 40
# What a page's words in capitals stand for
STAND_FOR = {
    "docs/doctor.md": {"ENV": ENV, "DEMO": "demos/mine.hdf5"},
    "docs/libero.md": {"FILE": "theirs.hdf5"},
    "docs/report.md": {"RUN": "runs/first", "FILE": "comparison.html"},
    "docs/resume.md": {"RUN": "runs/stopped"},
}


def smaller(words: list[str]) -> list[str]:
    """A `regil` command's words with more behind them, so that it takes seconds."""
    args = _parser().parse_args(words)
    if args.command == "train" and args.resume is None:
        settings = make_settings(args.env, args.preset, overrides=args.set, algo=args.algo)
        known = {*inspect.signature(ALGOS[settings.algo]).parameters, "eval_episodes"}
        sets = [f"--set={name}={value}" for name, value in TRAIN.items() if name in known]
        own = [] if args.out else ["--out", f"runs/{len(list(Path('runs').iterdir()))}"]
        return [*words, "--steps", "22", "--episodes", "1", *sets, *own]
    if args.command == "doctor" and args.search is not None:
        words = [*words, "--search", "pixels"]
    if args.command in ("train", "evaluate", "doctor"):
        return [*words, "--episodes", "1"]
    if args.command == "bench" and args.table in DRY:
        return [*words, "--dry-run"]
    if args.command == "bench":
        for name in SMALL.get(args.table, ()):
            given = getattr(args, name)
            first = given[0] if isinstance(given, list) and name != "encoders" else FEW[name]
            words = [*words, f"--{name}", str(first)]
        return [*words, *ALSO.get(args.table, ())]
    return words


@pytest.fixture(scope="module")
def trained(recorded, tmp_path_factory):
    """A run of the command line's on button-press."""
    run = tmp_path_factory.mktemp("trained") / "run"
    words = ["train", "--env", ENV, "--demo", str(recorded), "--out", str(run)]
    with pytest.MonkeyPatch.context() as patch:
        limit_episodes(patch)
        assert main([*smaller(words), "--steps", "80"]) == 0  # its log reaches the warm-up's end
    return run


def limit_episodes(patch: pytest.MonkeyPatch, steps: int = STEPS) -> None:
    """Episodes of our environments end after so many steps, but for recorded ones."""
    make = gym.make

    def limited(name, **kwargs):
        if isinstance(name, str) and name.startswith("regil/"):
            kwargs["max_steps"] = min(steps, kwargs.get("max_steps", steps))
        return make(name, **kwargs)

    patch.setattr(gym, "make", limited)
    patch.setattr(recording, "make_env", lambda name, kwargs: make(name, **(kwargs or {})))
    patch.setattr(training, "BC_UPDATES", 3)


def given(page: str, recorded: Path, trained: Path) -> None:
    """Fill the folder with what a page's commands take for there."""
    for folder in ("demos", "docs/images", "bench"):
        Path(folder).mkdir(parents=True)
    if "regil record" not in PAGES[page]:
        shutil.copy(recorded, f"demos/{ENV.rpartition('/')[2]}.hdf5")
    shutil.copy(recorded, "demos/mine.hdf5")
    for run in ("runs/shared", "bench/metaworld-button-press-ReGIL-9-22"):
        shutil.copytree(trained, run)
    if "--out runs/first" not in PAGES[page]:
        shutil.copytree(trained, "runs/first")
    shutil.copytree(ROOT / "zoo_configs", "zoo_configs")
    demo = Demonstration.load(recorded)
    formats.write(demo, Path("theirs.hdf5"), "libero")
    imageio.mimwrite("person.mov", demo.frames, fps=30)


def interrupted(patch: pytest.MonkeyPatch) -> None:
    """Leave a run in `runs/stopped` as Ctrl-C does."""

    def interrupt(self):
        raise KeyboardInterrupt

    patch.setattr(training.TrainingCallback, "_on_step", interrupt)
    assert main(smaller(["train", "--env", ENV, "--out", "runs/stopped"])) == 130


def run(words: list[str]) -> int:
    """A command, with fewer steps; what it exits with."""
    if words[0] == "regil":
        return main(smaller(words[1:]))
    if words[:3] == ["python", "-m", "regil_sb3.zoo"]:
        return zoo.main([*words[3:], *ZOO_ALSO[words[3]]])
    assert words[:3] == ["python", "-m", "rl_zoo3.train"], f"{words}: how? Or see NOT_RUN"
    command = [sys.executable, *words[1:], *ZOO_ALSO["train"]]
    return subprocess.run(command, check=False).returncode


def not_run(command: str) -> str | None:
    return next((why for of, why in NOT_RUN.items() if re.match(of, command)), None)


@pytest.mark.timeout(900)  # a page of many commands, on busy cores
@pytest.mark.filterwarnings("ignore:calibration")  # does not fit into episodes so short
@pytest.mark.filterwarnings("ignore:Argument ``multivariate``")  # rl_zoo3's; Optuna 3 warns
@pytest.mark.usefixtures("fresh")
@pytest.mark.parametrize("page", dict.fromkeys(page for page, c in COMMANDS if not_run(c) is None))
def test_every_command_runs_in_order(page, recorded, trained, monkeypatch, request):
    if "libero" in "".join(commands(page)):
        request.getfixturevalue("libero_assets")
    given(page, recorded, trained)
    if "my_envs" in PAGES[page]:
        Path("my_envs.py").write_text(PYTHON.findall(PAGES[page])[0][1])
        monkeypatch.syspath_prepend(Path.cwd())
    if "my_robot:" in PAGES[page]:
        Path("my_robot.py").write_text(MY_ROBOT)
        monkeypatch.syspath_prepend(Path.cwd())
        recording.record_expert("my_robot:my/reach-v0").save("reach.hdf5")
    if "runs/stopped" in STAND_FOR.get(page, {}).values():
        with pytest.MonkeyPatch.context() as patch:
            interrupted(patch)
    monkeypatch.setattr(plt, "show", lambda: None)
    monkeypatch.setattr(costs, "VARIED", ({},))
    monkeypatch.setattr(costs.main, "__defaults__", ("button-press", 8))
    monkeypatch.setattr(throughput.throughput, "__defaults__", ("button-press", 1, 4, 0, 20))
    for command in commands(page):
        if not_run(command) is not None:
            continue
        words = [STAND_FOR.get(page, {}).get(word, word) for word in shlex.split(command)]
        words = [word for word in words if not re.fullmatch(r"[A-Z_]+=\w+", word)]
        words = [name for word in words for name in (sorted(glob(word)) if "*" in word else [word])]
        for word in words:  # a run that a table has made
            if word.startswith("bench/") and not Path(word).exists():
                shutil.copytree(trained, word)
        with pytest.MonkeyPatch.context() as patch:
            limit_episodes(patch, STEPS_OF_DOCTOR if words[1] == "doctor" else STEPS)
            assert run(words) == 0, command
    plt.close("all")


def test_nothing_is_listed_that_no_page_says():
    said = [command for _, command in COMMANDS]
    assert all(any(re.match(of, command) for command in said) for of in NOT_RUN)
    tables = {command.split()[2] for command in said if command.startswith("regil bench ")}
    assert tables >= {*DRY, *SMALL, *ALSO}
    assert {page for page, _ in COMMANDS} >= {*STAND_FOR}


def test_job_scripts():
    """They need a cluster: their syntax, and that their `regil` commands parse."""
    scripts = [b for page in PAGES for b in shell_blocks(page) if b.startswith("#!/bin/bash")]
    assert len(scripts) > 1
    for script in scripts:
        subprocess.run(["bash", "-n"], input=script, text=True, check=True)
        commands = re.findall(r"\bregil ((?:bench|train) .*)", script)
        assert commands
        for command in commands:
            _parser().parse_args(shlex.split(re.sub(r'"\$[^"]*"', "0", command)))


# Examples in docstrings: what they take for there, beside the toy and its demonstration
EXAMPLES = {
    "regil_sb3.guided": {"obs": "state", "reward": "progress"},
    "regil_sb3.relabelling": {"obs": "state", "reward": "ot"},
}
MODULES = [
    ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")
    for root, package in ((ROOT, "regil_sb3"), (ROOT / "wrappers", "regil_wrappers"))
    for path in sorted((root / package).rglob("*.py"))
    if re.search(r"^ *>>> ", path.read_text(encoding="utf-8"), re.MULTILINE)
]


@pytest.mark.usefixtures("fresh")
@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings(name, demo, recorded, tmp_path):
    """Those of every module, with fewer steps, and those that doctest alone would skip."""
    asked = EXAMPLES.get(name, {"obs": "pixels", "reward": "progress"})
    env = gym.make("ToyReach-v0", obs=asked["obs"], render_mode="rgb_array")
    image = "obs" if asked["obs"] == "pixels" else "render"
    env = RetrievalGuideWrapper(env, demo, image=image)
    env = RetrievalRewardWrapper(env, demo, image=image, reward=asked["reward"])
    names = {"env": env, "demo": demo, "toy_demo": demo, "folder": tmp_path, "gym": gym,
             "ReplayableEpisode": ReplayableEpisode}  # fmt: skip
    shutil.copy(recorded, "mine.hdf5")
    module = importlib.import_module(name)
    runner = doctest.DocTestRunner()
    for test in doctest.DocTestFinder(exclude_empty=True).find(module, extraglobs=names):
        for example in test.examples:
            example.options.pop(doctest.SKIP, None)
            source = shortened(example.source).replace('"mine.hdf5")', '"mine.hdf5", episodes=1)')
            # what is not assigned is printed: the model itself
            example.source = re.sub(r"^(?=model\.learn\()", "_ = ", source)
        runner.run(test)
    assert runner.tries > 0
    assert runner.failures == 0


def test_other_commands_name_what_is_there():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    extras = {name: set(_extras(name)) for name in ("setup.cfg", "wrappers/setup.cfg")}
    tried = 0
    for page, command in COMMANDS:
        words = shlex.split(command)
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
    # of a guide that corrects itself; where something went wrong
    assert named - present == {"calibration.json", "warnings.jsonl"}
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
