"""What a run takes of memory and time.

* ``check_cost`` - measured on a learner as the settings describe it

The learner lives in an environment whose steps cost next to nothing: how long an update takes does
not depend on what is seen. Steps of the real environment are timed where episodes are played.
"""

from __future__ import annotations

import inspect
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
import psutil
from gymnasium import spaces
from regil_wrappers import Demonstration
from regil_wrappers.reward_signals import AT_EPISODE_END
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack

from regil_sb3.baselines import BAKU, Offline
from regil_sb3.doctor.findings import Finding
from regil_sb3.settings import ALGOS, RETRIEVAL, Settings
from regil_sb3.td3bc import TD3BC

__all__ = ["check_cost"]

_EPISODE = 20  # steps in the stand-in
_STEPS = 4  # that are timed together: two updates of the default's
_UNABLE = (
    *(TypeError, ValueError, RuntimeError, ArithmeticError, MemoryError),
    *(AssertionError, AttributeError),  # Stable-Baselines3's own of a network's arguments
)
_ENOUGH, _MOST = 1.0, 40  # seconds and calls that one measurement takes; at least one call
_BUSY = 0.8  # of a core: a learner that gets less is slower than it could be


class _StandIn(gym.Env[Any, Any]):
    """Shows the same at every step, and ends its episodes.

    Args:
        observation_space: of what is shown.
        action_space: whose actions do nothing.
    """

    def __init__(self, observation_space: spaces.Space[Any], action_space: spaces.Box) -> None:
        self.observation_space, self.action_space = observation_space, action_space
        self._shown = observation_space.sample()
        self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        return self._shown, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Count, no more."""
        self._steps += 1
        return self._shown, -1.0, False, self._steps % _EPISODE == 0, {}


@dataclass(frozen=True)
class _Learning:
    """What a learner costs.

    Attributes:
        step: seconds of a transition without the environment's: the policy acts, what came of it is
            stored, and its share of the updates is made. Offline, of an update.
        act: seconds of one action of the policy.
        share: of one processor core that the learner had meanwhile, at most 1.
        offline: whether it learns from the demonstration alone, and has none of the rest.
        transition: bytes in the replay buffer.
        transitions: that the replay buffer takes.
        first: seconds of one of the updates by behaviour cloning alone, before the policy acts.
        firsts: how many of those are made.
        kept: bytes of a full success buffer.
    """

    step: float
    act: float
    share: float
    offline: bool = True
    transition: float = 0.0
    transitions: int = 0
    first: float = 0.0
    firsts: int = 0
    kept: int = 0


def check_cost(
    env: gym.Env[Any, Any], demo: Demonstration, settings: Settings, seconds: float, longest: int
) -> list[Finding]:
    """Memory and time that a run takes, and what of it is not counted.

    Args:
        env: as the retrieval wrappers get it; it is not stepped.
        demo: the demonstration.
        settings: of the run.
        seconds: of a step of environment and retrieval.
        longest: steps that an episode lasts where nothing succeeds.

    Returns:
        findings "memory" and "time"; "memory" is wrong where it is not there.
    """
    left_out = []
    if settings.retrieval("reward") in AT_EPISODE_END:
        left_out.append("the reward, which comes at an episode's end")
    try:
        try:
            learning = _measured(env, demo, settings, {})
        except ValueError as error:
            learning = _measured(env, None, settings, {"bc_coef": 0.0})
            left_out.append(f"behaviour cloning ({error})")
    except _UNABLE as error:  # TypeError: an argument that the policy does not have
        line = (
            f"{settings.steps:,} steps of environment and retrieval, {1000 * seconds:.0f} ms each, "
            f"take {_minutes(settings.steps * seconds)}; learning could not begin with these "
            f"settings: {error or type(error).__name__}"
        )
        return [Finding("time", "warning", line)]
    return [_memory(learning, settings), _time(learning, settings, seconds, longest, left_out)]


def _memory(learning: _Learning, settings: Settings) -> Finding:
    process, free = psutil.Process().memory_info().rss, psutil.virtual_memory().available
    full = learning.transition * learning.transitions
    filled = learning.transition * min(learning.transitions, settings.steps)
    parts = [f"this process with a learner {process / 1e9:.2f}"]
    if not learning.offline:
        later = f" ({full / 1e9:.2f} at {learning.transitions:,})" if full > filled else ""
        parts.append(f"replay buffer {filled / 1e9:.2f}{later}")
    if learning.kept:
        parts.append(f"success buffer up to {learning.kept / 1e9:.2f}")
    envs = settings.n_envs + bool(settings.eval_episodes)
    more = f"{envs - 1} more environment{'s' * (envs > 2)}, as training has {envs}"
    left_out = f"; not counted: {more}" if envs > 1 else ""
    line = (
        f"{(process + filled + learning.kept) / 1e9:.2f} GB after {settings.steps:,} steps: "
        f"{', '.join(parts)}; {free / 1e9:.1f} GB are free{left_out}"
    )
    if learning.kept > 0.8 * free:
        most = max(int(0.5 * _setting(settings, "success_buffer_size") * free / learning.kept), 1)
        return Finding("memory", "wrong", f"{line}: set success_buffer_size to at most {most}")
    if full + learning.kept > free:
        most = max(int(0.8 * learning.transitions * (free - learning.kept) / full), 1)
        return Finding("memory", "wrong", f"{line}: set buffer_size to at most {most}")
    return Finding("memory", "ok", line)


def _time(
    learning: _Learning, settings: Settings, seconds: float, longest: int, left_out: list[str]
) -> Finding:
    played = 0.0 if learning.offline else settings.steps * seconds
    learned = settings.steps * learning.step
    first = learning.firsts * learning.first
    every, warmup = settings.eval_every, settings.warmup_steps
    # After the warm-up, and then from time to time
    episodes = (1 + settings.steps // every - warmup // every) * settings.eval_episodes
    judged = episodes * longest * (seconds + learning.act)
    parts = [f"{'updates' if learning.offline else 'learner'} {1000 * learning.step:.1f} ms a step"]
    parts[0] += f" ({_minutes(learned)})"
    if not learning.offline:
        each = f"{1000 * seconds:.1f} ms a step ({_minutes(played)})"
        parts.insert(0, f"environment and retrieval {each}")
    if learning.firsts:
        each = f"{1000 * learning.first:.1f} ms each ({_minutes(first)})"
        parts.append(f"{learning.firsts:,} updates by behaviour cloning before, {each}")
    if episodes:
        parts.append(
            f"{episodes} episodes that the policy is evaluated in, up to {longest} steps each (up "
            f"to {_minutes(judged)})"
        )
    least = played + learned + first
    left = ", ".join([*left_out, "the evaluation after it"])
    most = f" to {_minutes(least + judged)}" if episodes else ""
    line = (
        f"{settings.steps:,} steps take {_minutes(least)}{most}: "
        f"{', '.join(parts)}; not counted: {left}"
    )
    if learning.share < _BUSY:
        line += (
            f"; the machine is busy: the learner had {learning.share:.0%} of a core, and with one "
            f"to itself would need {_minutes(learning.share * (learned + first))} of this"
        )
    return Finding("time", "ok", line)


def _minutes(seconds: float) -> str:
    return f"{seconds / 60:.{0 if seconds >= 600 else 1}f} min"


def _measured(
    env: gym.Env[Any, Any], demo: Demonstration | None, settings: Settings, changes: dict[str, Any]
) -> _Learning:
    """Let the settings' learner learn for a moment.

    Args:
        env: whose spaces it has.
        demo: that it clones.
        settings: of the run.
        changes: of its hyperparameters.

    Raises:
        TypeError: the policy does not take an argument.
        ValueError: learner, environment and demonstration do not fit.
    """
    algorithm: Any = ALGOS[settings.algo]
    known = inspect.signature(algorithm).parameters
    changes = {
        # It learns and acts from the first step on, and the actor's loss has both its terms
        **{"buffer_size": 1_000, "warmup_steps": 0, "learning_starts": 0, "bc_pretrain_steps": 0},
        **{"bc_schedule": "time"},
        **changes,
    }
    changes = {name: value for name, value in changes.items() if name in known}
    stand_in = _stand_in(env, settings)
    model: TD3BC | BAKU = algorithm(
        settings.policy, stand_in, demo=demo, **{**settings.hyperparams, **changes}
    )
    model.set_logger(Logger(None, []))
    model.learn(1)  # begins an episode; what follows goes on with it

    def more() -> int:
        before = model.num_timesteps
        model.learn(_STEPS, reset_num_timesteps=False)
        return model.num_timesteps - before

    begun, busy = time.perf_counter(), time.process_time()
    step = _seconds(more) / more()
    assert model.env is not None
    shown: Any = model.env.reset()
    act = _seconds(lambda: model.predict(shown, deterministic=True)) / settings.n_envs
    share = min((time.process_time() - busy) / (time.perf_counter() - begun), 1.0)
    if not isinstance(model, TD3BC) or isinstance(model, Offline):
        return _Learning(step, act, share)
    held: Any = model.replay_buffer
    online = _Learning(
        step,
        act,
        share,
        offline=False,
        transition=_nbytes(vars(held)) / (held.buffer_size * settings.n_envs),
        transitions=_setting(settings, "buffer_size"),
    )
    if model.bc_coef == 0:
        return online
    return replace(
        online,
        first=_seconds(lambda: model.pretrain_bc(1)),
        firsts=_setting(settings, "bc_pretrain_steps"),
        kept=model.success_buffer.capacity * _bytes_kept(model),
    )


def _stand_in(env: gym.Env[Any, Any], settings: Settings) -> VecEnv:
    """As many as the run has, in the wrappers that belong outside those of retrieval."""
    wrappers = settings.wrappers("")
    inside = [i for i, (wrapper, _) in enumerate(wrappers) if wrapper in RETRIEVAL.values()]
    outside = wrappers[inside[-1] + 1 :] if inside else []

    def make() -> gym.Env[Any, Any]:
        assert isinstance(env.action_space, spaces.Box)
        made: gym.Env[Any, Any] = _StandIn(env.observation_space, env.action_space)
        for wrapper, arguments in outside:
            if "demo" not in arguments:  # such a one chooses where episodes begin
                made = wrapper(made, **arguments)
        return made

    made: VecEnv = DummyVecEnv([make] * settings.n_envs)
    return made if settings.frame_stack == 1 else VecFrameStack(made, settings.frame_stack)


def _seconds(once: Callable[[], Any]) -> float:
    """Mean seconds of a call; the first one is not counted."""
    once()
    begun, calls = time.perf_counter(), 0
    while calls < _MOST and (not calls or time.perf_counter() - begun < _ENOUGH):
        once()
        calls += 1
    return (time.perf_counter() - begun) / calls


def _setting(settings: Settings, name: str) -> int:
    default = inspect.signature(ALGOS[settings.algo]).parameters[name].default
    return int(settings.hyperparams.get(name, default))


def _nbytes(held: dict[Any, Any]) -> int:
    """Bytes of the arrays among values, and among values of dicts of them."""
    return sum(
        _nbytes(value) if isinstance(value, dict) else value.nbytes
        for value in held.values()
        if isinstance(value, dict | np.ndarray)
    )


def _bytes_kept(model: TD3BC) -> int:
    """Bytes of a step in the success buffer: its newest observation, and an action of float32."""
    seen = model.observation_space.sample()
    parts = seen.values() if isinstance(seen, dict) else [seen]
    n_stack = model.n_stack if is_image_space(model.observation_space) else 1
    assert model.action_space.shape is not None
    action = 4 * math.prod(model.action_space.shape)
    return sum(np.asarray(part).nbytes for part in parts) // n_stack + action
