"""Training runs that are kept, shared by tables, and finished once."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as parquet
import pytest
from toy import demonstration

from regil_sb3.bench import run_tables
from regil_sb3.bench import runs as runs_module
from regil_sb3.bench.runs import Run, finish_all, machines, others, predicted_hours, seconds_of
from regil_sb3.checkpoint.generations import Generations
from regil_sb3.cli import main
from regil_sb3.run_folder import checkpoints_of, has_checkpoint, locked
from regil_sb3.settings import Settings

TINY = (
    "warmup_steps=60",
    "learning_starts=20",
    "bc_pretrain_steps=3",
    "batch_size=8",
    "eval_episodes=2",
)
HERE = str(Path(__file__).parent)


def toy_run(root, method="ReGIL", seed=0, steps=150, **changes):
    demo = root / "demo.hdf5"
    if not demo.exists():
        demonstration().save(demo)
    told = {"episodes": 3, "preset": "plain", "settings": TINY, **changes}
    return Run(str(root), "toy_registered:Toy/Reach-v0", method, seed, steps, str(demo), **told)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two that can be made, and one that cannot."""
    root = tmp_path_factory.mktemp("runs")
    return [toy_run(root), toy_run(root, seed=1), toy_run(root, "bad", settings=("k=0",))]


@pytest.fixture(scope="module")
def failed(runs):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([HERE, os.environ.get("PYTHONPATH", "")]))
        assert predicted_hours(runs, 1) == pytest.approx(450 * 0.06 / 3600)
        return finish_all(runs, workers=2)


def test_runs_are_finished_once_and_failures_are_named(runs, failed):
    assert len(failed) == 1
    assert failed[0].startswith("Reach-bad-0-150: ")
    assert "k=0" in (runs[2].folder / "log.txt").read_text()
    assert [run.finished for run in runs] == [True, True, False]
    took = [seconds_of(run) for run in runs]
    assert min(took) > 0
    assert predicted_hours(runs, 1) == pytest.approx(150 * sum(took[:2]) / 300 / 3600)
    written = (runs[0].folder / "evaluation.json").stat().st_mtime_ns
    assert finish_all(runs[:2]) == []
    assert (runs[0].folder / "evaluation.json").stat().st_mtime_ns == written
    assert len(machines(runs)) == 1
    assert "commit" in machines(runs)[0]


def test_hours_are_predicted_by_algorithm(tmp_path):
    def run(method, seed, seconds=None):
        env, preset = "regil/metaworld-hammer-v0", {"ReGIL": ""}.get(method, method)
        run = Run(str(tmp_path), env, method, seed, 1_000, "", 0, preset)
        run.folder.mkdir()
        if seconds is not None:
            (run.folder / "evaluation.json").write_text('{"policy": {"successes": []}}')
            (run.folder / "took.json").write_text(json.dumps({"seconds": seconds}))
        return run

    finished = [run("ReGIL", 0, 800), run("ReGIL", 1, 1_000), run("baku", 0, 3_600)]
    assert predicted_hours([*finished, run("ReGIL", 2)], 1) == pytest.approx(0.25)
    assert predicted_hours([*finished, run("baku", 1), run("baku", 2)], 2) == pytest.approx(1.0)
    assert predicted_hours([*finished, run("rot", 0)], 1) == pytest.approx(0.5)  # of any


def test_runs_that_were_made_otherwise_are_named(runs, failed, monkeypatch):
    assert others(runs) == []
    changed = replace(runs[0], settings=(*TINY[:-1], "eval_episodes=3", "k=4"))
    (line,) = others([changed, runs[1]])
    assert line.startswith(f"{runs[0].folder} was made with other settings (eval_episodes, ")
    default = runs[0].settings_now.defaults()["TD3BC"]["tau"]
    assert others([replace(runs[0], settings=(*TINY, f"tau={default}"))]) == []  # it was then
    (line,) = others([replace(runs[0], settings=(*TINY, f"tau={default / 2}"))])
    assert line.startswith(f"{runs[0].folder} was made with other settings (hyperparams)")
    with monkeypatch.context() as patch:
        make = runs[0].settings_now.defaults()
        make["TD3BC"] |= {"tau": 0.1, "added later": 3}
        patch.setattr(Settings, "defaults", lambda _: make)
        (line,) = others([runs[0]])
        assert "was made with other settings (the default of TD3BC's tau): remove it" in line
    with monkeypatch.context() as patch:
        patch.setattr(Settings, "defaults", lambda _: {"TD3BC": {"batch_size": 8}})
        less = tuple(setting for setting in TINY if setting != "batch_size=8")
        assert others([replace(runs[0], settings=less)]) == []  # it is one now
    assert replace(runs[0], episodes=2).finished  # fewer of the same
    assert len(list(run_tables.raw([replace(runs[0], episodes=2)]))) == 2
    for more in ({"episodes": 4}, {"beside": (("replay", "guide"),)}):  # its model is there
        again = replace(runs[0], **more)
        assert not again.finished
        assert others([again]) == []


