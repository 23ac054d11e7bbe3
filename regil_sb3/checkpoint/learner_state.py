"""All that decides how a run of TD3BC goes on, as one tree of values for `checkpoint.snapshot`.

* ``learner_state``, ``load_learner_state`` - networks, optimisers, buffers, generators, counters,
  and the episodes under way

Between two steps: where SB3 calls ``on_rollout_start``.
"""

from __future__ import annotations

import random
from collections import deque
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, unwrap_vec_wrapper

from regil_sb3.baselines.offline import Offline
from regil_sb3.checkpoint.snapshot import Ring
from regil_sb3.relabelling import (
    EpisodeRewardDictReplayBuffer,
    EpisodeRewardNStepReplayBuffer,
    EpisodeRewardReplayBuffer,
    EpisodeRewards,
)
from regil_sb3.replay_buffer import FrameReplayBuffer, truncate_newest
from regil_sb3.td3bc import TD3BC
from regil_sb3.vec_env import VecRetrievalGuide, VecRetrievalReward

__all__ = ["check_can_be_kept", "learner_state", "load_learner_state"]

_COUNTERS = (
    "num_timesteps",
    "_episode_num",
    "_n_updates",
    "_updates_due",
    "_current_progress_remaining",
    "pretrained",
    "_returns",
    "_last_obs",
    "_last_episode_starts",
    "soft_q",  # ROT's
    "_owed",  # BackgroundTD3BC's
)
_OF_SB3 = (
    ReplayBuffer,
    NStepReplayBuffer,
    DictReplayBuffer,
    EpisodeRewardReplayBuffer,
    EpisodeRewardNStepReplayBuffer,
    EpisodeRewardDictReplayBuffer,
)
_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def check_can_be_kept(model: TD3BC) -> None:
    """Refuse what a checkpoint would not bring back, before any training.

    Raises:
        ValueError: naming it.
    """
    if isinstance(model, Offline):
        raise ValueError(
            f"a checkpoint cannot hold a {type(model).__name__}, which makes no steps: leave it "
            "out, and save the model"
        )
    if model.get_vec_normalize_env() is not None:
        raise ValueError("a checkpoint holds no VecNormalize: leave it out")
    noise = model.action_noise
    if isinstance(noise, VectorizedActionNoise):
        noise = noise.base_noise
    if noise is not None and type(noise) is not NormalActionNoise:
        raise ValueError(
            f"a checkpoint cannot hold the state of a {type(noise).__name__}: use "
            "NormalActionNoise, or exploration_std"
        )
    buffer = model.replay_buffer
    if not (isinstance(buffer, FrameReplayBuffer) or type(buffer) in _OF_SB3):
        raise ValueError(
            f"a checkpoint cannot hold a {type(buffer).__name__}: use FrameReplayBuffer, SB3's own "
            "or those of regil_sb3.relabelling"
        )


def learner_state(model: TD3BC) -> dict[str, Any]:
    """All that decides how learning goes on; arrays are not copied."""
    assert model.env is not None
    assert model.ep_info_buffer is not None
    assert model.ep_success_buffer is not None
    return {
        "fits": _fits(model),
        "parameters": model.get_parameters(),
        "counters": {name: getattr(model, name) for name in _COUNTERS if hasattr(model, name)},
        "recent": [list(model.ep_info_buffer), list(model.ep_success_buffer)],
        "schedule": model._by_success.state(),
        "collection": model._collection.state(),
        "success": model.success_buffer.state(),
        "replay": _replay_state(model.replay_buffer),
        "environments": _environments_state(model.env),
        "generators": {
            "python": random.getstate(),
            "numpy": np.random.get_state(),
            "torch": th.get_rng_state(),
            "cuda": th.cuda.get_rng_state_all() if th.cuda.is_available() else [],
            "actions": model.action_space.np_random.bit_generator.state,
        },
    }


def load_learner_state(model: TD3BC, state: dict[str, Any]) -> list[str]:
    """Take over what ``learner_state`` gave, into a new model in new environments.

    Go on with ``learn(..., reset_num_timesteps=False)``.

    Returns:
        why open episodes could not be brought back, one line for each environment: all are ended as
        truncated then. Nothing where they could.

    Raises:
        ValueError: the state is of another model or of other environments.
    """
    assert model.env is not None
    if state["fits"] != _fits(model):
        raise ValueError(
            f"the checkpoint is of {state['fits']}, and this is {_fits(model)}: make model and "
            "environments with the same arguments"
        )
    try:
        model.set_parameters(state["parameters"], device=model.device)
    except (RuntimeError, ValueError) as error:
        raise ValueError(
            f"the checkpoint is of other networks: {str(error).splitlines()[0]}"
        ) from error
    for name, value in state["counters"].items():
        setattr(model, name, value)
    recent = state["recent"]
    model.ep_info_buffer, model.ep_success_buffer = (
        deque(values, maxlen=model._stats_window_size) for values in recent
    )
    model._by_success.load_state(state["schedule"])
    model._collection.load_state(state["collection"])
    model.success_buffer.load_state(state["success"])
    _load_replay_state(model.replay_buffer, state["replay"])
    lost = _load_environments_state(model.env, state["environments"])
    if lost:
        model._last_obs = None  # so learn() resets the environments and closes the episodes
        if isinstance(model.replay_buffer, ReplayBuffer):
            truncate_newest(model.replay_buffer)
        if isinstance(model.replay_buffer, EpisodeRewards):
            model.replay_buffer.forget_open_episodes()
    generators = state["generators"]
    random.setstate(_tuples(generators["python"]))
    np.random.set_state(generators["numpy"])
    th.set_rng_state(generators["torch"])
    if th.cuda.is_available() and generators["cuda"]:
        # of the devices that there are; there may have been more
        th.cuda.set_rng_state_all(generators["cuda"][: th.cuda.device_count()])
    model.action_space.np_random.bit_generator.state = generators["actions"]
    return lost


