"""What the retrieval wrappers share: one alignment in a stack, and what it is made from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, SupportsFloat, cast

import gymnasium as gym
import numpy as np
from gymnasium.core import ActType, ObsType
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from regil_wrappers.apart import Apart
from regil_wrappers.demonstration import Demonstration
from regil_wrappers.demonstrations import (
    Demonstrations,
    as_given,
    demonstrations,
    labels_of,
    outlines,
)
from regil_wrappers.encoders import Encoder, make_encoder
from regil_wrappers.episode import Episode
from regil_wrappers.frames import Asked, FrameSource, check_recorded_settings
from regil_wrappers.latency import Latency
from regil_wrappers.matching import Point
from regil_wrappers.registration import Displacement
from regil_wrappers.retrieval import Alignment, Retriever, check_settings

__all__ = [
    "RetrievalWrapper",
    "check_demonstrations",
    "check_shared",
    "checked",
    "make_retriever",
    "said_of",
    "settings_of",
]


class RetrievalWrapper(gym.Wrapper[ObsType, ActType, ObsType, ActType]):
    """What both share. The innermost one owns the retriever and feeds it, those outside read it."""

    _saved_kwargs: dict[str, Any]

    def __init__(
        self,
        env: gym.Env[ObsType, ActType],
        demos: Sequence[Demonstration],
        settings: dict[str, Any],
        frames: FrameSource | None,
    ) -> None:
        gym.Wrapper.__init__(self, env)
        self.demonstrations = demos
        self.retrieval_settings = settings
        self._frames = frames
        if frames is None:
            self.retriever: Retriever = env.get_wrapper_attr("retriever")
            return
        self.retriever = make_retriever(demos, settings, frames)
        self._episode = Episode(self.retriever, frames, settings["register"])

    @property
    def alignment(self) -> Alignment:
        """The alignment of the current frame; there is one from the first reset on."""
        return self.retriever.alignment

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]
        """What `gym.make` rebuilds the stack from; None with objects in place of names."""
        # A path is saved as text; a Demonstration or an encoder object has no name to save.
        demo = self._saved_kwargs["demo"]
        named = [self._saved_kwargs["encoder"], *(demo if isinstance(demo, list) else [demo])]
        if not all(isinstance(name, str) for name in named):
            return None
        return super().spec

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObsType, dict[str, Any]]:
        """Reset the environment and align its first frame."""
        observation, info = self.env.reset(seed=seed, options=options)
        if self._frames is not None:
            self._episode.begin()
            self.retriever.step(self._episode.picture(self._frames.raw(observation)))
        return observation, info

    def step(self, action: ActType) -> tuple[ObsType, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step the environment and align the frame that follows."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if self._frames is not None:
            self.retriever.step(self._episode.picture(self._frames.raw(observation)))
        return observation, reward, terminated, truncated, info

    @property
    def retrieval_frame(self) -> NDArray[np.uint8]:
        """The picture aligned last, (H, W, 3) uint8, as the camera saw it."""
        if self._frames is None:
            return cast("NDArray[np.uint8]", self.env.get_wrapper_attr("retrieval_frame"))
        return self._episode.last

    @property
    def displacement(self) -> Displacement | None:
        """What moved between the demonstration's first picture and this episode's; None: nothing.

        Found when it is first asked for in an episode (about 0.1 s at 84x84, longer by its pixels).
        """
        if self._frames is None:
            return cast("Displacement | None", self.env.get_wrapper_attr("displacement"))
        return self._episode.displacement

    def apart(self, grasp: int, near: tuple[Point, Point] | None = None) -> Apart:
        """How far what the demonstration takes up has moved since it began, and what else.

        Args:
            grasp: the step in which its gripper closes.
            near: (x, y) px, where its hand grasps and where it ends: only what stands near them
                counts. None: everything does.
        """
        if self._frames is None:
            return cast("Apart", self.env.get_wrapper_attr("apart")(grasp, near))
        return self._episode.apart(grasp, near)

    def shift_at(self, point: Point) -> Point:
        """How far what stands round a point (x, y) px has shifted since the demonstration began."""
        if self._frames is None:
            return cast("Point", self.env.get_wrapper_attr("shift_at")(point))
        return self._episode.shift_at(point)

    def _with_retrieval(self, info: dict[str, Any], **own: Any) -> dict[str, Any]:
        inner = info["retrieval"] if self._frames is None else {}
        return {**info, "retrieval": {**said_of(self.alignment), **own, **inner}}


def said_of(alignment: Alignment) -> dict[str, Any]:
    """What ``info["retrieval"]`` holds of an alignment."""
    a = alignment
    return {"demonstration": a.demonstration, "start": a.start, "end": a.end, "cost": a.cost}


def make_retriever(
    demos: Sequence[Demonstration], settings: dict[str, Any], frames: FrameSource
) -> Retriever:
    """The retriever of these settings, of larger pictures where encoder and `frames` have such."""
    encoder = settings["encoder"]
    if isinstance(encoder, str):
        encoder = make_encoder(encoder)
    larger = getattr(encoder, "frame_size", None) is not None and frames.use_encoder_frames()
    return Retriever(
        demos,
        encoder,
        settings["k"],
        settings["horizon"],
        settings["step_pattern"],
        use_encoder_frames=larger,
        search=settings["search"],
        deadline_ms=settings["deadline_ms"],
    )


def settings_of(
    demo: Demonstrations,
    encoder: str | Encoder,
    k: int,
    horizon: int,
    image: str,
    step_pattern: str,
    register: bool,
    search: str,
    deadline_ms: float | None,
) -> dict[str, Any]:
    """The arguments that decide an alignment, as a specification can hold them."""
    return {
        "demo": as_given(demo),
        "encoder": encoder,
        "k": k,
        "horizon": horizon,
        "image": image,
        "step_pattern": step_pattern,
        "register": register,
        "search": search,
        "deadline_ms": deadline_ms,
    }


def checked(
    env: gym.Env[Any, Any], settings: dict[str, Any]
) -> tuple[Sequence[Demonstration], FrameSource | None]:
    """Refuse what does not fit, before any long work.

    Returns:
        the demonstrations, and where frames come from: None if a retrieval wrapper further in takes
        them.
    """
    if not isinstance(env, gym.Env):
        raise ValueError(
            f"{env!r} is no gymnasium.Env: regil_wrappers.vector has the same wrappers for vector "
            "environments"
        )
    _check_resets(env)
    if env.has_wrapper_attr("retrieval_settings"):
        check_shared(settings, env.get_wrapper_attr("retrieval_settings"))
        return env.get_wrapper_attr("demonstrations"), None
    demos = demonstrations(settings["demo"])
    check_demonstrations(env, demos, settings)
    return demos, FrameSource(env, demos[0], labels_of(settings["demo"])[0], settings["image"])


def _check_resets(env: gym.Env[Any, Any]) -> None:
    """Refuse an environment that resets itself unseen: an alignment would go on over its episodes.

    Raises:
        ValueError: if `gymnasium.wrappers.Autoreset` is anywhere in it.
    """
    while isinstance(env, gym.Wrapper):
        if isinstance(env, gym.wrappers.Autoreset):
            raise ValueError(
                "gymnasium.wrappers.Autoreset is inside this wrapper, which would not see where "
                "an episode begins: put Autoreset outside this wrapper"
            )
        env = env.env


def check_shared(settings: dict[str, Any], inside: dict[str, Any]) -> None:
    """Refuse settings other than those of the retrieval wrapper inside.

    Raises:
        ValueError: naming the setting and both values.
    """
    for name, value in settings.items():
        other = inside[name]
        if value is other or (isinstance(value, (str, int, float, list)) and value == other):
            continue
        raise ValueError(
            f"{name}={_shown(value)}, but the retrieval wrapper inside has {_shown(other)}: "
            f"wrappers in one stack share one alignment, give both the same"
        )


def check_demonstrations(
    env: Asked, demos: Sequence[Demonstration], settings: dict[str, Any]
) -> None:
    """Refuse settings, and demonstrations that do not fit them or were recorded otherwise.

    Raises:
        ValueError: naming what would be right.
    """
    if not isinstance(settings["register"], bool):
        raise ValueError(f"register={settings['register']!r}: it must be True or False")
    if settings["register"] and len(demos) > 1:
        raise ValueError(
            f"register=True moves pictures back to where one demonstration's target stood, and "
            f"there are {len(demos)}: give one, or register=False"
        )
    encoder = settings["encoder"]
    if not isinstance(encoder, str) and not hasattr(encoder, "encode"):
        raise ValueError(f"encoder={encoder!r}: give a name, or an object with encode(frames)")
    Latency(settings["deadline_ms"])
    labels = labels_of(settings["demo"])
    lengths = []
    for outline, label in zip(outlines(demos), labels, strict=True):
        lengths.append(outline.shape[0])
        check_recorded_settings(env, outline.metadata, label)
    check_settings(
        lengths,
        settings["k"],
        settings["horizon"],
        settings["step_pattern"],
        labels,
        settings["search"],
    )


def _shown(value: Any) -> str:
    return repr(value) if isinstance(value, (str, int, float)) else f"<{type(value).__name__}>"
