"""Many training runs: each is done once, on this machine or on many, and a killed one goes on.

* ``Run`` - one method on one task with one seed: what `regil train` is to be given, and its folder
* ``finish`` - trains a run to its end, or goes on with it, and evaluates it
* ``finish_all`` - several at a time, as processes here or as tasks of a Ray cluster
* ``predicted_hours``, ``machines`` - from what finished runs took, and where
* ``others`` - finished runs that were made with other settings than are asked for now

A run is a folder; it is finished when its ``evaluation.json`` says enough. Nothing else is kept
about it, so that any number of machines that see the folders may take part, one after the other.
Tables need of it ``config.yaml``, ``progress.csv``, ``evaluation.json`` and ``took.json`` alone.
"""

from __future__ import annotations

import csv
import hashlib
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from tqdm import tqdm

from regil_sb3.bench.machine import SIMULATORS, describe
from regil_sb3.bench.on_ray import SHOWN_EVERY, Shares, call_all, connect
from regil_sb3.files import replacing

if TYPE_CHECKING:
    from regil_sb3.settings import Settings

__all__ = [
    "KilledError",
    "Run",
    "finish",
    "finish_all",
    "machines",
    "others",
    "predicted_hours",
    "seconds_of",
]

_PACKAGES = ("gymnasium", *SIMULATORS, "stable-baselines3", "torch", "regil-sb3")

_SECONDS_A_STEP = 15 * 60 / 15_000  # of one core, until a run has told
_GRACE = 60.0  # s that an interrupted run is given to save itself
_NOTED_EVERY = 60.0  # s between two notes of what a run has taken
_LOST = 240.0  # s until a file system of several machines has given up a lost one's lock


class KilledError(RuntimeError):
    """A run's process was ended from outside: by the kernel for memory, or by a scheduler."""


@dataclass(frozen=True)
class Run:
    """One training run.

    Attributes:
        root: the folder of all runs.
        env: id of the environment.
        method: its name in tables.
        seed: of demonstration, networks and sampling.
        steps: agent steps.
        demo: the demonstration's file; recorded where it is not there.
        episodes: unseen episodes at the end.
        preset: section of the zoo's YAML; "" takes the environment's own.
        settings: "KEY=VALUE" on top of it.
        called: its name in the folder's, where a run is shared that another table calls otherwise;
            "": ``method``.
        paper: its name in the paper's figures; "": ``method``.
        beside: what else is evaluated in it, a name in tables and one of
            `regil_sb3.evaluation.METHODS` each.
    """

    root: str
    env: str
    method: str
    seed: int
    steps: int
    demo: str
    episodes: int = 40
    preset: str = ""
    settings: tuple[str, ...] = ()
    called: str = ""
    paper: str = ""
    beside: tuple[tuple[str, str], ...] = ()

    @property
    def folder(self) -> Path:
        """Where it is: task, method, seed and steps tell it from all others."""
        task = self.env.rpartition("/")[2].removesuffix("-v0")
        name = self.called or self.method
        return Path(self.root) / f"{task}-{name}-{self.seed}-{self.steps}"

    @property
    def finished(self) -> bool:
        """Whether it has made all steps, and is evaluated as often and as all that is asked for.

        Raises:
            ValueError: ``evaluation.json`` is damaged.
        """
        path = self.folder / "evaluation.json"
        if not path.exists():
            return False
        try:
            found = json.loads(path.read_text("utf-8"))
            episodes = len(found["policy"]["successes"])
            asked = {*found.get("asked", found)}
            # else it was looked at on its way
            learned = int(found.get("steps", self.steps)) >= self.steps
        except (ValueError, LookupError, TypeError, AttributeError):
            raise ValueError(
                f"{path} is no evaluation: remove it, and the run is evaluated again"
            ) from None
        return learned and episodes >= self.episodes and {*dict(self.beside).values()} <= asked

    @property
    def command(self) -> str:
        """What makes the same run by hand, its evaluation aside."""
        words = ["regil train --env", self.env, "--seed", str(self.seed)]
        words += ["--demo", self.demo, "--steps", str(self.steps), "--episodes", str(self.episodes)]
        words += ["--preset", self.preset] if self.preset else []
        words += [f"--set {setting}" for setting in self.settings]
        return " ".join([*words, "--out", str(self.folder)])

    @property
    def settings_now(self) -> Settings:
        """What it is made with, if it is made now."""
        from regil_sb3.settings import make_settings

        return make_settings(
            self.env, self.preset or None, self.seed, self.steps, list(self.settings)
        )


