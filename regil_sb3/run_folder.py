"""The files of a run folder: each is replaced at once, and never left half written."""

from __future__ import annotations

import csv
import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from regil_sb3.checkpoint.generations import Generations
from regil_sb3.files import replacing
from regil_sb3.model_file import checked_model
from regil_sb3.watch import require_finite_parameters


def refuse_finished(run: Path) -> None:
    """Never write over a run.

    Raises:
        ValueError: the folder holds one.
    """
    if (run / "config.yaml").exists():
        raise ValueError(
            f"{run} holds a run already: choose another --out, or go on with --resume {run}"
        )


def refuse_unwritable(run: Path) -> None:
    """Find out before long work that its outcome could not be kept.

    Raises:
        ValueError: nothing can be written in the folder.
    """
    try:
        with tempfile.TemporaryFile(dir=run) as file:
            file.write(bytes(1 << 16))
            file.flush()
    except OSError as error:
        raise ValueError(
            f"nothing can be written in {run} ({error.strerror}): make room, or use a copy of it "
            "that is your own"
        ) from error


def save_model(model: BaseAlgorithm, path: Path) -> None:
    """Save a model; the old file stays until the new one is complete.

    Raises:
        FloatingPointError: a parameter is not finite; the old file stays.
    """
    require_finite_parameters(model)
    with replacing(path) as file:
        model.save(file)


def steps_learned(path: Path) -> int:
    """For how many steps a saved model has learned.

    Raises:
        ValueError: it is no model, or damaged.
    """
    with checked_model(path) as file, zipfile.ZipFile(file) as archive:
        return int(json.loads(archive.read("data"))["num_timesteps"])


def save_calibration(env: VecEnv, path: Path) -> None:
    """Keep what a correcting guide has learned; nothing where there is none yet."""
    if not env.has_attr("calibration"):
        return
    found = [c for c in env.env_method("calibration") if c is not None]
    if found:
        with replacing(path) as file:
            file.write(json.dumps(found[0], indent=1).encode())


def load_calibration(env: VecEnv, path: Path) -> bool:
    """Give every guide what ``save_calibration`` kept; whether there was such a file.

    Raises:
        ValueError: the file is damaged, or from another camera.
    """
    if not path.exists():
        return False
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged ({error}): remove it") from error
    env.env_method("set_calibration", found)
    return True


def refuse_removed(run: Path, step: int) -> None:
    """End learning where its folder has gone: nothing could go on from it.

    Raises:
        FileNotFoundError: the folder, or its settings, are not there.
    """
    if not (run / "config.yaml").exists():
        raise FileNotFoundError(
            f"{run} was removed, or can no longer be read, at step {step}: training stopped, and "
            "cannot go on without the folder"
        )


def checkpoints_of(run: Path) -> Path:
    """Where a run's checkpoints are until it has ended."""
    return run / "checkpoints"


def has_checkpoint(run: Path) -> bool:
    """Whether there is one to go on from."""
    return bool(Generations(checkpoints_of(run)).numbers)


def forget_checkpoints(run: Path) -> None:
    """Training has ended: remove them, in one step."""
    old = run / ".checkpoints"
    shutil.rmtree(old, ignore_errors=True)
    if checkpoints_of(run).exists():
        checkpoints_of(run).rename(old)
        shutil.rmtree(old)


@contextmanager
def locked(run: Path) -> Iterator[None]:
    """Let no other process write in the folder meanwhile; a killed one locks nothing.

    Raises:
        ValueError: another one does.
        ImportError: on Windows.
    """
    try:
        import fcntl
    except ImportError as error:
        raise ImportError("a run folder needs Linux or macOS: on Windows, use WSL") from error
    with (run / ".lock").open("a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            raise ValueError(
                f"process {file.read().strip()} is learning in {run}: wait for it, or choose "
                "another --out"
            ) from error
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        yield


def best_so_far(log: Path) -> float:
    """The best evaluation of an earlier part of the run, or -1."""
    if not log.exists():
        return -1.0
    with log.open(encoding="utf-8", newline="") as file:
        rates = [row.get("eval/success_rate") or -1 for row in csv.DictReader(file)]
    return max(map(float, rates), default=-1.0)
