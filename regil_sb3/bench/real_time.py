"""`regil bench real-time`: how regular control at 30 Hz is while a policy is learned.

The rehearsal robot by the wall clock, with irregular and lost pictures, in whole training runs: the
guide acts first, then the policy. Once the updates run beside control, and once in turn with it, as
`TD3BC` alone does. One after the other: whatever else runs on the machine is part of what is
measured.
"""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium as gym
import psutil
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack
from tqdm import tqdm

import regil_sb3  # registers the environments  # noqa: F401
from regil_sb3 import process
from regil_sb3.background import BackgroundTD3BC
from regil_sb3.bench.cells import Cell, below, finish, rows
from regil_sb3.bench.machine import hardware
from regil_sb3.bench.page import need_parquet, write
from regil_sb3.recording import check_seeds, record_expert
from regil_sb3.settings import make_settings
from regil_sb3.td3bc import TD3BC

__all__ = ["SIDES", "controlled", "main", "planned", "table"]

SIDES: dict[str, type[TD3BC]] = {"beside control": BackgroundTD3BC, "in turn": TD3BC}
"""Where the updates run."""

_HERTZ = 30
_TASKS = ("reach", "insert", "open")
_GUIDED = 0.2  # of the steps, where that is less than the preset's
_PICTURES: dict[str, Any] = {"jitter": 0.003, "dropped": 0.01}  # s; a share


class _Memory(BaseCallback):
    """MB of this process, once a minute of control; and how far it is."""

    def __init__(self, side: str, steps: int) -> None:
        super().__init__()
        self.megabytes: list[int] = []
        self.bar = tqdm(
            total=steps, desc=side, unit="step", position=1, leave=False, dynamic_ncols=True
        )

    def _on_step(self) -> bool:
        self.bar.update()
        if self.n_calls % (60 * _HERTZ) == 0:
            self.megabytes.append(round(psutil.Process().memory_info().rss / 1e6))
        return True


def controlled(task: str, seed: int, steps: int, side: str) -> dict[str, Any]:
    """Learn a task of the rehearsal robot by the wall clock.

    Args:
        task: reach, insert or open.
        seed: of demonstration, networks and sampling.
        steps: of control, guided ones included.
        side: of `SIDES`.

    Returns:
        ``steps``, ``missed`` deadlines, ``answer_ms`` (an observation to its action) and
        ``period_ms`` with median, p99 and max; ``updates``, ``megabytes`` after each minute,
        ``faults`` for which the watchdog stopped the arm, and ``recent_success`` of the last
        ``episodes``.
    """
    process.keep_freed_memory()
    process.set_threads()
    name = f"regil/rehearsal-{task}-v0"
    settings = make_settings(name, seed=seed)
    guided = min(round(_GUIDED * steps), settings.warmup_steps)
    demo = record_expert(name, seed, {"random_object": False})
    with tempfile.TemporaryDirectory() as folder:
        env: gym.Env[Any, Any] = gym.make(name, real_time=True, **_PICTURES, record_to=folder)
        times: Any = env.unwrapped
        demo.save(at := str(Path(folder) / "demo.hdf5"))
        for wrapper, arguments in settings.wrappers(at):
            env = wrapper(env, **arguments)
        envs = VecFrameStack(DummyVecEnv([lambda: Monitor(env)]), settings.frame_stack)
        model = SIDES[side](
            settings.policy,
            envs,
            demo=demo,
            seed=seed,
            **{**settings.hyperparams, "warmup_steps": guided},
        )
        memory = _Memory(side, steps)
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                model.learn(steps, memory)
        finally:
            memory.bar.close()
            envs.close()
    said = [str(warning.message) for warning in caught]
    recent = list(model.ep_success_buffer or ())
    return {
        **times.times.summary(),
        "updates": model._n_updates,
        "megabytes": memory.megabytes,
        "faults": [line for line in said if "stopped" in line],
        "recent_success": sum(map(bool, recent)),
        "episodes": len(recent),
    }