def _took(run: Run) -> dict[str, Any]:
    """``seconds``, ``machines`` in the order in which they went on, and ``demo``, its digest."""
    try:
        told = json.loads((run.folder / "took.json").read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return told if isinstance(told, dict) else {}


def _write_took(run: Run, seconds: float, here: str, demo: str) -> None:
    where = list(dict.fromkeys([*_took(run).get("machines", ()), here]))
    told = {"seconds": seconds, "machines": where, "demo": demo}
    with replacing(run.folder / "took.json") as file:
        file.write(json.dumps(told).encode())


def _demo_of(run: Run) -> Path:
    """The demonstration that it learns from: one that was begun has its own."""
    own = run.folder / "demo.hdf5"
    return own if own.exists() and (run.folder / "config.yaml").exists() else Path(run.demo)


def _digest(demo: Path | str) -> str:
    """Of what a demonstration's file holds."""
    from regil_wrappers import Demonstration

    loaded, found = Demonstration.load(demo), hashlib.sha256()
    for part in (loaded.frames, loaded.actions):
        found.update(b"" if part is None else part.tobytes())
    return found.hexdigest()[:20]


def same_demonstrations(runs: Sequence[Run]) -> None:
    """Refuse to put runs beside others of another demonstration, or two seeds of one.

    Runs of older versions do not say theirs; nor is it known what is not there.

    Raises:
        ValueError: one was made with another than is there now, or two of those that are there
            are the same.
    """
    here = {demo: _digest(demo) for demo in {run.demo for run in runs} if Path(demo).exists()}
    of: dict[str, str] = {}
    for demo, digest in sorted(here.items()):
        if digest in of:
            raise ValueError(
                f"{of[digest]} and {demo} are one demonstration (the expert fails at a seed, and "
                "takes the next): name other --seeds"
            )
        of[digest] = demo
    for run in runs:
        told = _took(run).get("demo")
        if None not in (told, now := here.get(run.demo)) and told != now:
            raise ValueError(
                f"{run.folder} was made with another demonstration than {run.demo} is now: remove "
                "the run, and it is made again, bring its demonstration, or name another --out"
            )


def seconds_of(run: Run) -> float | None:
    """What a finished run took, in s; None where that is not known."""
    seconds = _took(run).get("seconds")
    return None if seconds is None else float(seconds)


def machines(runs: Sequence[Run]) -> list[str]:
    """What finished runs were made on: processor, versions and commit, each once."""
    told = [_took(run).get("machines", ["a machine that is not known"]) for run in runs]
    pairs = zip(runs, told, strict=True)
    return list(dict.fromkeys(where for run, all_of in pairs if run.finished for where in all_of))


def others(runs: Sequence[Run]) -> list[str]:
    """A line for each run that is not the one that is asked for now.

    Of one that is finished or begun, other settings or defaults; of one whose model is gone, an
    evaluation that is not enough.
    """
    from regil_sb3.settings import ALGOS, Settings

    lines = []
    for run in runs:
        if not (config := run.folder / "config.yaml").exists():
            continue
        kept, asked = Settings.load(config, trust=True), run.settings_now
        then, now = asdict(kept), asdict(asked)
        defaults_then = yaml.safe_load(config.read_text("utf-8")).get("defaults") or {}
        defaults_now = asked.defaults()
        algorithm = ALGOS[asked.algo].__name__
        # What is said of the algorithm now may have been its default then, and the other way round
        names = {*kept.hyperparams, *asked.hyperparams}
        for said, defaults in ((then, defaults_then), (now, defaults_now)):
            every = {**defaults.get(algorithm, {}), **said["hyperparams"]}
            said["hyperparams"] = {name: every.get(name) for name in names}
        differ = [name for name in now if then[name] != now[name]]
        if differ := differ or _other_defaults(defaults_then, defaults_now):
            lines.append(
                f"{run.folder} was made with other settings ({', '.join(differ)}): "
                "remove it, and it is made again, or name another --out"
            )
            continue
        evaluated, model = (run.folder / name for name in ("evaluation.json", "model.zip"))
        if evaluated.exists() and not run.finished and not model.exists():
            lines.append(
                f"{run.folder} was evaluated in other episodes, or as less, than is asked for, "
                "and its model is gone: remove it, and it is made again, or name another --out"
            )
    return lines


def _other_defaults(then: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Which of a run's constructors' defaults were other ones; older runs do not say them."""
    return [
        f"the default of {of}'s {name}"
        for of, arguments in now.items()
        for name, value in arguments.items()
        if name in then.get(of, {}) and then[of][name] != value
    ]


def predicted_hours(runs: Sequence[Run], workers: int) -> float:
    """Hours that the unfinished runs will take.

    By what finished ones of the same algorithm took a step, else of any.
    """
    told: dict[str, list[tuple[float, int]]] = {}
    steps: dict[str, int] = {}
    for run in runs:
        algo = run.settings_now.algo
        if not run.finished:
            steps[algo] = steps.get(algo, 0) + run.steps
        elif (took := seconds_of(run)) is not None:
            told.setdefault(algo, []).append((took, run.steps))
    of_any = [pair for pairs in told.values() for pair in pairs]

    def rate(algo: str) -> float:
        seconds, made = np.sum(told.get(algo, of_any) or [(_SECONDS_A_STEP, 1)], axis=0)
        return float(seconds / made)

    return sum(rate(algo) * n for algo, n in steps.items()) / max(workers, 1) / 3600


def finish(run: Run, patience: float = _GRACE) -> None:
    """Train, or go on, and evaluate.

    Args:
        run: what is to be finished.
        patience: s that another process may still hold it, saving it.

    Raises:
        KilledError: its process was; it goes on from its checkpoint when it is finished once more.
        RuntimeError: it could not be done; ``log.txt`` in the run's folder says why.
        ValueError: another process is at it, and goes on.
    """
    if run.finished:
        return
    run.folder.mkdir(parents=True, exist_ok=True)
    _wait_for_others(run, patience)
    if run.finished:
        return
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # the run's, and said below tables
    begun, took, here = time.time(), seconds_of(run) or 0.0, describe(_PACKAGES)
    demo, written = _digest(_demo_of(run)), begun
    _write_took(run, took, here, demo)
    process = get_context("spawn").Process(target=_train, args=(run,))
    process.start()
    try:
        while process.is_alive():
            process.join(1.0)  # Ray's way to interrupt waits for Python's own code
            if time.time() > written + _NOTED_EVERY:  # this process may be killed, too
                written = time.time()
                with suppress(OSError):  # the run itself outlives a disk that fails for a moment
                    _write_took(run, took + written - begun, here, demo)
    except BaseException:
        assert process.pid is not None
        os.kill(process.pid, signal.SIGINT)  # it saves itself
        process.join(_GRACE)
        raise
    finally:
        with suppress(OSError):
            _write_took(run, took + time.time() - begun, here, demo)
    if process.exitcode or not run.finished:
        from regil_sb3.checkpoint.callback import TRY_AGAIN

        status = process.exitcode or 0
        ended = f"{run.folder} ended with status {status}: see log.txt there"
        raise KilledError(ended) if status < 0 or status == TRY_AGAIN else RuntimeError(ended)


def _finish_there(run: Run) -> None:
    finish(run, _LOST)


def _wait_for_others(run: Run, patience: float) -> None:
    """Another process may still save it: its worker was lost, and this is the second one."""
    from regil_sb3.run_folder import locked

    end = time.monotonic() + patience
    while True:
        try:
            with locked(run.folder):
                return
        except ValueError:
            if time.monotonic() > end:
                raise
            time.sleep(1.0)


def _train(run: Run) -> None:
    """In a process of its own, whose output is the run's ``log.txt``."""
    os.setsid()  # Ctrl-C is for whoever waits for it, and passed on once
    if sys.platform == "linux":  # a run saves itself and ends where whoever waits for it is gone
        import ctypes

        ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG
    log = os.open(run.folder / "log.txt", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 1)
    os.dup2(log, 2)

    from regil_wrappers import Demonstration

    from regil_sb3 import process, training
    from regil_sb3.run_folder import locked
    from regil_sb3.settings import Settings

    process.keep_freed_memory()
    process.set_threads()
    if (config := run.folder / "config.yaml").exists():
        if not training.has_learned(run.folder, Settings.load(config, trust=True)):
            training.resume(run.folder)
    else:
        training.train(run.settings_now, Demonstration.load(run.demo), run.folder)
    only = ("policy", "best_policy", *dict(run.beside).values())
    with locked(run.folder):
        if not run.finished:
            training.evaluate_run(run.folder, run.episodes, trust=True, only=only)


def finish_all(
    runs: Sequence[Run],
    workers: int = 1,
    ray: str = "",
    cpus: float = 1,
    gpus: float = 0,
    memory: float = 0,
) -> list[str]:
    """Finish every run that is not; several at a time.

    Args:
        runs: all of them; finished ones cost nothing.
        workers: processes at a time, without Ray.
        ray: address of a Ray cluster, or "auto"; "local" starts one here. Its nodes must see the
            runs' folder under the same path. "": none.
        cpus: that Ray gives to a run; two of .5 share one.
        gpus: likewise.
        memory: GiB, likewise; 0 asks for none.

    Returns:
        one line for each run that could not be finished.

    Raises:
        ImportError: Ray is not installed.
        ValueError: no node of the cluster has a run's share, or a run was made with another
            demonstration.
        KeyboardInterrupt: passed on once all runs have saved themselves.
    """
    shares = Shares(cpus, gpus, memory)
    if min(shares) < 0:
        raise ValueError(f"a run cannot have {shares}: a share is 0 or more")
    todo = [run for run in runs if not run.finished]
    if ray and todo:
        connect(ray, shares)
    _record(todo)
    same_demonstrations(runs)
    if not todo:
        return []
    with tqdm(total=sum(run.steps for run in todo), unit="step", dynamic_ncols=True) as bar:

        def show() -> None:
            done = sum(run.finished for run in todo)
            bar.n = sum(_steps_done(run) for run in todo)
            bar.set_description_str(f"{done} of {len(todo)} runs", refresh=False)
            bar.refresh()

        bar.n = bar.initial = sum(_steps_done(run) for run in todo)
        if ray:
            there = [_absolute(run) for run in todo]  # workers have another current folder
            results = call_all(_finish_there, there, shares, show, _GRACE, (KilledError,))
        else:
            results = _here(todo, workers, show)
        return [
            f"{run.folder.name}: {error}" for run, error in zip(todo, results, strict=True) if error
        ]


def _record(runs: Sequence[Run]) -> None:
    """Make the demonstrations that are not there, once for all runs that share them."""
    from regil_sb3.recording import record_expert
    from regil_sb3.settings import encoder_size

    missing = {run.demo: run for run in runs if not Path(run.demo).exists()}
    for demo, run in tqdm(missing.items(), desc="demonstrations", disable=not missing):
        Path(demo).parent.mkdir(parents=True, exist_ok=True)
        settings = run.settings_now
        size = encoder_size(settings)
        record_expert(run.env, run.seed, settings.env_kwargs, size).save(demo)


def _absolute(run: Run) -> Run:
    root, demo = (str(Path(path).absolute()) for path in (run.root, run.demo))
    return replace(run, root=root, demo=demo)


def _steps_done(run: Run) -> int:
    """As far as its log says; it is written every few episodes."""
    if run.finished:
        return run.steps
    try:
        with (run.folder / "progress.csv").open(newline="") as file:
            steps = [row["time/total_timesteps"] for row in csv.DictReader(file)]
        return int(float(steps[-1]))
    except (OSError, KeyError, IndexError, ValueError):
        return 0


def _here(runs: Sequence[Run], workers: int, show: Callable[[], None]) -> list[str]:
    with ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(finish, run) for run in runs]
        try:
            while wait(futures, SHOWN_EVERY).not_done:
                show()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            begun = [future for future in futures if not future.cancelled()]
            told: set[int | None] = set()
            again = time.monotonic() + _GRACE
            while True:  # they save themselves
                try:
                    if not wait(begun, 0.2).not_done:
                        break
                    if time.monotonic() > again:
                        told, again = set(), again + _GRACE
                    for child in active_children():
                        if child.pid is not None and child.pid not in told:
                            with suppress(ProcessLookupError):
                                os.kill(child.pid, signal.SIGINT)
                            told.add(child.pid)
                except KeyboardInterrupt:  # once more: a save that takes long is broken off
                    told = set()
            raise
        show()
    return [str(future.exception() or "") for future in futures]
