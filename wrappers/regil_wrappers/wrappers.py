"""Wrappers that hold an environment beside one demonstration.

* ``RetrievalGuideWrapper`` - says which action the demonstrator took here
* ``RetrievalRewardWrapper`` - replaces the reward by how well recent frames follow the demonstration

Both put an alignment into ``info["retrieval"]``. Stacked, in either order, they share one `Retriever`.
Frame stacking belongs outside them, action repeat and time limits inside.
"""

from __future__ import annotations

import os
from typing import Any, Literal, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.core import ActType, ObsType
from numpy.typing import NDArray

from regil_wrappers.alignment import StepPattern
from regil_wrappers.demonstration import Demonstration
from regil_wrappers.encoders import Encoder
from regil_wrappers.retrieval import Alignment, Retriever, check_settings
from regil_wrappers.rewards import demonstration_tau, sdtw_reward

__all__ = ["RetrievalGuideWrapper", "RetrievalRewardWrapper"]

Demo = str | os.PathLike[str] | Demonstration

# Settings of the environment that decide what its frames look like. Environments of ours state them.
_SAME_AS_RECORDED = ("camera", "render", "image_size", "action_repeat")

# When a first frame counts as turned: pixels of a 28 x 28 picture that differ by more than _DIFFERENT
# (of 255, in any channel). Objects elsewhere than in the demonstration change few of them, a turned picture
# most; a swap of colour channels cannot be mistaken for an object that moved, and may change fewer.
_DIFFERENT = 25
_TURNED = 0.25
_SWAPPED = 0.05


class _RetrievalWrapper(gym.Wrapper[ObsType, ActType, ObsType, ActType]):
    """What both wrappers share: one retriever, fed with each new frame by the innermost of them."""

    def __init__(
        self,
        env: gym.Env[ObsType, ActType],
        demo: Demonstration,
        label: str,
        encoder: str | Encoder,
        k: int,
        horizon: int,
        image: str,
        step_pattern: StepPattern,
    ) -> None:
        settings: dict[str, Any] = {
            "demo": demo,
            "encoder": encoder,
            "k": k,
            "horizon": horizon,
            "image": image,
            "step_pattern": step_pattern,
        }
        inner = _inner_retrieval(env)
        if inner is None:
            check_settings(demo, k, horizon, step_pattern)
            check_recorded_settings(env, demo, label)
            self._frames = _FrameSource(env, demo, label, image)
        else:
            check_equal(inner._settings, settings)
        gym.Wrapper.__init__(self, env)
        self._inner = inner
        self._settings = settings
        self._label = label
        if inner is None:
            size = _encoder_frame_size(env, demo, encoder)
            self._frames.encoder_size = size
            self.retriever = Retriever(
                demo, encoder, k, horizon, step_pattern, use_encoder_frames=size is not None
            )
        else:
            self.retriever = inner.retriever
