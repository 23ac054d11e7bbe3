"""Guided replay, as tables measure it.

* ``TASKS`` - the paper's of Meta-World
* ``guides`` - arguments of each guide that exists
* ``env_id``, ``task_of``, ``benchmark``, ``env_kwargs``, ``check`` - environments by the names that
  tables take
* ``demonstration``, ``play``, ``follow`` - an episode of the expert's, and of a guide
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any

import gymnasium as gym
from regil_wrappers import Demonstration, RetrievalGuideWrapper
from regil_wrappers.encoders import make_encoder

import regil_sb3  # registers the environments  # noqa: F401
from regil_sb3.bench.cells import kind_of
from regil_sb3.envs import METAWORLD_TASKS
from regil_sb3.recording import check_seeds, record_expert
from regil_sb3.settings import make_settings

__all__ = [
    "TASKS",
    "benchmark",
    "check",
    "demonstration",
    "env_id",
    "env_kwargs",
    "follow",
    "guides",
    "play",
    "task_of",
]

TASKS = (
    "button-press",
    "door-open",
    "drawer-close",
    "drawer-open",
    "hammer",
    "window-close",
    "window-open",
)


def guides() -> dict[str, dict[str, Any]]:
    """Arguments of `RetrievalGuideWrapper` by the guide's name in tables.

    "plain" replays (preset ``plain``), "moved back" does on pictures that are moved back
    (``register``), "corrected" is the default preset's.
    """
    plain, corrected = (
        make_settings(env_id(TASKS[0]), name).guide or {} for name in ("plain", "default")
    )
    return {"plain": plain, "moved back": {**plain, "register": True}, "corrected": corrected}


def env_id(task: str) -> str:
    """Of one of Meta-World's tasks, or what is an id already."""
    return task if "/" in task else f"regil/metaworld-{task}-v0"


def task_of(env: str) -> str:
    """The name that `env_id` makes the id of."""
    task = env.removeprefix("regil/metaworld-").removesuffix("-v0")
    return task if env_id(task) == env else env


def benchmark(tasks: Iterable[str]) -> str:
    """Which of the paper's benchmarks all these tasks are of; "": of none, or of several."""
    kinds = {kind_of(env_id(task)) for task in tasks}
    return kinds.pop() if len(kinds) == 1 and kinds <= {"metaworld", "libero"} else ""


def env_kwargs(task: str) -> dict[str, Any]:
    """As `regil train` makes it: LIBERO's time limits depend on the task."""
    return make_settings(env_id(task)).env_kwargs


def check(tasks: Sequence[str], seeds: Sequence[int], **counts: int) -> None:
    """Refuse options of a table that cannot be measured.

    Args:
        tasks: of `env_id`.
        seeds: of demonstrations.
        **counts: by their options' names.

    Raises:
        ValueError: naming the option, its value, and what would be right.
    """
    for task in tasks:
        if env_id(task) not in gym.registry:
            known = ", ".join(METAWORLD_TASKS)
            raise ValueError(f"--tasks {task}: choose from {known}, or an environment's id")
    for seed in seeds:
        check_seeds(seed)
    different = {"tasks": len({*map(env_id, tasks)}), "seeds": len({*seeds})}
    for option, values in (("tasks", tasks), ("seeds", seeds)):
        if different[option] < len(values):
            raise ValueError(f"--{option} {' '.join(map(str, values))}: name each once")
    for option, count in counts.items():
        if count < 1:
            raise ValueError(f"--{option} {count}: at least 1 is needed")


@lru_cache(maxsize=1)
def demonstration(task: str, seed: int, encoder: str = "pixels") -> Demonstration:
    """The scripted expert's, with larger pictures where the encoder wants them.

    Args:
        task: of `env_id`.
        seed: the first that is tried.
        encoder: name of the one that the guide has.
    """
    size = getattr(make_encoder(encoder), "frame_size", None)
    demo = record_expert(env_id(task), seed, env_kwargs(task), size)
    if (of := demo.metadata["seed"]) != seed:
        warnings.warn(f"{task}: the expert fails at seed {seed}, {of} is taken", stacklevel=2)
    return demo


def play(env: RetrievalGuideWrapper[Any, Any], seed: int) -> bool:
    """Whether an episode that follows the guide succeeds."""
    env.reset(seed=seed)
    return follow(env)[0]


def follow(env: RetrievalGuideWrapper[Any, Any]) -> tuple[bool, int]:
    """Follow the guide to the episode's end: whether it succeeded, and agent steps."""
    steps, over, success = 0, False, False
    while not over:
        *_, terminated, truncated, info = env.step(env.guide_action())
        over = terminated or truncated
        success |= bool(info.get("is_success", False))  # on the way, too, as in evaluations
        steps += 1
    return success, steps
