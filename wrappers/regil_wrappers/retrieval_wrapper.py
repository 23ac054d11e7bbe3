"""What the retrieval wrappers share: one alignment in a stack, and what it is made from."""

from __future__ import annotations

import os
from typing import Any, SupportsFloat, cast

import gymnasium as gym
import numpy as np
from gymnasium.core import ActType, ObsType
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from regil_wrappers.demonstration import Demonstration
from regil_wrappers.encoders import Encoder, make_encoder
from regil_wrappers.episode import Episode
from regil_wrappers.frames import FrameSource, check_recorded_settings
from regil_wrappers.registration import Displacement
from regil_wrappers.retrieval import Alignment, Retriever, check_settings

__all__ = ["RetrievalWrapper", "checked", "label_of", "make_retriever", "settings_of"]


class RetrievalWrapper(gym.Wrapper[ObsType, ActType, ObsType, ActType]):
    """What both share. The innermost one owns the retriever and feeds it, those outside read it."""

    _saved_kwargs: dict[str, Any]

    def __init__(
        self,
        env: gym.Env[ObsType, ActType],
        demo: Demonstration,
        settings: dict[str, Any],
        frames: FrameSource | None,
    ) -> None:
        gym.Wrapper.__init__(self, env)
        self.demonstration = demo
        self.retrieval_settings = settings
        self._frames = frames
        if frames is None:
            self.retriever: Retriever = env.get_wrapper_attr("retriever")
            return
        self.retriever = make_retriever(demo, settings, frames)
        self._episode = Episode(self.retriever, frames, settings["register"])

    @property
    def alignment(self) -> Alignment:
        """The alignment of the current frame; there is one from the first reset on."""
        return self.retriever.alignment

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]
        """What `gym.make` rebuilds the stack from; None with objects in place of names."""
        # A path is saved as text; a Demonstration or an encoder object has no name to save.
        if not all(isinstance(self._saved_kwargs[key], str) for key in ("demo", "encoder")):
            return None
        return super().spec

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObsType, dict[str, Any]]:
        """Reset the environment and align its first frame."""
        observation, info = self.env.reset(seed=seed, options=options)
        if self._frames is not None:
            self._episode.begin()
            self.retriever.step(self._episode.picture(observation))
        return observation, info

    def step(self, action: ActType) -> tuple[ObsType, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step the environment and align the frame that follows."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if self._frames is not None:
            self.retriever.step(self._episode.picture(observation))
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

        Found when it is first asked for in an episode (about 0.1 s).
        """
        if self._frames is None:
            return cast("Displacement | None", self.env.get_wrapper_attr("displacement"))
        return self._episode.displacement

    def _with_retrieval(self, info: dict[str, Any], **own: Any) -> dict[str, Any]:
        a = self.alignment
        inner = info["retrieval"] if self._frames is None else {}
        return {
            **info,
            "retrieval": {"start": a.start, "end": a.end, "cost": a.cost, **own, **inner},
        }


def make_retriever(demo: Demonstration, settings: dict[str, Any], frames: FrameSource) -> Retriever:
    """The retriever of these settings, of larger pictures where encoder and `frames` have such."""
    encoder = settings["encoder"]
    if isinstance(encoder, str):
        encoder = make_encoder(encoder)
    larger = getattr(encoder, "frame_size", None) is not None and frames.use_encoder_frames()
    return Retriever(
        demo,
        encoder,
        settings["k"],
        settings["horizon"],
        settings["step_pattern"],
        use_encoder_frames=larger,
    )


def settings_of(
    demo: str | os.PathLike[str] | Demonstration,
    encoder: str | Encoder,
    k: int,
    horizon: int,
    image: str,
    step_pattern: str,
    register: bool,
) -> dict[str, Any]:
    """The arguments that decide an alignment, as a specification can hold them."""
    return {
        "demo": demo if isinstance(demo, Demonstration) else os.fspath(demo),
        "encoder": encoder,
        "k": k,
        "horizon": horizon,
        "image": image,
        "step_pattern": step_pattern,
        "register": register,
    }


def checked(
    env: gym.Env[Any, Any], settings: dict[str, Any]
) -> tuple[Demonstration, FrameSource | None]:
    """Refuse what does not fit, before any long work.

    Returns:
        the demonstration, and where frames come from: None if a retrieval wrapper further in takes
        them.
    """
    demo = settings["demo"]
    label = label_of(demo)
    if env.has_wrapper_attr("retrieval_settings"):
        inside = env.get_wrapper_attr("retrieval_settings")
        for name, value in settings.items():
            other = inside[name]
            if value is other or (isinstance(value, (str, int)) and value == other):
                continue
            raise ValueError(
                f"{name}={_shown(value)}, but the retrieval wrapper inside has {_shown(other)}: "
                f"wrappers in one stack share one alignment, give both the same"
            )
        return env.get_wrapper_attr("demonstration"), None
    if not isinstance(demo, Demonstration):
        demo = Demonstration.load(demo)
    if not isinstance(settings["register"], bool):
        raise ValueError(f"register={settings['register']!r}: it must be True or False")
    check_settings(demo, settings["k"], settings["horizon"], settings["step_pattern"], label)
    encoder = settings["encoder"]
    if not isinstance(encoder, str) and not hasattr(encoder, "encode"):
        raise ValueError(f"encoder={encoder!r}: give a name, or an object with encode(frames)")
    check_recorded_settings(env, demo, label)
    return demo, FrameSource(env, demo, label, settings["image"])


def label_of(demo: str | Demonstration) -> str:
    """What messages call the demonstration: its file, where it has one."""
    return f"demo {demo!r}" if isinstance(demo, str) else "the demonstration"


def _shown(value: Any) -> str:
    return repr(value) if isinstance(value, (str, int)) else f"<{type(value).__name__}>"
