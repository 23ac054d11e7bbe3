"""`regil bench latency`, and the packages that it compares with as oracles."""

import re
import subprocess
import sys
from dataclasses import replace

import missing_weights
import numpy as np
import pyarrow.parquet as parquet
import pytest
from regil_wrappers.alignment import (
    accumulated_costs,
    best_end,
    squared_distances,
    warping_path,
)

from regil_sb3.bench import latency, machine, tables
from regil_sb3.bench.peers import LIBROSA_ON_COSTS, PEERS
from regil_sb3.cli import main

OURS = [
    "1 environment",
    "8 environments, together",
    "8 environments, one by one",
    "S-DTW alone, given the distances",
]


def test_all_find_the_same_segment():
    rng = np.random.default_rng(0)
    calls = [(peer, peer.load()) for peer in PEERS]
    on_costs = LIBROSA_ON_COSTS.load()
    for _ in range(30):
        memory = rng.normal(size=(40, 6)).cumsum(axis=0).astype(np.float32)
        window = rng.normal(size=(5, 6)).cumsum(axis=0).astype(np.float32)
        costs = squared_distances(window, memory)
        table = accumulated_costs(costs)
        end, cost = best_end(table)
        start = warping_path(table, end)[0][1]
        found = [call(peer.prepare(window), peer.prepare(memory)) for peer, call in calls]
        for first, last, their_cost in [*found, on_costs(costs, memory)]:
            assert (first, last) == (start, end)
            assert their_cost == pytest.approx(cost, rel=1e-5)


def test_every_side_of_every_length_is_a_row():
    rows = list(latency.latency(["pixels?size=6"], [9, 40], 3, 4, seconds=1e9))
    names = [*OURS[:3], *(peer.name for peer in PEERS), OURS[3], LIBROSA_ON_COSTS.name]
    assert [(row.frames, row.what) for row in rows] == [(n, w) for n in (9, 40) for w in names]
    for row in rows:
        assert row.calls == 12
        assert 0 < row.total <= row.p99
        assert np.isnan(row.encode) == (row.what not in OURS[:3])
        assert np.isnan(row.ratio) == (row.what in (OURS[0], OURS[1], OURS[3]))
    for row in rows[:3]:  # each part is at most the whole, call by call, and so are medians
        assert min(row.encode, row.search, row.alignment) > 0
        assert max(row.encode, row.search, row.alignment) <= row.total


def test_ratios_are_of_what_they_are_compared_with(monkeypatch):
    """Every call takes a time of its own; medians and ratios follow."""
    taken = {
        OURS[0]: (0.002, 0.003, 0.001, 0.007),
        OURS[1]: (0.004, 0.010, 0.004, 0.020),
        OURS[2]: (0.016, 0.024, 0.008, 0.050),
        OURS[3]: (np.nan, np.nan, 0.001, 0.001),
        **{peer.name: (np.nan, np.nan, np.nan, 0.010 * i) for i, peer in enumerate(PEERS, 1)},
        LIBROSA_ON_COSTS.name: (np.nan, np.nan, np.nan, 0.003),
    }

    def turns(sides, blocks, steps, seconds):
        return {name: np.array([taken[name]] * 3) for name in sides}

    monkeypatch.setattr(latency, "_taking_turns", turns)
    rows = {row.what: row for row in latency.latency(["pixels"], [9], blocks=1, steps=1)}
    assert (rows[OURS[0]].search, rows[OURS[0]].total) == (3, 7)
    assert rows[OURS[2]].ratio == pytest.approx(2.5)  # 50 / 20
    assert [rows[peer.name].ratio for peer in PEERS] == pytest.approx([2, 4, 6])  # of 7 - 2
    assert rows[LIBROSA_ON_COSTS.name].ratio == pytest.approx(3)


def test_a_slow_side_gives_its_turn_back():
    sides = {
        "slow": lambda block, step: (0, 0, 0, 0.3),
        "fast": lambda block, step: (0, 0, 0, 0.0),
        "absent": "not installed",
    }
    times = latency._taking_turns(sides, blocks=2, steps=5, seconds=0.5)
    assert {name: len(rows) for name, rows in times.items()} == {"slow": 4, "fast": 10}


