from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import toy_env
from regil_wrappers import Demonstration, make_encoder
from regil_wrappers.encoders import cache, registry


@pytest.fixture(scope="session")
def demo() -> Demonstration:
    return toy_env.record()


@pytest.fixture(scope="session")
def demo_path(demo: Demonstration, tmp_path_factory: pytest.TempPathFactory) -> str:
    path: Path = tmp_path_factory.mktemp("demos") / "reach.hdf5"
    demo.save(path)
    return str(path)


@pytest.fixture
def fresh_encoders(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Nothing cached, in the process or in files, and nothing registered."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("REGIL_ENCODERS", raising=False)
    monkeypatch.setattr(registry, "_factories", dict(registry._factories))
    cache._cache.clear()
    make_encoder.cache_clear()
    yield
    cache._cache.clear()
    make_encoder.cache_clear()
