"""The table of training steps a second."""

import pytest

from regil_sb3.bench import throughput


def test_every_algorithm_learns_and_its_parts_add_up():
    rows = throughput.throughput(blocks=1, steps=6, starts=4)
    assert [row.what for row in rows] == ["SB3 TD3", "SB3 SAC", "TD3BC"]
    assert rows[0].ratio == 1
    for row in rows:
        parts = row.environment_ms + row.retrieval_ms + row.update_ms + row.rest_ms
        assert parts == pytest.approx(1e3 / row.steps_per_second)  # one block: mean and median
        assert min(row.environment_ms, row.retrieval_ms, row.update_ms, row.rest_ms) > 0


def test_table_is_printed(monkeypatch, capsys):
    rows = [throughput.Row("SB3 TD3", 20.0, 1.0, 11.0, 1.0, 36.0, 2.0)]
    monkeypatch.setattr(throughput, "throughput", lambda: rows)
    throughput.main()
    assert capsys.readouterr().out.splitlines()[-1] == (
        "| SB3 TD3 | 20.0 | 1.00 | 11.00 | 1.00 | 36.00 | 2.00 |"
    )