def test_what_is_not_installed_is_a_row_that_says_so(monkeypatch, capsys, tmp_path):
    for name in ("librosa.sequence", "timm"):
        monkeypatch.setitem(sys.modules, name, None)
    peers = [replace(peer, module="no_such_package") for peer in PEERS[:2]]
    monkeypatch.setattr(latency, "PEERS", (*peers, PEERS[2]))
    encoders = ["efficientnet-lite0?size=32", "pixels?size=6"]
    real = latency.latency
    monkeypatch.setattr(latency, "latency", lambda **o: real(**o, blocks=1, steps=1))
    words = ["bench", "latency", "--encoders", *encoders, "--frames", "9"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    missing = [line for line in lines if "pip install" in line]
    assert "pip install 'regil-wrappers[timm]'" in missing[0]
    assert len(missing) == 5
    for line in missing[1:]:
        assert "not installed" in line
        assert "pip install 'regil-sb3[bench]'" in line
    assert sum("environment" in line for line in lines if line.startswith("| pixels")) == 3
    kept = (tmp_path / "latency.md").read_text()
    assert lines[2] in kept
    assert "Meta-World 31.61 in all, 30.30 encoding and 1.29 search" in kept
    rows = parquet.read_table(tmp_path / "latency.parquet").to_pylist()
    assert sum(row["encoder"] == "pixels?size=6" and not row["missing"] for row in rows) == 4


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--frames", "4"], "--frames 4: at least 5 are needed"),
        (["--encoders", "vgg"], "encoder 'vgg': unknown: choose one of"),
        (["--steps", "4"], "the table 'latency' has no option --steps"),
    ],
)
def test_bad_options_get_one_line(words, message, capsys):
    assert main(["bench", "latency", *words]) == 2
    assert message in capsys.readouterr().err


def test_retrieval_has_no_encoders():
    with pytest.raises(ValueError, match="the table 'retrieval' has no option --encoders"):
        tables.main("retrieval", encoders=["pixels"])


def test_an_encoder_without_weights_says_so_in_its_line(monkeypatch):
    missing_weights.without_dinov3(monkeypatch, latency)
    rows = list(latency.latency(["dinov3", "pixels"], [20], blocks=1, steps=1))
    assert rows[0].missing == missing_weights.WHY
    assert rows[1].encoder == "pixels"


def test_the_commit_is_not_that_of_somebody_elses_checkout(tmp_path, monkeypatch):
    place = tmp_path / "regil_sb3" / "machine.py"
    place.parent.mkdir()
    place.touch()
    git = ["git", "-C", tmp_path, "-c", "user.name=a", "-c", "user.email=a@b"]
    for words in (["init", "-q"], ["commit", "-q", "--allow-empty", "-m", "theirs"]):
        subprocess.run([*git, *words], check=True)
    monkeypatch.setattr(machine, "__file__", str(place))
    assert machine.describe([]).endswith(", commit unknown")
    subprocess.run([*git, "add", "."], check=True)
    assert re.search(r", commit [0-9a-f]{7,}\+$", machine.describe([]))
    subprocess.run([*git, "commit", "-q", "-m", "ours"], check=True)
    (tmp_path / "notes.md").touch()  # no code
    subprocess.run([*git, "add", "."], check=True)
    assert re.search(r", commit [0-9a-f]{7,}$", machine.describe([]))


def test_gpus_are_named_where_they_may_be_used(tmp_path, monkeypatch):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    tool = tmp_path / "nvidia-smi"
    tool.write_text("#!/bin/sh\necho 'NVIDIA H100, 570.1'\necho 'NVIDIA H100, 570.1'\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    assert " GiB, NVIDIA H100 (driver 570.1), OMP" in machine.describe([])
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert "NVIDIA" not in machine.describe([])


def test_the_machine_in_one_line(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    line = machine.describe(["numpy", "no-such-package"])
    assert f"numpy {np.__version__}" in line
    assert "OMP_NUM_THREADS=3" in line
    assert "no-such-package" not in line
    assert "\n" not in line
    assert ", commit " in line