def test_more_is_evaluated_of_a_run_that_has_learned(runs, failed, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([HERE, os.environ.get("PYTHONPATH", "")]))
    shutil.copytree(runs[1].folder, tmp_path / runs[1].folder.name)
    # "corrected" it does not have: its guide is never calibrated
    beside = (("replay", "guide"), ("corrected", "corrected_guide"))
    run = replace(runs[1], root=str(tmp_path), beside=beside)
    learned = (run.folder / "model.zip").read_bytes()
    assert finish_all([run]) == []
    assert run.finished
    assert (run.folder / "model.zip").read_bytes() == learned
    rows = list(run_tables.raw([run]))
    assert [row["method"] for row in rows] == ["ReGIL"] * 3 + ["replay"] * 3
    assert rows[0]["minutes"] > 0
    assert np.isnan(rows[3]["minutes"])
    assert run_tables.table([run])[-1].endswith("| 1 | - | - | - |")
    (run.folder / "model.zip").unlink()
    assert others([run]) == []
    (line,) = others([replace(run, episodes=4)])
    assert "its model is gone: remove it" in line
    told = json.loads((run.folder / "evaluation.json").read_text())
    (run.folder / "evaluation.json").write_text(json.dumps({**told, "steps": run.steps - 1}))
    assert not run.finished  # somebody looked at it on its way
    (run.folder / "evaluation.json").write_text('{"policy": 3}')
    with pytest.raises(ValueError, match="is no evaluation: remove it"):
        run.finished  # noqa: B018


def test_tables_are_what_evaluations_say(tmp_path):
    def done(task, method, seed, successes, reached):
        run = Run(str(tmp_path), f"regil/metaworld-{task}-v0", method, seed, 15_000, "", 4)
        run.folder.mkdir()
        policy = {"successes": successes, "lengths": [9] * len(successes)}
        (run.folder / "evaluation.json").write_text(json.dumps({"policy": policy}))
        log = "time/total_timesteps,eval/success_rate\n2500,\n5000,0.5\n"
        (run.folder / "progress.csv").write_text(log + (f"{reached},0.9\n" if reached else ""))
        return run

    yes, no = [True] * 4, [False] * 4
    runs = [
        done("button-press", "ReGIL", 0, yes, 7_500),
        done("button-press", "ReGIL", 1, [*yes[:3], False], 10_000),
        done("hammer", "ReGIL", 0, yes, None),
        done("hammer", "RL", 0, no, None),
        Run(str(tmp_path), "regil/metaworld-hammer-v0", "RL", 1, 15_000, ""),  # not made yet
    ]
    head, _, ours, rl = run_tables.table(runs)
    assert head.startswith("| method | button-press | hammer | IQM")
    cells = [cell.strip() for cell in ours.strip("|").split("|")]
    assert cells[:3] == ["ReGIL", "0.875 (0.97)", "1.000 (0.91)"]
    assert cells[4:7] == ["3", "10,000", "-"]
    assert [cell.strip() for cell in rl.strip("|").split("|")][:3] == ["RL", "-", "0.000"]
    rows = list(run_tables.raw(runs))
    assert len(rows) == 16
    assert run_tables._in_brackets(runs).startswith("In brackets the paper's")
    of_none = [done("drawer-open", "RL", seed, no, None) for seed in (0, 1)]
    assert "| 0.000 (0.000 to 0.000) |" in run_tables.table(of_none)[-1]  # an interval's
    assert run_tables._in_brackets(of_none) == ""
    assert "50,000 to 100,000 frames" in run_tables._paper_reached(rows)
    assert not run_tables._paper_reached(rows[8:])  # hammer's
    assert run_tables._better(rows) == "Above ReGIL: none. "
    runs[3] = done("hammer", "BC", 0, yes, None)
    (runs[2].folder / "evaluation.json").write_text(
        json.dumps({"policy": {"successes": [*yes[:3], False], "lengths": [9] * 4}})
    )
    assert run_tables._better(list(run_tables.raw(runs))) == "Above ReGIL: BC on hammer. "
    shared = replace(runs[0], method="progress", called="ReGIL")
    assert run_tables.table([shared])[-1].startswith("| progress | 1.000 | ")
    papers = replace(shared, method="sdtw", paper="ReGIL")
    assert run_tables.table([papers])[-1].startswith("| sdtw | 1.000 (0.97) | ")
    assert run_tables._narrow(rows) == ""  # of one run there is no interval
    two = [row for row in rows if row["task"] == "button-press"]
    assert run_tables._narrow(two) == "Intervals of 2 runs a task are too narrow (docs/bench.md). "
    one = [{**row, "method": "RFCL"} for row in two if row["seed"] == 0]
    assert run_tables._narrow(two + one).startswith("Intervals of 2 runs ")
    many = [{**row, "seed": seed} for row in rows for seed in range(5)]
    assert run_tables._narrow(many) == ""