def _alone(*words: Any) -> dict[str, Any]:
    """What `controlled` says, in a process of its own: its memory is nobody else's."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(controlled, *words).result()


def planned(
    out: str = "bench",
    tasks: Sequence[str] = ("reach",),
    seeds: Sequence[int] = (0,),
    steps: int = 3_000,
) -> dict[tuple[str, str], list[Cell]]:
    """What is to be measured: by task and side, a cell for each seed.

    Args:
        out: folder in which cells are kept.
        tasks: of the rehearsal robot.
        seeds: of `controlled`.
        steps: likewise.

    Raises:
        ValueError: an option cannot be measured.
    """
    for task in tasks:
        if task not in _TASKS:
            raise ValueError(f"--tasks {task}: choose from {', '.join(_TASKS)}")
    for seed in seeds:
        check_seeds(seed)
    if steps < 1_000:
        raise ValueError(
            f"--steps {steps}: at least 1000 are needed, of which the first are guided"
        )
    plan: dict[tuple[str, str], list[Cell]] = {}
    for task in tasks:
        for side in SIDES:
            plan[task, side] = [
                Cell(
                    Path(out) / "cells",
                    {
                        "measured": "control in real time",
                        "machine": hardware(),  # one's times say nothing of another's
                        "env": f"regil/rehearsal-{task}-v0",
                        "seed": seed,
                        "steps": steps,
                        "updates": side,
                        "settings": asdict(make_settings(f"regil/rehearsal-{task}-v0", seed=seed)),
                        "pictures": _PICTURES,
                        "guided": _GUIDED,
                    },
                    partial(_alone, task, seed, steps, side),
                    steps / _HERTZ,
                )
                for seed in seeds
            ]
    return plan


def table(plan: dict[tuple[str, str], list[Cell]]) -> list[str]:
    """The table in Markdown: a line a run."""
    lines = [
        "| task | updates | seed | steps | updates made | control step, ms: median / 99 % / most | "
        "period, ms: median / 99 % / most | missed | arm stopped | MB | recent success |",
        "|" + "---|" * 11,
    ]
    for (task, side), cells in plan.items():
        for cell in cells:
            found = cell.found
            answer, period = (
                " / ".join(f"{found[name][at]:.3g}" for at in ("median", "p99", "max"))
                for name in ("answer_ms", "period_ms")
            )
            megabytes = found["megabytes"]
            values = (
                task,
                side,
                cell.asked["seed"],
                f"{found['steps']:,}",
                f"{found['updates']:,}",
                answer,
                period,
                found["missed"],
                len(found["faults"]),
                f"{megabytes[0]:,} to {megabytes[-1]:,}" if megabytes else "-",
                f"{found['recent_success']} of {found['episodes']}",
            )
            lines.append("| " + " | ".join(map(str, values)) + " |")
    return lines


def main(
    out: str = "bench",
    dry_run: bool = False,
    tasks: Sequence[str] = ("reach",),
    seeds: Sequence[int] = (0,),
    steps: int = 3_000,
) -> None:
    """Measure what is not kept, and print the table.

    Args:
        out: folder of kept cells, and of ``real-time.md``, ``.tex``, ``.parquet``.
        dry_run: print the cells and the predicted hours, and measure none.
        tasks: as for `planned`.
        seeds: likewise.
        steps: likewise.

    Raises:
        ValueError: an option cannot be measured.
        ImportError: pyarrow is not installed.
    """
    plan = planned(out, tasks, seeds, steps)
    cells = [cell for of in plan.values() for cell in of]
    if not dry_run:
        need_parquet("real-time")
    finish(cells, dry_run)
    if dry_run:
        return
    lines = table(plan)
    said = (
        f"The rehearsal robot at {_HERTZ} Hz by the wall clock, pictures 3 ms early or late and "
        f"1 % of them lost; the task's own preset, guided for at most a fifth of "
        f"the steps. MB after the first and after the last minute. "
        f"{below(cells)}"
    )
    options = {"tasks": tasks, "seeds": seeds, "steps": steps}
    write(Path(out), "real-time", options, lines, said, rows(cells))
    print("\n".join([*lines, "", said]))
