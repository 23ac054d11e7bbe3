"""Wrappers that hold an environment beside one demonstration.

* ``RetrievalGuideWrapper`` - says which action the demonstrator took here
* ``RetrievalRewardWrapper`` - replaces the reward by how well recent frames follow the
  demonstration

Both put their alignment into ``info["retrieval"]``. Stacked, in either order, they share one
`Retriever`. Frame stacking belongs outside them, action repeat and time limits inside.
"""

from __future__ import annotations

from typing import Any, Literal, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.core import ActType, ObsType
from numpy.typing import NDArray

from regil_wrappers.alignment import StepPattern
from regil_wrappers.correction import Servo
from regil_wrappers.demonstrations import Demonstrations
from regil_wrappers.encoders import Encoder
from regil_wrappers.frames import stated
from regil_wrappers.guide import Guide
from regil_wrappers.guide_arguments import check_guide, fitting_actions, make_servo, warn_of_rate
from regil_wrappers.memory import Search
from regil_wrappers.retrieval_wrapper import RetrievalWrapper, checked, settings_of
from regil_wrappers.reward_signals import (
    AT_EPISODE_END,
    check_inside,
    check_reward,
    make_signal,
)
from regil_wrappers.rewards import episode_scale

__all__ = ["RetrievalGuideWrapper", "RetrievalRewardWrapper"]


