"""The toys of the wrappers' tests; one thread for torch: networks are small, CI shares cores."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
import torch
from regil_wrappers import Demonstration

sys.path.append(str(Path(__file__).resolve().parents[1] / "wrappers"))

import toy_env

from regil_sb3 import training
from regil_sb3.cli import main

torch.set_num_threads(1)


@pytest.fixture(scope="module")
def demo() -> Demonstration:
    return toy_env.record()


@pytest.fixture(scope="module")
def demo_path(demo: Demonstration, tmp_path_factory: pytest.TempPathFactory) -> str:
    path: Path = tmp_path_factory.mktemp("demos") / "reach.hdf5"
    demo.save(path)
    return str(path)


@pytest.fixture(scope="session")
def libero_assets() -> Path:
    """LIBERO's assets, of the tasks whose tests run here."""
    beside = Path(__file__).resolve().parents[3] / "shared/libero_assets"
    folder = Path(os.environ.setdefault("REGIL_LIBERO_ASSETS", str(beside)))
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there: REGIL_LIBERO_ASSETS names LIBERO's assets")
    return folder


def toy_words(folder: Path) -> list[str]:
    """Of a `regil train` in seconds, whose run folder is ``folder / "run"``."""
    toy_env.record().save(folder / "reach.hdf5")
    tiny = {"correction": "none", "register": "false", "disturbance": 0, "warmup_steps": 25,
            "learning_starts": 10, "bc_pretrain_steps": 2, "buffer_size": 200, "batch_size": 4,
            "eval_episodes": 1}  # fmt: skip
    words = ["train", "--env", "ToyReach-v0", "--demo", str(folder / "reach.hdf5")]
    words += ["--out", str(folder / "run"), "--steps", "200", "--episodes", "2"]
    for key, value in tiny.items():
        words += ["--set", f"{key}={value}"]
    return words


@pytest.fixture
def words(tmp_path: Path) -> list[str]:
    """Of a `regil train` whose run folder is ``tmp_path / "run"``."""
    return toy_words(tmp_path)


@pytest.fixture(scope="session")
def toy_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of `regil train` in seconds; tests leave it as they found it."""
    folder = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "BC_UPDATES", 3)
        assert main(toy_words(folder)) == 0
    return folder / "run"
