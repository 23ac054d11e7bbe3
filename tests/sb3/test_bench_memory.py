"""`regil bench memory` and `regil bench index`, at tiny sizes."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from regil_wrappers import memory as retrieval_memory

from regil_sb3.bench import memory
from regil_sb3.cli import main


def test_each_picture_is_found_where_it_is():
    pictures = memory.Pictures(dims=8)
    frames = memory._numbered(70, 1000).frames
    rows = pictures.encode(frames)
    np.testing.assert_array_equal(rows, pictures.demonstration(70))
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, rtol=1e-6)
    assert not np.allclose(rows, pictures.demonstration(71), atol=0.05)


def test_both_searches_of_a_small_memory_agree():
    exact, near = memory.measure(1_200, dims=8)  # 30 cells, of which 16 are looked into
    assert (exact.frames, exact.demonstrations, exact.search) == (1_200, 2, "exact")
    assert (near.frames, near.demonstrations, near.search) == (1_200, 2, "faiss")
    assert exact.recall == exact.same == 1
    assert near.recall > 0.9
    assert near.same > 0.9
    for row in (exact, near):
        assert 0 < row.found <= row.step + 1e-3  # parts are rounded
        assert 0 < row.aligned <= row.step + 1e-3
        assert row.step <= row.p99


def test_a_search_that_misses_neighbours_is_seen(monkeypatch):
    monkeypatch.setattr(retrieval_memory, "_PROBED", 1)
    _, near = memory.measure(2_000, dims=8)
    assert near.recall < 0.99


def test_growth_is_the_slope():
    row = memory.Row(0, 0, "exact", 0, 0, 0, 0, 1, 1, 0, 0)
    rows = [replace(row, frames=10**n, step=3.0 * 10**n) for n in (3, 4, 5)]
    rows += [
        replace(row, frames=10**n, step=s, search="faiss") for n, s in ((3, 1), (4, 1), (5, 10))
    ]
    assert memory.growth(rows, "exact") == pytest.approx((1, 1))
    assert memory.growth(rows, "faiss") == pytest.approx((0.5, 1))


def test_table_and_picture(tmp_path, capsys):
    picture = tmp_path / "memory.png"
    words = ["bench", "memory", "--frames", "60", "300", "--dims", "8", "--plot", str(picture)]
    assert main(words) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" | ")[:3] for line in lines if line.startswith(("| 60", "| 300"))] == [
        [f"| {frames}", "1", search] for frames in (60, 300) for search in ("exact", "faiss")
    ]
    assert sum("cost grows as frames^" in line for line in lines) == 2
    assert f"picture: {picture}" in lines
    assert picture.stat().st_size > 10_000


def test_kinds_of_index(capsys):
    assert main(["bench", "index", "--frames", "1000", "--dims", "8"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| 1000")]
    recall = {line.split(" | ")[1]: float(line.split(" | ")[4].strip("| ")) for line in lines}
    assert recall["flat (exact)"] == 1
    assert recall["inverted file, 32 of 25 cells"] == 1  # 1000 / 39: all of them
    assert recall["inverted file, 4 of 25 cells"] <= recall["inverted file, 16 of 25 cells"]
    assert sum(name.startswith("HNSW") for name in recall) == 4


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["memory", "--frames", "1000000"], "need 6.7 GB and 1.0 are free: choose fewer frames"),
        (["index", "--frames", "1000000"], "need 6.7 GB and 1.0 are free"),
        (["memory", "--frames", "9"], "--frames 9: choose 50 to 16000000"),
        (["memory", "--frames", "1004"], "--frames 1004: choose thousands, or 5 more at least"),
        (["memory", "--dims", "0"], "--dims 0: at least 1 is needed"),
        (["memory", "--frames", "60", "--plot", "x.png"], "--plot x.png: name at least two"),
        (["index", "--plot", "x.png"], "the table 'index' has no option --plot"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(words, message, monkeypatch, capsys):
    free = SimpleNamespace(available=10**9, total=2 * 10**9)
    monkeypatch.setattr(memory.psutil, "virtual_memory", lambda: free)
    assert main(["bench", *words]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.strip().splitlines()) == 1


def test_without_faiss(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "faiss", None)
    assert main(["bench", "memory", "--frames", "60"]) == 2
    error = capsys.readouterr().err
    assert "regil bench memory needs faiss" in error
    assert "pip install 'regil-wrappers[faiss]'" in error