def test_the_papers_figure_stands_beside_its_own_method(tmp_path):
    told = {
        name: {run.method: run.paper for run in run_tables.planned(name, tmp_path)}
        for name in run_tables.LEARNING
    }
    assert {m: paper for m, paper in told["rewards"].items() if paper} == {"sdtw": "ReGIL"}
    assert {m: paper for m, paper in told["baselines"].items() if paper} == {"ReGIL_plain": "ReGIL"}
    assert not any(told["ablations"].values())


def test_bench_from_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["bench", "ablations", "--dry-run"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 2 * 2 * 5 + 1
    assert main(["bench", "rewards", "--dry-run", "--methods", "progress"]) == 0
    assert "metaworld-button-press-ReGIL-0-15000: " in capsys.readouterr().out
    assert said[-1] == "20 of 20 runs to make: about 5.0 hours, 1 at a time"
    assert any("--preset ablation-rl " in line for line in said)
    assert not list(tmp_path.iterdir())
    negative = ["--gpus", "-1", "--ray", "local"]
    wrong = (
        ["--episodes", "0"],
        ["--steps", "-3"],
        ["--steps", "2000"],
        ["--gpus", "1"],
        negative,
        ["--tasks", "fly"],
    )
    for words in (["--methods", "magic"], ["--workers", "0"], ["--plot", "x"], *wrong):
        assert main(["bench", "ablations", *words]) == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_what_is_written(runs, failed, tmp_path, monkeypatch, capsys):
    for run in runs[:2]:  # all that a table needs of a run
        kept = tmp_path / run.folder.name
        kept.mkdir()
        for name in ("config.yaml", "evaluation.json", "progress.csv", "took.json"):
            shutil.copy(run.folder / name, kept)
    kept_alone = [replace(run, root=str(tmp_path)) for run in runs[:2]]
    monkeypatch.setattr(run_tables, "planned", lambda *_, **__: kept_alone)
    run_tables.main("ablations", dry_run=True)
    so_far = capsys.readouterr().out
    assert "0 of 2 runs to make" in so_far
    assert "| ReGIL | " in so_far
    run_tables.main("ablations", out=str(tmp_path))
    rows = parquet.read_table(tmp_path / "ablations.parquet").to_pylist()
    assert len(rows) == 2 * 3
    assert {row["seed"] for row in rows} == {0, 1}
    text = (tmp_path / "ablations.md").read_text()
    assert "regil bench ablations" in text
    assert "Seeds 0, 1; 0.0 hours, one run after the other; " in text
    assert "commit" in text
    assert np.mean([row["success"] for row in rows]) == pytest.approx(
        float(text.split("| ReGIL | ")[1].split(" ")[0]), abs=1e-3
    )
    assert (tmp_path / "ablations.tex").read_text().count(r"\\") == 2
    run_tables.main("ablations", out=str(tmp_path), steps=60_000)
    assert "--steps 60000" in (tmp_path / "ablations-60000.md").read_text()
    assert (tmp_path / "ablations.md").read_text() == text
    assert "Not made" not in text
    monkeypatch.setattr(run_tables, "planned", lambda *_, **__: [*kept_alone, runs[2]])
    with pytest.raises(ValueError, match="1 runs failed: Reach-bad"):
        run_tables.main("ablations", out=str(tmp_path))
    assert f"Not made: {runs[2].folder.name}. " in (tmp_path / "ablations.md").read_text()


def test_runs_beside_others_have_their_demonstration(runs, failed, tmp_path):
    shutil.copytree(runs[0].folder, tmp_path / runs[0].folder.name)
    kept, more = (replace(run, root=str(tmp_path)) for run in runs[:2])
    runs_module.same_demonstrations([kept, more])
    other = str(tmp_path / "other.hdf5")
    demonstration(0.5).save(other)
    with pytest.raises(ValueError, match=r"was made with another demonstration .* bring its"):
        finish_all([replace(run, demo=other) for run in (kept, more)])
    assert not more.folder.exists()
    with pytest.raises(ValueError, match="was made with another demonstration"):
        finish_all([replace(runs[1], demo=other)])  # nothing would be made
    shutil.copy(other, tmp_path / "same.hdf5")
    twice = [replace(more, demo=other), replace(more, seed=2, demo=str(tmp_path / "same.hdf5"))]
    with pytest.raises(ValueError, match="are one demonstration"):
        finish_all(twice)


def killed_once(run):
    """A thread that kills the run's process when it has noted what it has taken."""

    def kill():
        while not (run.folder / "progress.csv").exists() or seconds_of(run) is None:
            time.sleep(0.1)
        os.kill(int((run.folder / ".lock").read_text()), signal.SIGKILL)

    thread = threading.Thread(target=kill)
    thread.start()
    return thread


def test_a_run_whose_process_is_killed_is_told_from_one_that_fails(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([HERE, os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setattr(runs_module, "_NOTED_EVERY", 0.0)
    run = toy_run(tmp_path, steps=100_000)
    noted = []
    write = runs_module._write_took
    monkeypatch.setattr(
        runs_module, "_write_took", lambda *words: (noted.append(words[1]), write(*words))
    )
    killer = killed_once(run)
    with pytest.raises(runs_module.KilledError, match="ended with status -9: see"):
        runs_module.finish(run)
    killer.join()
    assert noted == sorted(set(noted))  # every now and then: this process may be killed, too
    assert len(noted) > 3


def test_a_run_that_another_process_still_saves_is_waited_for(runs, failed, monkeypatch):
    monkeypatch.setattr(runs_module.time, "sleep", lambda _: None)
    with locked(runs[2].folder):
        began = time.monotonic()
        with pytest.raises(ValueError, match="is learning in"):
            runs_module.finish(runs[2], patience=0.3)
        assert time.monotonic() - began > 0.3
    held = threading.Event()

    def hold(_):
        held.set()  # the first look found it locked
        saving.__exit__(None, None, None)

    saving = locked(runs[2].folder)
    saving.__enter__()
    monkeypatch.setattr(runs_module.time, "sleep", hold)
    (error,) = finish_all([runs[2]])
    assert held.is_set()
    assert "see log.txt there" in error  # its turn came


_INTERRUPTED = """
import signal
from pathlib import Path
from test_runs import toy_run
from regil_sb3.bench.runs import finish_all
signal.signal(signal.SIGINT, signal.default_int_handler)
if __name__ == "__main__":
    runs = [toy_run(Path({!r}), seed=seed, steps=100_000) for seed in range(3)]
    finish_all(runs, **{!r})
"""


@pytest.mark.parametrize(
    ("signalled", "options"),
    [
        ("group", {"workers": 2}),  # by a terminal
        ("alone", {"workers": 2}),  # by a scheduler
        pytest.param("alone", {"ray": "local", "cpus": 0.5}, marks=pytest.mark.slow),
    ],
)
@pytest.mark.timeout(600)  # Ray's workers take long to start on busy cores
def test_an_interrupted_bench_lets_its_runs_save_themselves(tmp_path, signalled, options):
    script = tmp_path / "bench.py"
    script.write_text(_INTERRUPTED.format(str(tmp_path), options))
    path = os.pathsep.join([HERE, os.environ.get("PYTHONPATH", "")])
    bench = subprocess.Popen(
        [sys.executable, script], env=os.environ | {"PYTHONPATH": path}, start_new_session=True
    )
    folders = [toy_run(tmp_path, seed=seed, steps=100_000).folder for seed in range(3)]
    try:
        while not all((folder / "progress.csv").exists() for folder in folders[:2]):
            assert bench.poll() is None
            time.sleep(0.1)
        if signalled == "group":
            os.killpg(bench.pid, signal.SIGINT)
        else:
            bench.send_signal(signal.SIGINT)
        assert bench.wait(120) != 0
    finally:
        bench.kill()  # its runs end with it
    for folder in folders[:2]:
        assert has_checkpoint(folder)
        with locked(folder):  # nobody goes on with it
            pass
    if "workers" in options:  # Ray may have room for all
        assert not folders[2].exists()


_BENCH = """
from pathlib import Path
from test_runs import toy_run
from regil_sb3.bench.runs import finish
finish(toy_run(Path({!r}), steps=600))
"""


@pytest.mark.slow
def test_a_bench_that_was_killed_goes_on(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([HERE, os.environ.get("PYTHONPATH", "")]))
    run = toy_run(tmp_path, steps=600)
    bench = subprocess.Popen([sys.executable, "-c", _BENCH.format(str(tmp_path))])
    while not (run.folder / "progress.csv").exists():
        time.sleep(0.1)
    bench.send_signal(signal.SIGKILL)
    bench.wait()
    time.sleep(3)  # its run saves itself
    assert not run.finished
    assert finish_all([run]) == []
    assert run.finished
    (run.folder / "evaluation.json").unlink()  # as if it had been killed before
    assert finish_all([run]) == []
    assert run.finished


@pytest.mark.slow
@pytest.mark.timeout(1_200)  # Ray's workers take long to start on busy cores
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # Ray 2.40's logs
def test_on_a_cluster_a_run_whose_process_is_killed_goes_on(tmp_path, monkeypatch):
    import ray

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([HERE, os.environ.get("PYTHONPATH", "")]))
    run = toy_run(tmp_path, steps=600)
    killer = killed_once(run)
    try:
        assert finish_all([run], ray="local", cpus=0.5) == []
    finally:
        ray.shutdown()
    killer.join()
    assert run.finished


@pytest.mark.slow
@pytest.mark.timeout(1_200)  # Ray's workers take long to start on busy cores
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # Ray 2.40's logs
def test_a_lost_node_loses_no_run(tmp_path, monkeypatch):
    """Two nodes of a Ray cluster on this machine; one is killed when both have a run under way."""
    import ray
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([HERE, os.environ.get("PYTHONPATH", "")]))
    often = {"env": "often_saved:Toy/Reach-v0", "steps": 2_000}
    runs = [replace(toy_run(tmp_path, seed=seed), **often) for seed in range(3)]
    memory = {"num_cpus": 1, "object_store_memory": 100 * 2**20}
    cluster = Cluster(initialize_head=True, head_node_args=memory)
    try:
        lost = cluster.add_node(**memory)
        ray.init(address=cluster.address, log_to_driver=False)
        with pytest.raises(ValueError, match=r"no node .* 1 CPUs, 1 GPUs and 0 GiB"):
            finish_all(runs, ray="auto", gpus=1)

        def saved_thrice(run: Path) -> bool:
            return max(Generations(checkpoints_of(run)).numbers, default=0) > 2

        def kill() -> None:
            while sum(saved_thrice(run.folder) for run in runs) < 2:
                time.sleep(0.2)
            cluster.remove_node(lost, allow_graceful=False)

        killer = threading.Thread(target=kill)
        killer.start()
        assert finish_all(runs, ray="auto", memory=0.5) == []
        killer.join()
        assert all(run.finished for run in runs)
        logs = [(run.folder / "log.txt").read_text() for run in runs]
        assert [log.count("evaluating policy:   0%") for log in logs] == [1, 1, 1]  # none twice
        begun = [max(map(int, re.findall(r" (\d+)/2000 \[00:00<\?", log))) for log in logs]
        assert sum(step > 0 for step in begun) == 1  # the lost one, from its checkpoint
    finally:
        ray.shutdown()
        cluster.shutdown()
