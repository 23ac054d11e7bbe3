"""The retrieval wrappers for vector environments: one call of the encoder for all environments.

* ``RetrievalGuideWrapper`` - says which actions the demonstrator took where the environments are
* ``RetrievalRewardWrapper`` - replaces the rewards by how well recent frames follow the
  demonstration

Each environment is aligned as it would be alone; with the encoder "pixels" to the bit, while a
network may give an embedding other last bits in a batch. Stacked, in either order, both share their
alignments. All of `gymnasium.vector.AutoresetMode` are followed, and ``options["reset_mask"]``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Generic, Literal

import numpy as np
from gymnasium.core import ActType, ObsType
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from numpy.typing import NDArray

from regil_wrappers.alignment import StepPattern
from regil_wrappers.demonstrations import Demonstrations
from regil_wrappers.encoders import Encoder
from regil_wrappers.episodes import Episodes, Guides, Rewards, Said, Several
from regil_wrappers.latency import Latency
from regil_wrappers.memory import Search
from regil_wrappers.retrieval import Alignment
from regil_wrappers.retrieval_wrapper import settings_of
from regil_wrappers.reward_signals import AT_EPISODE_END

__all__ = ["RetrievalGuideWrapper", "RetrievalRewardWrapper"]

Array = NDArray[Any]
Infos = dict[str, Any]
Seeds = int | list[int | None] | None


if TYPE_CHECKING:

    class _Wrapper(VectorWrapper[ObsType, ActType, ObsType, ActType, Array]): ...

else:  # before Gymnasium 1.4 it takes no types

    class _Wrapper(VectorWrapper, Generic[ObsType, ActType]):
        """Gymnasium's own."""


class _RetrievalWrapper(_Wrapper[ObsType, ActType]):
    """What both share. The innermost one takes the pictures, those outside read alignments."""

    def __init__(
        self, env: VectorEnv[ObsType, ActType, Array], several: Several, episodes: Episodes
    ) -> None:
        VectorWrapper.__init__(self, env)
        self._episodes = episodes
        self._owns = several.inside is None
        self._mode = env.metadata["autoreset_mode"]
        self._over = np.zeros(self.num_envs, bool)

    @property
    def alignments(self) -> list[Alignment]:
        """The alignment of each environment's current frame; there are such after a reset."""
        return [episode.retriever.alignment for episode in self._episodes.current]

    @property
    def latency(self) -> Latency:
        """How long retrieval took, for all environments together."""
        return self._episodes.latency

    def reset(
        self, *, seed: Seeds = None, options: dict[str, Any] | None = None
    ) -> tuple[ObsType, Infos]:
        """Reset all environments, or those of ``options["reset_mask"]``, and align what is seen."""
        mask = (options or {}).get("reset_mask")  # the environment takes it out of the options
        which = np.arange(self.num_envs) if mask is None else np.flatnonzero(mask)
        observations, infos = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        self._over[which] = False
        if self._owns:
            raw = self._episodes.frames.raw(observations)
            self._episodes.advance({}, {int(i): raw[i] for i in which})
        return observations, infos

    def step(self, actions: ActType) -> tuple[ObsType, Array, Array, Array, Infos]:
        """Step all environments and align what follows."""
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        over = np.logical_or(terminations, truncations)
        if self._owns:
            frames = self._episodes.frames
            raw = frames.raw(observations)
            resets_now = over if self._mode == AutoresetMode.SAME_STEP else self._over
            begun = {int(i): raw[i] for i in np.flatnonzero(resets_now)}
            stepped = {i: raw[i] for i in range(self.num_envs) if i not in begun}
            if self._mode == AutoresetMode.SAME_STEP and begun:
                finals = infos.get("final_obs")
                if finals is None:
                    raise ValueError(
                        "an episode ended in autoreset mode SAME_STEP without infos['final_obs']: "
                        "use NEXT_STEP or DISABLED, or an environment that gives it"
                    )
                stepped |= {i: frames.raw(finals[i]) for i in begun}
            self._episodes.advance(stepped, begun)
        if self._mode == AutoresetMode.NEXT_STEP:
            self._over = over
        return observations, rewards, terminations, truncations, infos

    def _last_infos(self, infos: Infos, ended: bool) -> Infos:
        """Where infos hold those of the step, of an environment whose episode it ended or not."""
        same_step = ended and self._mode == AutoresetMode.SAME_STEP
        return infos.get("final_info", {}) if same_step else infos

    def _tell(self, infos: Infos, after: Said, begun: Said, over: Any = None) -> None:
        """Put into infos what is said of steps and beginnings, and no wrapper inside has said."""
        if self._owns:
            for there in (infos, infos.get("final_info", {})):  # an environment's own goes
                there.pop("retrieval", None)
                there.pop("_retrieval", None)
        for i, said in after.items():
            last = self._last_infos(infos, over[i])
            new = {"retrieval": _unsaid(last, i, said)}
            self._add_info(infos, new if last is infos else {"final_info": new}, i)
        for i, said in begun.items():
            self._add_info(infos, {"retrieval": _unsaid(infos, i, said)}, i)

    def _add_info(self, vector_infos: Infos, env_info: Infos, env_num: int) -> Infos:
        # Episodes that end together may be of different lengths
        if "episode_rewards" in env_info:
            vector_infos.setdefault("episode_rewards", np.full(self.num_envs, None, object))
        return super()._add_info(vector_infos, env_info, env_num)


