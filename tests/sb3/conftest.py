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
