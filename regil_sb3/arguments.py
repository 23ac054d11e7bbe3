"""What an algorithm's arguments may be."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

_CHOICES = {
    "bc_loss": ("mse", "nll"),
    "bc_schedule": ("time", "success"),
    "actor_q": ("min", "q1"),
}
_NUMBER = (int, float)
_RANGES: dict[str, tuple[tuple[type, ...], float, float]] = {
    "buffer_size": ((int,), 1, np.inf),
    "learning_starts": ((int,), 0, np.inf),
    "batch_size": ((int,), 1, np.inf),
    "tau": (_NUMBER, 0.0, 1.0),
    "gamma": (_NUMBER, 0.0, 1.0),
    "gradient_steps": (_NUMBER, -1, np.inf),
    "n_steps": ((int,), 1, np.inf),
    "policy_delay": ((int,), 1, np.inf),
    "target_policy_noise": (_NUMBER, 0.0, np.inf),
    "target_noise_clip": (_NUMBER, 0.0, np.inf),
    "warmup_steps": ((int,), 0, np.inf),
    "guide_again": (_NUMBER, 0.0, 1.0),
    "bc_coef": (_NUMBER, 0.0, np.inf),
    "bc_floor": (_NUMBER, 0.0, 1.0),
    "bc_std": (_NUMBER, 1e-6, np.inf),
    "bc_pretrain_steps": ((int,), 0, np.inf),
    "success_buffer_size": ((int,), 1, np.inf),
    "q_coef": (_NUMBER, 0.0, np.inf),
    "exploration_std": (_NUMBER, 0.0, np.inf),
    "exploration_clip": (_NUMBER, 0.0, np.inf),
}


def check_arguments(given: dict[str, Any]) -> None:
    """Refuse what TD3BC cannot work with, in one line, before anything is allocated.

    Args:
        given: its constructor's arguments by name.

    Raises:
        ValueError: a value is of the wrong kind, or out of range.
    """
    for name, choices in _CHOICES.items():
        if given[name] not in choices:
            raise ValueError(f"{name} is {given[name]!r}: use one of {', '.join(choices)}")
    for name, (kinds, least, most) in _RANGES.items():
        check_number(name, given[name], kinds, least, most)
    if given["reward_scale"] != "auto":
        check_number("reward_scale", given["reward_scale"], _NUMBER, 0.0, np.inf)
    elif given["gamma"] == 1:
        raise ValueError(
            "gamma=1 with reward_scale='auto', which is 10 * (1 - gamma), makes every reward 0: "
            "set reward_scale to a number"
        )
    if given["bc_steps"] is not None:
        check_number("bc_steps", given["bc_steps"], (int,), 1, np.inf)
    if not callable(given["learning_rate"]):
        check_number("learning_rate", given["learning_rate"], _NUMBER, 0.0, np.inf)
    unit = _check_train_freq(given["train_freq"])
    if unit != "step" and isinstance(given["gradient_steps"], float):
        raise ValueError(
            f"gradient_steps={given['gradient_steps']} counts updates per transition, and "
            f"train_freq={given['train_freq']} episodes: make gradient_steps a whole number (-1: "
            "one update a step), or train_freq one of steps"
        )
    check_device(given["device"])
    if given["q_coef"] == 0 and given["bc_coef"] == 0:
        raise ValueError("q_coef=0 and bc_coef=0 leave the actor nothing to learn from")


def _check_train_freq(train_freq: Any) -> str:
    """The unit that it counts in."""
    unit = "step"
    if isinstance(train_freq, tuple | list) and len(train_freq) == 2:
        train_freq, unit = train_freq
    check_number("train_freq", train_freq, (int,), 1, np.inf)
    if unit not in ("step", "episode"):
        raise ValueError(f"train_freq counts in {unit!r}: use 'step' or 'episode'")
    return unit


def check_action_space(name: str, env: Any) -> None:
    """Refuse an environment whose actions are no Box with finite limits, in one line.

    Args:
        name: of the algorithm.
        env: the environment; only its id says nothing yet.

    Raises:
        ValueError: naming the space.
    """
    space = getattr(env, "action_space", None)
    if space is not None and not (isinstance(space, spaces.Box) and space.is_bounded()):
        raise ValueError(f"the action space is {space}: {name} needs a Box with finite limits")


def check_device(device: Any) -> None:
    """Refuse a device that is not there, in one line."""
    if device == "auto":
        return
    try:
        kind = th.device(device).type
    except (RuntimeError, TypeError):
        raise ValueError(f"device is {device!r}: use 'auto', 'cpu' or 'cuda'") from None
    if kind == "cuda" and not th.cuda.is_available():
        raise ValueError(f"device is {str(device)!r} and no GPU is found: use 'cpu'")


def check_number(name: str, value: Any, kinds: tuple[type, ...], least: float, most: float) -> None:
    """Refuse what is no number of these kinds within [least, most], in one line."""
    fits = isinstance(value, (*kinds, np.integer)) and not isinstance(value, bool)
    if not fits or not least <= value <= most:
        kind = "a whole number" if kinds == (int,) else "a number"
        upper = f" and at most {most:g}" if most < np.inf else ""
        raise ValueError(f"{name} is {value!r}: it must be {kind} of at least {least:g}{upper}")