class RetrievalGuideWrapper(RetrievalWrapper[ObsType, ActType], gym.utils.RecordConstructorArgs):
    """Says at each step which action the demonstrator took where the agent is now.

    It never changes an action: whoever chooses actions asks `guide_action()`. Observations and
    rewards pass through. ``info["retrieval"]`` holds ``demonstration`` (which one of several),
    ``start``, ``end`` (its frames), ``cost`` and ``guide_action``.

    With ``correction="servo"`` the suggested actions go where the target is now. The first episodes
    that follow the guide then begin with moves that show it how the camera sees the hand. From
    there on ``info["retrieval"]["guide"]`` says what it suggests: "calibration", "corrected",
    "released" (after a grasp, corrected for where what is held is brought) or "plain" (the
    demonstrator's own action), and ``info["retrieval"]["calibrating"]`` whether this episode holds
    such moves: it demonstrates nothing then.

    Example:
        >>> import gymnasium as gym
        >>> from regil_wrappers import RetrievalGuideWrapper
        >>> env = gym.make("ToyReach-v0")
        >>> env = RetrievalGuideWrapper(env, demo=toy_demo)
        >>> observation, info = env.reset(seed=0)
        >>> done = False
        >>> while not done:
        ...     observation, reward, terminated, truncated, info = env.step(env.guide_action())
        ...     done = terminated or truncated
        >>> info["is_success"]
        True

    Args:
        env: an environment with a Box action space.
        demo: path of a demonstration, a list of paths, or a folder of .hdf5 files; or
            `Demonstration` objects, but such a stack has no ``spec``.
        encoder: name of an encoder (`regil_wrappers.encoder_names()`), or an object with
            ``encode(frames: uint8 (B, H, W, 3)) -> float32 (B, D)``, but such a stack has no
            ``spec``.
        k: how many nearest frames are candidates.
        horizon: H, how many frames before the current one are aligned with it.
        image: where frames come from: "obs" (the observation is the picture), "obs:KEY" (a key of a
            dict observation) or "render" (``env.render()``, with ``render_mode="rgb_array"``).
        guide_offset: frames added to the aligned one.
        guide_patience: after so many steps in which the furthest aligned frame did not advance,
            play on from that frame, one action a step; None: never.
        step_pattern: "symmetric" (Eq. 1) or "strap".
        register: whether pictures are moved back, once an episode has shown how far the target
            stands from where it stood in the one demonstration, before they are aligned.
        correction: "none", or "servo": actions are corrected for where the target is
            (`regil_wrappers.correction`). Needs a fixed camera, an arm that starts in the same pose
            each time, and actions that are deltas.
        translation_dims: the three action dimensions that move the hand. These four take what the
            environment says of itself (``metadata["regil"]``) where they are None, else [0, 1, 2],
            3, [10, 10, 0.5] and "auto".
        gripper_dim: the action dimension of the gripper, positive to close; "none" without one.
        plane: how far targets move along these three, as standard deviations in action units.
        mirror: +1, or -1 where pictures are mirrored against the action axes, or "auto".
        disturbance: how far `disturbed_action` pushes the hand off the corrected path now and then,
            in action units; needs a correction, which needs to be of one demonstration.
        search: how candidates are found among many demonstrations: "auto", "exact" or "faiss"
            (`regil_wrappers.memory`).
        deadline_ms: what a step's retrieval may take, in milliseconds: the first one that takes
            longer is warned of, all are counted in ``retriever.latency.misses``.

    Raises:
        ValueError: if the demonstration does not fit the environment or an argument is out of
            range; at the first reset, if the picture is upside down, mirrored or has its colours
            swapped.

    The vector twin: `regil_wrappers.vector.RetrievalGuideWrapper`.
    """

    def __init__(
        self,
        env: gym.Env[ObsType, ActType],
        demo: Demonstrations,
        encoder: str | Encoder = "pixels",
        k: int = 5,
        horizon: int = 4,
        image: str = "obs",
        guide_offset: int = 0,
        guide_patience: int | None = None,
        step_pattern: StepPattern = "symmetric",
        register: bool = False,
        correction: Literal["none", "servo"] = "none",
        translation_dims: list[int] | None = None,
        gripper_dim: int | Literal["none"] | None = None,
        plane: list[float] | None = None,
        mirror: Literal["auto", 1, -1] | None = None,
        disturbance: float = 0.0,
        search: Search = "auto",
        deadline_ms: float | None = None,
    ) -> None:
        settings = settings_of(
            demo, encoder, k, horizon, image, step_pattern, register, search, deadline_ms
        )
        loaded, frames = checked(env, settings)
        check_guide(guide_offset, guide_patience, correction, disturbance, len(loaded))
        actions = fitting_actions(env.action_space, loaded, settings["demo"])
        said = stated(env.unwrapped.metadata)
        warn_of_rate(said, loaded, settings["demo"])

        gym.utils.RecordConstructorArgs.__init__(
            self,
            _disable_deepcopy=True,
            **settings,
            guide_offset=guide_offset,
            guide_patience=guide_patience,
            correction=correction,
            translation_dims=translation_dims,
            gripper_dim=gripper_dim,
            plane=plane,
            mirror=mirror,
            disturbance=disturbance,
        )
        RetrievalWrapper.__init__(self, env, loaded, settings, frames)

        self.guide_offset = guide_offset
        self.guide_patience = guide_patience
        self._servo: Servo | None = None
        if correction == "servo":
            declared = {
                "translation_dims": translation_dims,
                "gripper_dim": gripper_dim,
                "plane": plane,
                "mirror": mirror,
            }
            size = self.retriever.picture_size
            self._servo = make_servo(
                said, env.action_space, size, actions[0], declared, disturbance
            )
        self._guide = Guide(actions, guide_offset, guide_patience, self._servo)

    def guide_action(self) -> NDArray[np.float32]:
        """What the guide would do now: (A,) float32, in the environment's own units.

        The demonstrator's action, corrected or not.

        Raises:
            ValueError: before the first reset.
        """
        return self._guide.action()

    def disturbed_action(self) -> NDArray[np.float32]:
        """What to execute in place of `guide_action()`: (A,) float32.

        With ``disturbance`` it pushes the hand off its way now and then. Who plays it and learns
        `guide_action()` learns to come back (DART, https://arxiv.org/abs/1703.09327).

        Raises:
            ValueError: before the first reset.
        """
        return self._guide.disturbed()

    def plain_action(self) -> NDArray[np.float32]:
        """The demonstrator's own action here: (A,) float32, in the environment's own units.

        At the end of the demonstration, its last action.

        Raises:
            ValueError: before the first reset.
        """
        return self._guide.plain()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObsType, dict[str, Any]]:
        """Reset; ``info["retrieval"]`` holds the alignment and the first guide action."""
        observation, info = super().reset(seed=seed, options=options)
        self._guide.begin(
            self.alignment, lambda: self.displacement, self.apart, self.shift_at, seed
        )
        return observation, self._with_retrieval(info, **self._guide.said())

    def step(self, action: ActType) -> tuple[ObsType, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step with the given action; ``info["retrieval"]`` holds the guide's for the next step."""
        suggested = self.guide_action()
        observation, reward, terminated, truncated, info = super().step(action)
        over = terminated or truncated
        success = bool(info.get("is_success", terminated)) if over else None
        self._guide.after(action, suggested, self.alignment, self.retrieval_frame, success)
        info = self._with_retrieval(info, **self._guide.said())
        return observation, reward, terminated, truncated, info

    @property
    def target_shift(self) -> NDArray[np.float64] | None:
        """(3,) action units: where this episode's target is believed to have gone; None: unknown.

        Unknown without a correction, while it calibrates, and where it replays plainly.
        """
        return self._guide.target_shift

    @property
    def place_shift(self) -> NDArray[np.float64] | None:
        """(3,) action units: where the place to which it brings that has gone, as it believes.

        What `target_shift` is, unless the correction changes after a grasp.
        """
        return self._guide.place_shift

    def calibration(self) -> dict[str, Any] | None:
        """What a correcting guide has learned about camera and task, as JSON values.

        None before the episode of its last calibration move is over, and without a correction.
        """
        return self._guide.calibration()

    def set_calibration(self, calibration: dict[str, Any]) -> None:
        """Take over another guide's calibration: same demonstration, same camera.

        Raises:
            ValueError: if it is not one, or from pictures of another size.
        """
        self._guide.set_calibration(calibration)

    def lasting_state(self) -> dict[str, Any] | None:
        """All that the guide keeps when an episode ends: numbers, text and arrays; None: nothing.

        More than `calibration`: a half-done one, and its generator.
        """
        return self._guide.lasting()

    def set_lasting_state(self, lasting: dict[str, Any] | None) -> None:
        """Take over what `lasting_state` gave, into a new guide, before `reset`.

        Raises:
            ValueError: if it is not from such a guide.
        """
        self._guide.set_lasting(lasting)


class RetrievalRewardWrapper(RetrievalWrapper[ObsType, ActType], gym.utils.RecordConstructorArgs):
    """Rewards following the demonstration.

    Known at every step, from nothing that comes later (`regil_wrappers.rewards`):

    * "sdtw", the paper's: r = -(S-DTW cost) / (frames in the window), Eq. 3: 0 along an exact
      replay and negative otherwise
    * "progress": r = max_j phi_j exp(-C(j) / tau) - 1, in (-1, 0], rises along the demonstration
    * "cos": cosine similarity with the nearest frame, in [-1, 1]
    * "orca": ordered coverage of the demonstration's frames, in [0, 1]
    * "pwil": greedy transport, in [0, 5]; an episode longer than the demonstration earns 0 then

    Known at the episode's end: "ot" and "tot", (temporal) optimal transport. Each step then returns
    0 (with ``mode="add"`` the environment's reward), and ``info`` of the last one holds what is to
    be *added* to the rewards that were returned: ``info["retrieval"]["episode_rewards"]``, (steps,)
    float32, weighted, times ``episode_scale`` of the first episode of all (ROT's ``10 / |sum|``,
    unweighted). An algorithm that does not read it learns from zeros: with Stable-Baselines3 use
    ``regil_sb3.relabelling``'s replay buffers. Time limits belong inside this wrapper.

    Positive rewards pay for every step survived: where success ends the episode they teach not to
    finish. Observations pass through. ``info["retrieval"]`` holds ``demonstration`` (which one of
    several), ``start``, ``end`` (its frames), ``cost`` and ``env_reward``, the environment's own.

    Example:
        >>> import gymnasium as gym
        >>> from regil_wrappers import RetrievalRewardWrapper
        >>> env = gym.make("ToyReach-v0")
        >>> env = RetrievalRewardWrapper(env, demo=toy_demo)
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.high)
        >>> reward <= 0, info["retrieval"]["env_reward"]
        (True, 0.0)

    Args:
        env: the environment.
        demo: path of a demonstration, a list of paths, or a folder of .hdf5 files; or
            `Demonstration` objects, but such a stack has no ``spec``.
        encoder: name of an encoder (`regil_wrappers.encoder_names()`), or an object with
            ``encode(frames: uint8 (B, H, W, 3)) -> float32 (B, D)``, but such a stack has no
            ``spec``.
        k: how many nearest frames are candidates.
        horizon: H, how many frames before the current one are aligned with it.
        image: where frames come from: "obs" (the observation is the picture), "obs:KEY" (a key of a
            dict observation) or "render" (``env.render()``, with ``render_mode="rgb_array"``).
        reward: "sdtw", "progress", "cos", "orca", "pwil", "ot" or "tot".
        mode: "replace" the environment's reward, or "add" to it.
        weight: factor of this reward.
        divisor: of "sdtw": "window" divides by the frames in the window, "horizon" always by H + 1
            as the paper does; they differ in the first H steps of an episode.
        step_pattern: "symmetric" (Eq. 1) or "strap".
        register: whether pictures are moved back, once an episode has shown how far the target
            stands from where it stood in the one demonstration, before they are aligned.
        search: how candidates are found among many demonstrations: "auto", "exact" or "faiss"
            (`regil_wrappers.memory`).
        deadline_ms: what a step's retrieval may take, in milliseconds: the first one that takes
            longer is warned of, all are counted in ``retriever.latency.misses``.

    Raises:
        ValueError: if the demonstration does not fit the environment or an argument is out of
            range; at the first reset, if the picture is upside down, mirrored or has its colours
            swapped.

    The vector twin: `regil_wrappers.vector.RetrievalRewardWrapper`.
    """

    def __init__(
        self,
        env: gym.Env[ObsType, ActType],
        demo: Demonstrations,
        encoder: str | Encoder = "pixels",
        k: int = 5,
        horizon: int = 4,
        image: str = "obs",
        reward: Literal["sdtw", "progress", "cos", "orca", "pwil", "ot", "tot"] = "sdtw",
        mode: Literal["replace", "add"] = "replace",
        weight: float = 1.0,
        divisor: Literal["window", "horizon"] = "window",
        step_pattern: StepPattern = "symmetric",
        register: bool = False,
        search: Search = "auto",
        deadline_ms: float | None = None,
    ) -> None:
        settings = settings_of(
            demo, encoder, k, horizon, image, step_pattern, register, search, deadline_ms
        )
        loaded, frames = checked(env, settings)
        check_reward(reward, mode, weight, divisor, search)
        late = "rewards_at_episode_end"
        check_inside(reward, env.get_wrapper_attr(late) if env.has_wrapper_attr(late) else None)

        gym.utils.RecordConstructorArgs.__init__(
            self,
            _disable_deepcopy=True,
            **settings,
            reward=reward,
            mode=mode,
            weight=weight,
            divisor=divisor,
        )
        RetrievalWrapper.__init__(self, env, loaded, settings, frames)

        self.mode = mode
        self.weight = weight
        self.reward = reward
        self._signal = make_signal(
            reward, self.retriever, horizon if divisor == "horizon" else None
        )

    @property
    def reward_scale(self) -> float:
        """What makes a typical step's reward about 1 in size, from the demonstration alone.

        1 / tau for "sdtw", 1 / 5 for "pwil", 1 for "progress", "cos" and "orca"; for "ot" and "tot"
        frames / 10, once they are times ``episode_scale``. ``weight`` is left out: it is to tell.

        Raises:
            ValueError: if the demonstration does not move.
        """
        return self._signal.scale

    @property
    def rewards_at_episode_end(self) -> bool:
        """Whether the rewards come with the last step's ``info``, and steps return placeholders."""
        return self.reward in AT_EPISODE_END

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObsType, dict[str, Any]]:
        """Reset; ``info["retrieval"]`` holds the alignment of the first frame."""
        observation, info = super().reset(seed=seed, options=options)
        self._signal.begin()
        return observation, self._with_retrieval(info)

    def step(self, action: ActType) -> tuple[ObsType, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step; the environment's own reward goes to ``info["retrieval"]["env_reward"]``."""
        observation, env_reward, terminated, truncated, info = super().step(action)
        reward = self.weight * self._signal.step()
        if self.mode == "add":
            reward += float(env_reward)
        own: dict[str, Any] = {"env_reward": float(env_reward)}
        if (terminated or truncated) and (late := self._signal.end()) is not None:
            own["episode_rewards"] = (self.weight * late).astype(np.float32)
            own["episode_scale"] = episode_scale(late)
        return observation, reward, terminated, truncated, self._with_retrieval(info, **own)