class RetrievalGuideWrapper(_RetrievalWrapper[ObsType, ActType]):
    """Says at each step which actions the demonstrator took where the environments are now.

    What `regil_wrappers.RetrievalGuideWrapper` is for one environment: it never changes an action,
    observations and rewards pass through. ``infos["retrieval"]`` holds, as Gymnasium's vector infos
    do, an array for each of what that one says of one environment, and a mask ``_name`` of the
    environments that have it: ``demonstration``, ``start``, ``end`` (n,) int, ``cost`` (n,) float64
    and ``guide_action`` (n, A) float32; with a correction ``guide`` (n,) of str and
    ``calibrating`` (n,) bool. In autoreset mode SAME_STEP an episode's last is in
    ``infos["final_info"]["retrieval"]``.

    Each environment has its own correction, which learns and calibrates for itself.

    Example:
        >>> import gymnasium as gym
        >>> from regil_wrappers.vector import RetrievalGuideWrapper
        >>> envs = gym.make_vec("ToyReach-v0", num_envs=3, vectorization_mode="sync")
        >>> envs = RetrievalGuideWrapper(envs, demo=toy_demo)
        >>> observations, infos = envs.reset(seed=0)
        >>> terminations = np.zeros(3, bool)
        >>> while not terminations.any():
        ...     actions = envs.guide_action()
        ...     observations, rewards, terminations, truncations, infos = envs.step(actions)
        >>> actions.shape, infos["is_success"].tolist()
        ((3, 2), [True, True, True])

    Args:
        env: a vector environment of environments with a Box action space.
        demo: as all others, what it is for `regil_wrappers.RetrievalGuideWrapper`; ``seed`` of a
            reset gives environment i the seed that Gymnasium gives it.
        image: "obs", "obs:KEY", or "render" for ``env.render()``, which gives a picture of each
            environment; in autoreset mode SAME_STEP, where an episode's last picture cannot be
            rendered any more, not "render".
        deadline_ms: what the retrieval for all environments may take together, in milliseconds: the
            first step that takes longer is warned of, all are counted in ``latency.misses``.

    Raises:
        ValueError: as `regil_wrappers.RetrievalGuideWrapper`, and if an environment has such a
            wrapper already or the autoreset mode is not known.
    """

    def __init__(
        self,
        env: VectorEnv[ObsType, ActType, Array],
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
        several = _several(env)
        self._guides = Guides(
            several,
            settings,
            guide_offset,
            guide_patience,
            correction,
            disturbance,
            translation_dims=translation_dims,
            gripper_dim=gripper_dim,
            plane=plane,
            mirror=mirror,
        )
        _RetrievalWrapper.__init__(self, env, several, self._guides.episodes)

    def guide_action(self) -> NDArray[np.float32]:
        """What the guides would do now: (n, A) float32, in the environments' own units.

        Where the next step only resets an environment (NEXT_STEP), it means nothing.

        Raises:
            ValueError: before the first reset.
        """
        return self._guides.actions()

    def disturbed_action(self) -> NDArray[np.float32]:
        """What to execute in place of `guide_action()`: (n, A) float32.

        Raises:
            ValueError: before the first reset.
        """
        return self._guides.actions("disturbed")

    def plain_action(self) -> NDArray[np.float32]:
        """The demonstrator's own actions here: (n, A) float32, in the environments' own units.

        Raises:
            ValueError: before the first reset.
        """
        return self._guides.actions("plain")

    def reset(
        self, *, seed: Seeds = None, options: dict[str, Any] | None = None
    ) -> tuple[ObsType, Infos]:
        """Reset; ``infos["retrieval"]`` holds the alignments and the first guide actions."""
        observations, infos = super().reset(seed=seed, options=options)
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        self._tell(infos, {}, self._guides.begin(seeds))
        return observations, infos

    def step(self, actions: ActType) -> tuple[ObsType, Array, Array, Array, Infos]:
        """Step with the given actions; ``infos["retrieval"]`` holds the guides' for the next."""
        self._guides.before(actions)
        observations, rewards, terminations, truncations, infos = super().step(actions)
        over = np.logical_or(terminations, truncations)

        def succeeded(i: int) -> bool | None:
            if not over[i]:
                return None
            last = self._last_infos(infos, True)
            known = "is_success" in last and last.get("_is_success", over)[i]
            return bool(last["is_success"][i] if known else terminations[i])

        said = self._guides.after(succeeded)
        self._tell(infos, said, self._guides.begin(), over)
        return observations, rewards, terminations, truncations, infos

    @property
    def target_shift(self) -> list[NDArray[np.float64] | None]:
        """Of each environment, (3,) action units: where its target is believed to have gone.

        None where it is unknown.
        """
        return [guide.target_shift for guide in self._guides.guides]

    def calibration(self) -> list[dict[str, Any] | None]:
        """Of each environment, what its guide has learned about camera and task, as JSON values."""
        return [guide.calibration() for guide in self._guides.guides]

    def set_calibration(self, calibration: dict[str, Any]) -> None:
        """Give all guides one's calibration: same demonstration, same camera.

        Raises:
            ValueError: if it is not one, or from pictures of another size.
        """
        self._guides.set_calibration(calibration)


class RetrievalRewardWrapper(_RetrievalWrapper[ObsType, ActType]):
    """Rewards following the demonstration, in each environment.

    What `regil_wrappers.RetrievalRewardWrapper` is for one environment, with the same rewards.
    ``infos["retrieval"]`` holds, as Gymnasium's vector infos do, an array for each of what that one
    says of one environment, and a mask ``_name`` of the environments that have it:
    ``demonstration``, ``start``, ``end`` (n,) int, ``cost`` and ``env_reward`` (n,) float64. With
    rewards known at an episode's end it holds ``episode_rewards``, (n,) of arrays (steps,) float32,
    and ``episode_scale`` (n,) float64. In autoreset mode SAME_STEP an episode's last is in
    ``infos["final_info"]["retrieval"]``; in NEXT_STEP a step that resets an environment returns the
    environment's reward, 0.

    Example:
        >>> import gymnasium as gym
        >>> from regil_wrappers.vector import RetrievalRewardWrapper
        >>> envs = gym.make_vec("ToyReach-v0", num_envs=3, vectorization_mode="sync")
        >>> envs = RetrievalRewardWrapper(envs, demo=toy_demo)
        >>> observations, infos = envs.reset(seed=0)
        >>> actions = envs.action_space.high
        >>> observations, rewards, terminations, truncations, infos = envs.step(actions)
        >>> (rewards <= 0).tolist(), infos["retrieval"]["env_reward"].tolist()
        ([True, True, True], [0.0, 0.0, 0.0])

    Args:
        env: a vector environment.
        demo: as all others, what it is for `regil_wrappers.RetrievalRewardWrapper`.
        image: "obs", "obs:KEY", or "render" for ``env.render()``, which gives a picture of each
            environment; in autoreset mode SAME_STEP, where an episode's last picture cannot be
            rendered any more, not "render".
        deadline_ms: what the retrieval for all environments may take together, in milliseconds: the
            first step that takes longer is warned of, all are counted in ``latency.misses``.

    Raises:
        ValueError: as `regil_wrappers.RetrievalRewardWrapper`, and if an environment has such a
            wrapper already or the autoreset mode is not known.
    """

    def __init__(
        self,
        env: VectorEnv[ObsType, ActType, Array],
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
        several = _several(env)
        self._rewards = Rewards(several, settings, reward, mode, weight, divisor)
        _RetrievalWrapper.__init__(self, env, several, self._rewards.episodes)
        self.reward = reward

    @property
    def reward_scale(self) -> float:
        """What makes a typical step's reward about 1 in size, from the demonstration alone.

        Raises:
            ValueError: if the demonstration does not move.
        """
        return self._rewards.scale

    @property
    def rewards_at_episode_end(self) -> bool:
        """Whether the rewards come with the last step's infos, and steps return placeholders."""
        return self.reward in AT_EPISODE_END

    def reset(
        self, *, seed: Seeds = None, options: dict[str, Any] | None = None
    ) -> tuple[ObsType, Infos]:
        """Reset; ``infos["retrieval"]`` holds the alignments of the first frames."""
        observations, infos = super().reset(seed=seed, options=options)
        self._tell(infos, {}, self._rewards.begin())
        return observations, infos

    def step(self, actions: ActType) -> tuple[ObsType, Array, Array, Array, Infos]:
        """Step; the environments' own rewards go to ``infos["retrieval"]["env_reward"]``."""
        observations, env_rewards, terminations, truncations, infos = super().step(actions)
        over = np.logical_or(terminations, truncations)
        rewards, said = self._rewards.after(env_rewards, over)
        self._tell(infos, said, self._rewards.begin(), over)
        return observations, rewards, terminations, truncations, infos


def _unsaid(infos: Infos, i: int, said: dict[str, Any]) -> Infos:
    there = infos.get("retrieval", {})
    return {k: v for k, v in said.items() if k not in there or not there[f"_{k}"][i]}


def _several(env: VectorEnv[Any, Any, Array]) -> Several:
    if not isinstance(env, VectorEnv):
        raise ValueError(
            f"{env!r} is no gymnasium.vector.VectorEnv: regil_wrappers has the same wrappers for "
            "one environment"
        )
    mode = env.metadata.get("autoreset_mode")
    if mode not in list(AutoresetMode):
        raise ValueError(
            f"metadata['autoreset_mode'] of {env} is {mode!r}: it must say one of "
            "gymnasium.vector.AutoresetMode, or alignments would go on from one episode to the next"
        )
    stack = [env]
    while isinstance(stack[-1], VectorWrapper):
        stack.append(stack[-1].env)
    ours = [one for one in stack if isinstance(one, _RetrievalWrapper)]
    late = [one.rewards_at_episode_end for one in ours if isinstance(one, RetrievalRewardWrapper)]
    base: Any = env.unwrapped
    return Several(
        n=env.num_envs,
        observation_space=env.single_observation_space,
        action_space=env.single_action_space,
        metadata=env.metadata,
        render_mode=env.render_mode,
        render=env.render,
        call=lambda name, *given: base.call(name, *given),
        has=lambda name: hasattr(base, "call") and all(base.call("has_wrapper_attr", name)),
        resets_at_once=mode == AutoresetMode.SAME_STEP,
        inside=ours[0]._episodes if ours else None,
        late=late[0] if late else None,
    )
