"""The README's Python blocks run as printed, with fewer steps."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from regil_wrappers import Demonstration

from regil_sb3.cli import main

README = Path(__file__).parents[2] / "README.md"
BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
ENV = "regil/metaworld-button-press-v0"


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["record", ENV]) == 0
    return tmp_path


def run(code, **shorter):
    for long, short in shorter.values():
        assert long in code
        code = code.replace(long, short)
    names = {}
    exec(compile(code, "README.md", "exec"), names)
    names["env"].close()
    return names


# SB3's progress bar is tqdm's rich one, which calls itself experimental
@pytest.mark.filterwarnings("ignore::tqdm.TqdmExperimentalWarning")
def test_library(here):
    names = run(BLOCKS[0], steps=("learn(15_000", "learn(60"))
    assert names["model"].num_timesteps == 60


def test_reward_for_another_algorithm(here):
    (here / f"demos/{ENV.rpartition('/')[2]}.hdf5").rename(here / "pusher.hdf5")
    run(
        BLOCKS[1],
        env=('"Pusher-v5"', f'"regil_sb3:{ENV}", obs="state"'),
        steps=("learn(100_000)", "learn(60)"),
    )


def test_own_demonstration(here):
    frames = np.zeros((9, 84, 84, 3), np.uint8)
    names = {"frames": frames, "actions": np.zeros((8, 4), np.float32)}
    exec(compile(BLOCKS[2], "README.md", "exec"), names)
    assert len(Demonstration.load("mine.hdf5")) == 9
