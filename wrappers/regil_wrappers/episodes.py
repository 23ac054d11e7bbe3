"""Several environments' current episodes, held beside the demonstration: one encoder for all.

* ``Several`` - vector environments of whatever library, asked as one environment is
* ``Episodes`` - their pictures and alignments
* ``Guides`` - suggest their actions
* ``Rewards`` - reward their steps

A step of such environments may both end an episode of one of them and begin its next.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from regil_wrappers.correction import Servo
from regil_wrappers.demonstration import Demonstration
from regil_wrappers.demonstrations import demonstrations, labels_of
from regil_wrappers.episode import Episode
from regil_wrappers.frames import FrameSource, stated
from regil_wrappers.guide import Guide
from regil_wrappers.guide_arguments import check_guide, fitting_actions, make_servo, warn_of_rate
from regil_wrappers.latency import Latency
from regil_wrappers.retrieval import step_together
from regil_wrappers.retrieval_wrapper import (
    check_demonstrations,
    check_shared,
    make_retriever,
    said_of,
)
from regil_wrappers.reward_signals import Signal, check_inside, check_reward, make_signal
from regil_wrappers.rewards import episode_scale

__all__ = ["Episodes", "Guides", "Rewards", "Several"]

Said = dict[int, dict[str, Any]]
"""What ``info["retrieval"]`` holds, by environment."""


@dataclass(frozen=True)
class Several:
    """n environments, asked as one is (`regil_wrappers.frames.Asked`).

    Args:
        n: how many.
        observation_space: of one.
        action_space: of one.
        metadata: of one.
        render_mode: of all.
        render: gives the picture of each.
        call: calls a method of each, by name and with arguments, and gives what they returned.
        has: whether all have an attribute.
        resets_at_once: whether an environment begins its next episode in the step that ends one.
        inside: the episodes of a retrieval wrapper further in, which are shared; None: there is
            none.
        late: whether the reward of a wrapper further in comes at an episode's end; None: there is
            none.
    """

    n: int
    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    metadata: dict[str, Any]
    render_mode: str | None
    render: Callable[[], Any]
    call: Callable[..., Sequence[Any]]
    has: Callable[[str], bool]
    resets_at_once: bool
    inside: Episodes | None
    late: bool | None = None

    @property
    def unwrapped(self) -> Several:
        """What has the ``metadata``."""
        return self

    def has_wrapper_attr(self, name: str) -> bool:
        """Whether all have the attribute."""
        return self.has(name)

    def get_wrapper_attr(self, name: str) -> Any:
        """A function that calls each one's."""
        return partial(self.call, name)

    def checked(
        self, settings: dict[str, Any]
    ) -> tuple[Sequence[Demonstration], FrameSource | None]:
        """Refuse what does not fit, before any long work.

        Returns:
            the demonstrations, and where frames come from: None if a wrapper further in takes them.
        """
        if self.inside is not None:
            check_shared(settings, self.inside.settings)
            return self.inside.demonstrations, None
        if self.has("retrieval_settings"):
            raise ValueError(
                "each environment has a retrieval wrapper already: wrap either each of them or "
                "all together"
            )
        demos = demonstrations(settings["demo"])
        check_demonstrations(self, demos, settings)
        label = labels_of(settings["demo"])[0]
        image = settings["image"]
        return demos, FrameSource(self, demos[0], label, image, self.resets_at_once)


class Episodes:
    """The episodes of n environments, beside the same demonstrations.

    Args:
        n: how many environments.
        demos: the demonstrations.
        settings: what decides an alignment (`regil_wrappers.retrieval_wrapper.settings_of`).
        frames: where pictures come from.

    Attributes:
        current: of each environment, its episode.
        stepped: by environment, the episode in which `advance` made a step.
        begun: by environment, the episode that began in it.
        latency: how long steps of all together took.
    """

    def __init__(
        self,
        n: int,
        demos: Sequence[Demonstration],
        settings: dict[str, Any],
        frames: FrameSource,
    ) -> None:
        self.demonstrations = demos
        self.settings = settings
        self.frames = frames
        self.latency = Latency(settings["deadline_ms"])
        # The deadline is for all together
        self.retriever = make_retriever(demos, {**settings, "deadline_ms": None}, frames)
        register = settings["register"]
        self.current = [
            Episode(self.retriever.another(), frames.another(), register) for _ in range(n)
        ]
        self.stepped: dict[int, Episode] = {}
        self.begun: dict[int, Episode] = {}

    def advance(self, stepped: Mapping[int, Any], begun: Mapping[int, Any]) -> None:
        """Align what was seen: one call of the encoder.

        Args:
            stepped: by environment, what a step led to, as `FrameSource.raw` gives it; where it
                ended an episode, that episode's last.
            begun: by environment, what its new episode began with.

        Raises:
            ValueError: if a step was made before the first episode began.
        """
        self.stepped = {i: self.current[i] for i in stepped}
        for episode in self.stepped.values():
            _ = episode.last
        pictures = [self.current[i].picture(raw) for i, raw in stepped.items()]
        self.begun = {i: self.current[i].another() for i in begun}
        pictures += [self.begun[i].picture(raw) for i, raw in begun.items()]
        for i, episode in self.begun.items():
            self.current[i] = episode
        episodes = [*self.stepped.values(), *self.begun.values()]
        step_together([episode.retriever for episode in episodes], pictures, self.latency)


