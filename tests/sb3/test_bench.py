"""The tables of `regil bench`."""

import pytest

from regil_sb3.bench import tables


@pytest.mark.parametrize("table", [tables.rendering, tables.retrieval])
def test_both_sides_are_timed(table):
    ours, peer = table(blocks=2, steps=5)
    assert ours.ratio == 1
    assert peer.ratio == pytest.approx(peer.median_ms / ours.median_ms)
    assert min(ours.median_ms, peer.median_ms) > 0


def test_table_is_printed(monkeypatch, capsys):
    rows = [tables.Row("ours", 0.5, 1.0), tables.Row("theirs", 2.0, 4.0)]
    monkeypatch.setitem(tables.TABLES, "retrieval", lambda: rows)
    assert tables.main("retrieval") == rows
    assert capsys.readouterr().out.splitlines()[-1].split() == ["theirs", "2.000", "4.00"]


def test_unknown_table_gets_one_line():
    with pytest.raises(
        ValueError,
        match=r"^table 'speed' is not one of rendering, retrieval, ranking, guide, success-buffer, "
        r"sensitivity, buffer-vs-learning, trajectories, real-time, results, latency, memory, "
        r"index, throughput, faults, ablations, baselines, rewards, tuning$",
    ):
        tables.main("speed")
    with pytest.raises(ValueError, match=r"^the table 'retrieval' has no option --steps$"):
        tables.main("retrieval", steps=3)