def _fits(model: TD3BC) -> dict[str, Any]:
    buffer = model.replay_buffer
    assert buffer is not None
    return {
        "observations": str(model.observation_space),
        "actions": str(model.action_space),
        "environments": model.n_envs,
        "replay buffer": f"{type(buffer).__name__} of {buffer.buffer_size}",
    }


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list | tuple) else value


# -- buffers -------------------------------------------------------------------------------------


def _replay_state(buffer: Any) -> dict[str, Any]:
    state: dict[str, Any]
    if isinstance(buffer, FrameReplayBuffer):
        state = dict(buffer.state())
        state["frames"] = Ring(buffer.state()["frames"], buffer.total, buffer.n_frames)
    else:
        # Where next observations are not stored apart, one more row is in use
        rows = min(buffer.pos + 1, buffer.buffer_size)
        rows = buffer.buffer_size if buffer.full else rows
        state = {"pos": buffer.pos, "full": buffer.full, "arrays": {}}
        for name in _ARRAYS:
            held = getattr(buffer, name, None)  # no next_observations to save memory
            state["arrays"][name] = (
                {key: values[:rows] for key, values in held.items()}
                if isinstance(held, dict)
                else held
                if held is None
                else held[:rows]
            )
    if isinstance(buffer, EpisodeRewards):
        return {"buffer": state, "open": buffer._open, "scale": buffer.scale}
    return {"buffer": state}


def _load_replay_state(buffer: Any, state: dict[str, Any]) -> None:
    own = state["buffer"]
    if isinstance(buffer, FrameReplayBuffer):
        buffer.load_state(own)
    else:
        buffer.pos, buffer.full = own["pos"], own["full"]
        for name, values in own["arrays"].items():
            held: Any = getattr(buffer, name, None)
            for into, kept in (
                [(held[key], values[key]) for key in values]
                if isinstance(held, dict)
                else [(held, values)]
            ):
                if kept is not None:
                    into[: len(kept)] = kept
    if isinstance(buffer, EpisodeRewards):
        buffer._open, buffer.scale = state["open"], state["scale"]


# -- environments --------------------------------------------------------------------------------


def _stacks(env: VecEnv) -> list[Any]:
    """What ``VecFrameStack`` holds of the last frames."""
    stacking = unwrap_vec_wrapper(env, VecFrameStack)
    if not isinstance(stacking, VecFrameStack):
        return []
    stacked = stacking.stacked_obs
    subs = getattr(stacked, "sub_stacked_observations", None)
    return [stacked] if subs is None else list(subs.values())


def _retrieves_outside(env: VecEnv) -> bool:
    """Whether alignments are kept outside the single environments, whose replay misses them."""
    kinds = (VecRetrievalGuide, VecRetrievalReward)
    return any(unwrap_vec_wrapper(env, kind) is not None for kind in kinds)


def _environments_state(env: VecEnv) -> dict[str, Any]:
    if env.has_attr("episode_state") and not _retrieves_outside(env):
        return {
            "stacks": [s.stacked_obs for s in _stacks(env)],
            "open": env.env_method("episode_state"),
        }
    return {
        "open": None,
        "generators": [generator.bit_generator.state for generator in env.get_attr("np_random")],
        "lasting": (
            env.env_method("lasting_state")
            if env.has_attr("lasting_state")
            else [None] * env.num_envs
        ),
    }


def _load_environments_state(env: VecEnv, state: dict[str, Any]) -> list[str]:
    env.unwrapped._reset_seeds()  # those of a new run, which the next reset would take
    outside = _retrieves_outside(env)
    if state["open"] is not None and env.has_attr("go_back") and not outside:
        for stack, kept in zip(_stacks(env), state["stacks"], strict=True):
            stack.stacked_obs = kept
        why = [_replay(env, i, episode) for i, episode in enumerate(state["open"])]
        return [f"environment {i}: {line}" for i, line in enumerate(why) if line]
    if state["open"] is not None:
        state = {
            "generators": [episode["now"]["generator"] for episode in state["open"]],
            "lasting": [episode["now"]["lasting"] for episode in state["open"]],
        }
    for i, (generator, lasting) in enumerate(
        zip(state["generators"], state["lasting"], strict=True)
    ):
        fresh = np.random.Generator(getattr(np.random, generator["bit_generator"])())
        fresh.bit_generator.state = generator
        env.set_attr("np_random", fresh, indices=i)
        if lasting is not None:
            env.env_method("set_lasting_state", lasting, indices=i)
    if outside:
        return ["no episode inside VecRetrievalGuide or VecRetrievalReward can be done again"]
    return ["its environment is no ReplayableEpisode (regil_sb3.checkpoint.open_episode)"]


def _replay(env: VecEnv, i: int, episode: dict[str, Any]) -> str:
    """Do an episode again; how it differs, if it does."""
    before = episode["begin"]
    env.env_method("go_back", episode, indices=i)
    # of the outermost wrapper, whose state is brought back, too
    env.env_method("reset", seed=before["seed"], options=before["options"], indices=i)
    for action in episode["actions"]:
        _, _, terminated, truncated, _ = env.env_method("step", action, indices=i)[0]
        if terminated or truncated:
            break
    return str(env.env_method("how_it_differs", episode, indices=i)[0])