class Guides:
    """A guide for each environment, with the arguments of `regil_wrappers.RetrievalGuideWrapper`.

    Call `before` and `after` around each step, and `begin` where episodes may have begun.

    Raises:
        ValueError: as `regil_wrappers.RetrievalGuideWrapper`.
    """

    def __init__(
        self,
        several: Several,
        settings: dict[str, Any],
        guide_offset: int,
        guide_patience: int | None,
        correction: str,
        disturbance: float,
        **declared: Any,
    ) -> None:
        demos, frames = several.checked(settings)
        check_guide(guide_offset, guide_patience, correction, disturbance, len(demos))
        actions = fitting_actions(several.action_space, demos, settings["demo"])
        told = stated(several.metadata)
        warn_of_rate(told, demos, settings["demo"])
        self.episodes = _episodes(several, demos, settings, frames)
        servos: list[Servo | None] = [None] * several.n
        if correction == "servo":
            size = self.episodes.retriever.picture_size
            for i in range(several.n):
                servos[i] = make_servo(
                    told, several.action_space, size, actions[0], declared, disturbance
                )
                if servos[i] is None:  # it has said why, and the others would be no different
                    break
        self.guides = [Guide(actions, guide_offset, guide_patience, servo) for servo in servos]
        self._shape = (several.n, *actions[0].shape[1:])

    def actions(self, name: str = "action") -> NDArray[np.float32]:
        """(n, A) float32: what each says, by the name of a method of `Guide`.

        Raises:
            ValueError: before the first episode of one.
        """
        return np.stack([getattr(guide, name)() for guide in self.guides])

    def before(self, actions: Any) -> None:
        """A step is to be made.

        Args:
            actions: what will be executed, (n, A).

        Raises:
            ValueError: if they have another shape, or before the first episode of one.
        """
        self._executed = np.array(actions, np.float32)
        if self._executed.shape != self._shape:
            raise ValueError(
                f"actions have the shape {self._executed.shape}: {self._shape[0]} environments "
                f"take {self._shape}"
            )
        self._suggested = [guide.action() for guide in self.guides]

    def after(self, succeeded: Callable[[int], bool | None]) -> Said:
        """The step was made, and `Episodes.advance` has aligned what it led to.

        Args:
            succeeded: whether an environment's episode ended well; None: it goes on.

        Returns:
            for the environments in which it was made.
        """
        said = {}
        for i, episode in self.episodes.stepped.items():
            alignment = episode.retriever.alignment
            self.guides[i].after(
                self._executed[i], self._suggested[i], alignment, episode.last, succeeded(i)
            )
            said[i] = {**said_of(alignment), **self.guides[i].said()}
        return said

    def begin(self, seeds: Sequence[int | None] | None = None) -> Said:
        """Begin the episodes that `Episodes.advance` has begun.

        Args:
            seeds: of each environment's reset, where it has one.

        Returns:
            for the environments that began one.
        """
        said = {}
        for i, episode in self.episodes.begun.items():
            alignment = episode.retriever.alignment
            seed = None if seeds is None else seeds[i]
            displacement = partial(getattr, episode, "displacement")
            self.guides[i].begin(alignment, displacement, episode.apart, episode.shift_at, seed)
            said[i] = {**said_of(alignment), **self.guides[i].said()}
        return said

    def set_calibration(self, calibration: dict[str, Any]) -> None:
        """Give all guides this calibration.

        Raises:
            ValueError: if it is not one, or from pictures of another size.
        """
        for guide in self.guides:
            guide.set_calibration(calibration)


class Rewards:
    """A reward for each environment, with the arguments of `RetrievalRewardWrapper`.

    Raises:
        ValueError: as `regil_wrappers.RetrievalRewardWrapper`.
    """

    def __init__(
        self,
        several: Several,
        settings: dict[str, Any],
        reward: str,
        mode: str,
        weight: float,
        divisor: str,
    ) -> None:
        demos, frames = several.checked(settings)
        check_reward(reward, mode, weight, divisor, settings["search"])
        check_inside(reward, several.late)
        self.episodes = _episodes(several, demos, settings, frames)
        self._adds = mode == "add"
        self._weight = weight
        horizon = settings["horizon"] if divisor == "horizon" else None
        self._signal = make_signal(reward, self.episodes.retriever, horizon)
        self._signals: dict[int, Signal] = {}

    @property
    def scale(self) -> float:
        """What makes a typical step's reward about 1 in size, from the demonstration alone."""
        return self._signal.scale

    def after(self, env_rewards: Any, over: Any) -> tuple[NDArray[np.float64], Said]:
        """A step was made, and `Episodes.advance` has aligned what it led to.

        Args:
            env_rewards: (n,) the environments' own.
            over: (n,) whether it ended an episode.

        Returns:
            (n,) float64: the rewards, the environment's where it was not made; and what to say
            for those in which it was.
        """
        rewards = np.array(env_rewards, np.float64)
        said: Said = {}
        for i, episode in self.episodes.stepped.items():
            signal, env_reward = self._signals[i], float(env_rewards[i])
            rewards[i] = self._weight * signal.step()
            if self._adds:
                rewards[i] += env_reward
            said[i] = {**said_of(episode.retriever.alignment), "env_reward": env_reward}
            if over[i] and (late := signal.end()) is not None:
                said[i]["episode_rewards"] = (self._weight * late).astype(np.float32)
                said[i]["episode_scale"] = episode_scale(late)
        return rewards, said

    def begin(self) -> Said:
        """Begin the episodes that `Episodes.advance` has begun.

        Returns:
            for the environments that began one.
        """
        said = {}
        for i, episode in self.episodes.begun.items():
            self._signals[i] = self._signal.another(episode.retriever)
            self._signals[i].begin()
            said[i] = said_of(episode.retriever.alignment)
        return said


def _episodes(
    several: Several,
    demos: Sequence[Demonstration],
    settings: dict[str, Any],
    frames: FrameSource | None,
) -> Episodes:
    if several.inside is not None:
        return several.inside
    assert frames is not None
    return Episodes(several.n, demos, settings, frames)
