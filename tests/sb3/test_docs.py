"""The documentation's Python blocks that say so run, and its table of encoders is the code's."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch as th
from regil_wrappers import make_encoder
from regil_wrappers.encoders import cache, encoder_names, registry
from regil_wrappers.encoders.timm_networks import _import_timm

DOCS = Path(__file__).parents[2] / "docs"
MARK = "<!-- runs -->\n"
PAGES = {page.name: page.read_text(encoding="utf-8") for page in sorted(DOCS.glob("*.md"))}
ENCODERS = PAGES["encoders.md"]


@pytest.fixture
def fresh(monkeypatch, tmp_path):
    """Nothing cached, registered or left behind."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(registry, "_factories", dict(registry._factories))
    monkeypatch.setattr(cache, "_cache", type(cache._cache)())
    make_encoder.cache_clear()
    yield
    make_encoder.cache_clear()


@pytest.mark.usefixtures("fresh")
@pytest.mark.parametrize("page", [name for name, text in PAGES.items() if MARK in text])
def test_marked_blocks_run_in_order(page):
    names = {}
    for code in re.findall(MARK + r"```python\n(.*?)```", PAGES[page], re.DOTALL):
        exec(compile(code, page, "exec"), names)


def test_all_blocks_about_encoders_are_marked():
    assert ENCODERS.count("```python") == ENCODERS.count(f"{MARK}```python") == 4


def test_the_table_of_encoders():
    timm = _import_timm()
    row = re.compile(r"\| (`[^|]+`) \| `([^`]+)` \| ([\d.]+) \| (\d+) \| (\d+) \| ([\dx ]+) \|")
    listed = {}
    for names, *rest in row.findall(ENCODERS):
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
