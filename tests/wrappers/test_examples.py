"""The examples in docstrings run."""

from __future__ import annotations

import doctest
import importlib

import pytest
from regil_wrappers import Demonstration


@pytest.mark.parametrize("name", ["demonstration", "retrieval", "wrappers", "vector"])
def test_examples(name: str, demo: Demonstration) -> None:
    module = importlib.import_module(f"regil_wrappers.{name}")
    failed, tried = doctest.testmod(module, extraglobs={"toy_demo": demo})
    assert tried > 0
    assert failed == 0
