from __future__ import annotations

from pathlib import Path

import pytest
import toy_env
from regil_wrappers import Demonstration


@pytest.fixture(scope="session")
def demo() -> Demonstration:
    return toy_env.record()


@pytest.fixture(scope="session")
def demo_path(demo: Demonstration, tmp_path_factory: pytest.TempPathFactory) -> str:
    path: Path = tmp_path_factory.mktemp("demos") / "reach.hdf5"
    demo.save(path)
    return str(path)
