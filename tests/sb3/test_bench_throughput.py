"""The table of training steps a second."""

import pytest

from regil_sb3.bench import costs, throughput


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
    monkeypatch.setattr(throughput, "throughput", lambda task: rows)
    monkeypatch.setattr(costs, "VARIED", ({},))
    monkeypatch.setattr(costs.main, "__defaults__", ("button-press", 8))
    throughput.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[2] == "| SB3 TD3 | 20.0 | 1.00 | 11.00 | 1.00 | 36.00 | 2.00 |"
    assert lines[6].startswith("| default | ")
    assert lines[-2].startswith("encoding, retrieval and logging: ")


@pytest.mark.parametrize("varied", [{"environments": 2, "stack": 3}, {"frames": 200, "size": 64}])
def test_parts_of_a_step(varied):
    row = costs.costs(varied=varied, steps=8)
    assert row.frames == varied.get("frames", row.frames)
    assert sum(row.parts_ms.values()) == pytest.approx(1e3 / row.steps_per_second, rel=0.01)
    assert list(row.parts_ms) == list(costs.PARTS)
    parts = {part: ms for part, ms in row.parts_ms.items() if part != "logging"}  # none ended
    assert min(parts.values()) > 0
    assert row.transition_bytes < (0.18 if varied.get("stack") == 3 else 0.26) * row.sb3_bytes


def test_a_call_within_a_call_counts_once(monkeypatch):
    now = 0.0

    class Work:
        def outer(self):
            nonlocal now
            now += 2
            self.inner()
            now += 1

        def inner(self):
            nonlocal now
            now += 4

    monkeypatch.setattr(costs.time, "perf_counter", lambda: now)
    clock, work = costs.Clock(), Work()
    clock.watch(work, "outer", "outer")
    clock.watch(work, "inner", "inner")
    work.outer()
    assert clock.seconds == {"outer": 3, "inner": 4}
