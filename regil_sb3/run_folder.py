"""The files of a run folder: each is replaced at once, and never left half written."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import CSVOutputFormat
from stable_baselines3.common.vec_env import VecEnv

from regil_sb3.files import replacing
from regil_sb3.replay_buffer import FrameReplayBuffer
from regil_sb3.success_buffer import SuccessBuffer
from regil_sb3.td3bc import TD3BC


def refuse_finished(run: Path) -> None:
    """Never write over a run.

    Raises:
        ValueError: the folder holds one.
    """
    if (run / "config.yaml").exists():
        raise ValueError(
            f"{run} holds a run already: choose another --out, or go on with --resume {run}"
        )


def save_model(model: BaseAlgorithm, path: Path) -> None:
    """Save a model; the old file stays until the new one is complete."""
    with replacing(path) as file:
        model.save(file)


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
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is damaged ({error}): remove it") from error
    env.env_method("set_calibration", found)
    return True


def save_buffers(model: TD3BC, path: Path) -> None:
    """Save what ``resume`` needs; SB3's own replay buffers (no images) have no such form."""
    if not isinstance(model.replay_buffer, FrameReplayBuffer):
        return
    buffers = {"success": model.success_buffer.state(), "replay": model.replay_buffer.state()}
    arrays: dict[str, Any] = {
        f"{name}/{k}": v for name, state in buffers.items() for k, v in state.items()
    }
    with replacing(path) as file:
        np.savez(file, **arrays)


def load_buffers(model: TD3BC, path: Path) -> None:
    """Give a model what ``save_buffers`` kept."""
    with np.load(path, allow_pickle=False) as arrays:
        for name, buffer in (("success", model.success_buffer), ("replay", model.replay_buffer)):
            prefix = f"{name}/"
            state = {k.removeprefix(prefix): arrays[k] for k in arrays if k.startswith(prefix)}
            if state:
                assert isinstance(buffer, SuccessBuffer | FrameReplayBuffer)
                buffer.load_state(state)


class AppendingCSV(CSVOutputFormat):
    """SB3's CSV log, which goes on where an earlier part of the run stopped."""

    def __init__(self, path: Path) -> None:
        old = path.read_text(encoding="utf-8") if path.exists() else ""
        super().__init__(str(path))
        if old:
            self.keys = old.splitlines()[0].split(",")
            self.file.write(old)
            self.file.flush()


def best_so_far(log: Path) -> float:
    """The best evaluation of an earlier part of the run, or -1."""
    if not log.exists():
        return -1.0
    with log.open(encoding="utf-8", newline="") as file:
        rates = [row.get("eval/success_rate") or -1 for row in csv.DictReader(file)]
    return max(map(float, rates), default=-1.0)
