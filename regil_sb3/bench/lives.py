"""What `regil bench faults` does with learners: kills them for real, and spoils their numbers.

* ``chain`` - lives of a process that SIGKILL ends at random moments, until one comes to its end
* ``spoilt`` - NaN or infinity at a random place of a learner
"""

from __future__ import annotations

import math
import os
import signal
import tempfile
import time
import warnings
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from regil_sb3.bench.toy import Reach, digest, live, new_model, toy
from regil_sb3.checkpoint import CheckpointCallback

__all__ = ["PLACES", "chain", "life", "reference", "spoilt"]

_EVERY = 9  # steps between checkpoints
_PATIENCE = 60  # lives, at most, of a chain


def life(folder: Path, end: Path) -> None:
    """One life; its end is written to a file, if it comes."""
    th.set_num_threads(1)
    warnings.simplefilter("ignore")
    beside = end.with_suffix(".new")
    beside.write_text(digest(live(folder, toy(), _EVERY)))
    beside.rename(end)


def _process(folder: Path, end: Path) -> Any:
    context = get_context("forkserver")  # imports once, and has no threads
    context.set_forkserver_preload([__name__])
    process = context.Process(target=life, args=(folder, end))
    process.start()
    return process


def reference(folder: Path) -> tuple[str, float]:
    """How a life ends that is never killed, and how many seconds it takes."""
    begun = time.monotonic()
    process = _process(folder / "whole", folder / "end")
    process.join()
    return (folder / "end").read_text(), time.monotonic() - begun


def chain(number: int, expected: str, seconds: float) -> tuple[int, str]:
    """Kill a learner at random moments, and let it go on, until it comes to its end.

    Args:
        number: of the chain; its moments follow from it, and from how busy the machine is.
        expected: the end of a life that is never killed.
        seconds: that such a life takes.

    Returns:
        how often it was killed, and what went wrong: nothing where it ended the same, to the bit.
    """
    rng = np.random.default_rng(number)
    with tempfile.TemporaryDirectory() as name:
        folder, end = Path(name), Path(name) / "end"
        kills = 0
        for _ in range(_PATIENCE):
            process = _process(folder / "checkpoints", end)
            process.join(float(rng.uniform(0.1, 0.7)) * seconds)
            if process.is_alive():
                os.kill(process.pid, signal.SIGKILL)
                process.join()
            if end.exists():
                return kills, "" if end.read_text() == expected else "it ended otherwise"
            if process.exitcode != -signal.SIGKILL:
                return kills, f"it ended with status {process.exitcode}"
            kills += 1
        process = _process(folder / "checkpoints", end)  # a busy machine: let it end
        process.join()
        return kills, "" if end.exists() and end.read_text() == expected else "it ended otherwise"


class Poisoned(Reach):
    """The toy, which can be told to say a number that is none."""

    poison: dict[str, float]

    def step(self, action: Any) -> Any:
        """Go there."""
        seen, reward, *rest = super().step(action)
        seen["x"] = seen["x"] + self.poison.pop("observation", 0.0)
        return (seen, reward + self.poison.pop("reward", 0.0), *rest)


PLACES = ("reward", "observation", "parameter", "gradient")
"""Where a number is spoilt."""


class _Spoil(BaseCallback):
    def __init__(self, number: int) -> None:
        super().__init__()
        self.rng = np.random.default_rng(number)
        self.place = PLACES[number % len(PLACES)]
        self.value = (math.nan, math.inf, -math.inf)[number // len(PLACES) % 3]
        self.step = int(self.rng.integers(25, 70))

    def _on_step(self) -> bool:
        if self.num_timesteps != self.step:
            return True
        if self.place in ("reward", "observation"):
            self.training_env.get_attr("unwrapped")[0].poison[self.place] = self.value
            return True
        policy: Any = self.model.policy
        networks = {"parameter": policy, "gradient": policy.critic}
        parameters = [p for p in networks[self.place].parameters() if p.requires_grad]
        chosen = parameters[int(self.rng.integers(len(parameters)))]
        at = int(self.rng.integers(chosen.numel()))
        if self.place == "parameter":
            with th.no_grad():
                chosen.view(-1)[at] = self.value
        else:

            def spoil(gradient: th.Tensor) -> th.Tensor:
                spoilt = gradient.clone()
                spoilt.view(-1)[at] = self.value
                return spoilt

            chosen.register_hook(spoil)
        return True


def spoilt(number: int) -> str:
    """Spoil one number of a learner: it must end, say so, and leave a checkpoint that is whole.

    Returns:
        nothing where it did; else what went wrong.
    """
    warnings.simplefilter("ignore")

    def model() -> Any:
        Poisoned.poison = {}
        env = toy(env=Poisoned, dict_obs=True)
        own = {"demo": None, "bc_coef": 0.0, "n_steps": 1, "warmup_steps": 10}
        return new_model(env, "MultiInputPolicy", **own)

    spoil = _Spoil(number)
    with tempfile.TemporaryDirectory() as folder:
        try:
            model().learn(100, [CheckpointCallback(folder, steps=10), spoil])
            return f"{spoil.value} in {spoil.place} at step {spoil.step} was not noticed"
        except FloatingPointError as error:
            if "step" not in str(error) or len(str(error).splitlines()) != 1:
                return f"not one line with its step: {error}"
        again = model()
        step = CheckpointCallback(folder).restore(again)
        sound = all(bool(th.isfinite(p).all()) for p in again.policy.parameters())
        return "" if sound and 0 < step <= spoil.step + 10 else f"its checkpoint of step {step}"
