"""The retrieval wrappers for SB3's vector environments: one call of the encoder for all.

* ``VecRetrievalGuide`` - says which actions the demonstrator took where the environments are
* ``VecRetrievalReward`` - replaces the rewards by how well recent frames follow the demonstration

They wrap a `VecEnv` of environments that know nothing of them: any algorithm learns from the
rewards, and ``env_method`` and ``get_attr`` answer as if each environment were wrapped. Each one is
aligned as it would be alone; with the encoder "pixels" to the bit, while a network may give an
embedding other last bits in a batch. Stacked, in either order, both share their alignments. Frame
stacking belongs outside them; `VecTransposeImage` may stand on either side.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from regil_wrappers.alignment import StepPattern
from regil_wrappers.demonstrations import Demonstrations
from regil_wrappers.encoders import Encoder
from regil_wrappers.episodes import Episodes, Guides, Rewards, Said, Several
from regil_wrappers.latency import Latency
from regil_wrappers.memory import Search
from regil_wrappers.retrieval import Alignment
from regil_wrappers.retrieval_wrapper import settings_of
from regil_wrappers.reward_signals import AT_EPISODE_END
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

__all__ = ["VecRetrievalGuide", "VecRetrievalReward"]


class _VecRetrieval(VecEnvWrapper):
    """What both share. The innermost one takes the pictures, those outside read alignments."""

    def __init__(
        self,
        venv: VecEnv,
        several: Several,
        episodes: Episodes,
        **answers: Callable[[int], Any],
    ) -> None:
        # What env_method and get_attr say of an environment
        self._answers = {"alignment": lambda i: self.alignments[i], **answers}
        self._episodes = episodes
        self._owns = several.inside is None
        super().__init__(venv)

    @property
    def alignments(self) -> list[Alignment]:
        """The alignment of each environment's current frame; there are such after a reset."""
        return [episode.retriever.alignment for episode in self._episodes.current]

    @property
    def latency(self) -> Latency:
        """How long retrieval took, for all environments together."""
        return self._episodes.latency

    def _reset(self) -> VecEnvObs:
        observations = self.venv.reset()
        if self._owns:
            raw = self._episodes.frames.raw(observations)
            self._episodes.advance({}, {i: raw[i] for i in range(self.num_envs)})
        return observations

    def _step_wait(self) -> tuple[VecEnvObs, Any, Any, list[dict[str, Any]]]:
        observations, rewards, dones, infos = self.venv.step_wait()
        if self._owns:
            frames = self._episodes.frames
            raw = frames.raw(observations)
            stepped = {i: raw[i] for i in range(self.num_envs)}
            begun = {i: raw[i] for i in range(self.num_envs) if dones[i]}
            for i in begun:
                if "terminal_observation" not in infos[i]:
                    raise ValueError(
                        f"the episode of environment {i} ended without infos[{i}]"
                        "['terminal_observation']: wrap a VecEnv that gives it, as SB3's do"
                    )
                stepped[i] = frames.raw(infos[i]["terminal_observation"])
            self._episodes.advance(stepped, begun)
        return observations, rewards, dones, list(infos)

    def _tell(self, infos: list[dict[str, Any]], said: Said) -> None:
        """Put what is said of environments into their infos, beside what the wrapper inside has."""
        for i, of_one in said.items():
            inner = {} if self._owns else infos[i].get("retrieval", {})
            infos[i] = {**infos[i], "retrieval": {**of_one, **inner}}

    def _begin(self, said: Said) -> None:
        """Take over the infos of the resets that began these episodes."""
        for i in said:
            self.reset_infos[i] = self.venv.reset_infos[i]
        self._tell(self.reset_infos, said)

    def has_attr(self, attr_name: str) -> bool:
        """Whether each environment would have the attribute if it were wrapped."""
        return attr_name in self._answers or super().has_attr(attr_name)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """The attribute of each environment as if it were wrapped."""
        if attr_name in self._answers:
            return [self._answers[attr_name](i) for i in self._get_indices(indices)]
        return super().get_attr(attr_name, indices)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method of each environment as if it were wrapped."""
        if method_name in self._answers:
            methods = self.get_attr(method_name, indices)
            return [method(*method_args, **method_kwargs) for method in methods]
        return super().env_method(method_name, *method_args, indices=indices, **method_kwargs)


class VecRetrievalGuide(_VecRetrieval):
    """Says at each step which actions the demonstrator took where the environments are now.

    What `regil_wrappers.RetrievalGuideWrapper` is for one environment: it never changes an action,
    observations and rewards pass through. ``info["retrieval"]`` of each environment holds what that
    one says; of an episode's first frame it is in ``reset_infos``. ``env_method`` and ``get_attr``
    know its guide_action, disturbed_action, plain_action, calibration, set_calibration,
    lasting_state, set_lasting_state, target_shift and alignment: `TD3BC` warms up with it as with
    wrapped environments.

    Each environment has its own correction, which learns and calibrates for itself.

    Example:
        >>> from stable_baselines3.common.env_util import make_vec_env
        >>> from regil_sb3 import VecRetrievalGuide
        >>> envs = VecRetrievalGuide(make_vec_env("ToyReach-v0", n_envs=3), demo=toy_demo)
        >>> observations = envs.reset()
        >>> dones = np.zeros(3, bool)
        >>> while not dones.any():
        ...     observations, rewards, dones, infos = envs.step(envs.guide_action())
        >>> [info["is_success"] for info in infos]
        [True, True, True]

    Args:
        venv: the environments, with a Box action space.
        demo: as all others, what it is for `regil_wrappers.RetrievalGuideWrapper`.
        image: "obs" or "obs:KEY". SB3's environments begin an episode before the last picture of
            the one before could be rendered: `gymnasium.wrappers.AddRenderObservation` puts it into
            the observation, and SB3's `VecExtractDictObs`, outside, takes it out again.
        deadline_ms: what the retrieval for all environments may take together, in milliseconds: the
            first step that takes longer is warned of, all are counted in ``latency.misses``.

    Raises:
        ValueError: as `regil_wrappers.RetrievalGuideWrapper`, and if an environment has such a
            wrapper already.
    """

    def __init__(
        self,
        venv: VecEnv,
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
        several = _several(venv)
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
        guides = self._guides.guides
        super().__init__(
            venv,
            several,
            self._guides.episodes,
            guide_action=lambda i: guides[i].action,
            disturbed_action=lambda i: guides[i].disturbed,
            plain_action=lambda i: guides[i].plain,
            calibration=lambda i: guides[i].calibration,
            set_calibration=lambda i: guides[i].set_calibration,
            target_shift=lambda i: guides[i].target_shift,
            lasting_state=lambda i: guides[i].lasting,
            set_lasting_state=lambda i: guides[i].set_lasting,
        )

    def guide_action(self) -> npt.NDArray[np.float32]:
        """What the guides would do now: (n, A) float32, in the environments' own units.

        Raises:
            ValueError: before the first reset.
        """
        return self._guides.actions()

    def reset(self) -> VecEnvObs:
        """Reset; ``reset_infos`` holds the alignments and the first guide actions."""
        seeds = list(self.unwrapped._seeds)  # the reset forgets them
        observations = self._reset()
        self._begin(self._guides.begin(seeds))
        return observations

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Begin a step with the given actions."""
        self._guides.before(actions)
        super().step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """End it; ``info["retrieval"]`` holds what the guides say for the next one."""
        observations, rewards, dones, infos = self._step_wait()

        def succeeded(i: int) -> bool | None:
            terminated = not infos[i].get("TimeLimit.truncated", False)
            return bool(infos[i].get("is_success", terminated)) if dones[i] else None

        self._tell(infos, self._guides.after(succeeded))
        self._begin(self._guides.begin())
        return observations, rewards, dones, infos


class VecRetrievalReward(_VecRetrieval):
    """Rewards following the demonstration, in each environment.

    What `regil_wrappers.RetrievalRewardWrapper` is for one environment, with the same rewards as
    float32. ``info["retrieval"]`` of each environment holds what that one says; of an episode's
    first frame it is in ``reset_infos``. ``env_method`` and ``get_attr`` know its reward_scale,
    rewards_at_episode_end and alignment. A `Monitor` inside sees the environment's own rewards, a
    `VecMonitor` outside these.

    Example:
        >>> from stable_baselines3 import PPO
        >>> from stable_baselines3.common.env_util import make_vec_env
        >>> from regil_sb3 import VecRetrievalReward
        >>> envs = VecRetrievalReward(make_vec_env("ToyReach-v0", n_envs=3), demo=toy_demo)
        >>> model = PPO("CnnPolicy", envs, n_steps=4, batch_size=12, n_epochs=1).learn(12)

    Args:
        venv: the environments.
        demo: as all others, what it is for `regil_wrappers.RetrievalRewardWrapper`.
        image: "obs" or "obs:KEY". SB3's environments begin an episode before the last picture of
            the one before could be rendered: `gymnasium.wrappers.AddRenderObservation` puts it into
            the observation, and SB3's `VecExtractDictObs`, outside, takes it out again.
        deadline_ms: what the retrieval for all environments may take together, in milliseconds: the
            first step that takes longer is warned of, all are counted in ``latency.misses``.

    Raises:
        ValueError: as `regil_wrappers.RetrievalRewardWrapper`, and if an environment has such a
            wrapper already.
    """

    def __init__(
        self,
        venv: VecEnv,
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
        several = _several(venv)
        self._rewards = Rewards(several, settings, reward, mode, weight, divisor)
        super().__init__(
            venv,
            several,
            self._rewards.episodes,
            reward_scale=lambda _: self._rewards.scale,
            rewards_at_episode_end=lambda _: reward in AT_EPISODE_END,
        )

    def reset(self) -> VecEnvObs:
        """Reset; ``reset_infos`` holds the alignments of the first frames."""
        observations = self._reset()
        self._begin(self._rewards.begin())
        return observations

    def step_wait(self) -> VecEnvStepReturn:
        """End a step; the environments' own rewards go to ``info["retrieval"]["env_reward"]``."""
        observations, env_rewards, dones, infos = self._step_wait()
        rewards, said = self._rewards.after(env_rewards, dones)
        self._tell(infos, said)
        self._begin(self._rewards.begin())
        return observations, rewards.astype(np.float32), dones, infos


def _several(venv: VecEnv) -> Several:
    if not isinstance(venv, VecEnv):
        raise ValueError(
            f"{venv!r} is no VecEnv of Stable-Baselines3: regil_wrappers has the same wrappers for "
            "one environment, and regil_wrappers.vector for Gymnasium's vector environments"
        )
    inside, late = venv, "rewards_at_episode_end"
    while isinstance(inside, VecEnvWrapper) and not isinstance(inside, _VecRetrieval):
        inside = inside.venv
    return Several(
        n=venv.num_envs,
        observation_space=venv.observation_space,
        action_space=venv.action_space,
        metadata=venv.get_attr("metadata", 0)[0],
        render_mode=venv.render_mode,
        render=venv.get_images,
        call=venv.env_method,
        has=venv.has_attr,
        resets_at_once=True,
        inside=inside._episodes if isinstance(inside, _VecRetrieval) else None,
        late=any(venv.get_attr(late)) if venv.has_attr(late) else None,
    )
