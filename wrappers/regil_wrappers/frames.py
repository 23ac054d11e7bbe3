"""Where an environment's pictures come from, and whether a demonstration's compare with them.

* ``FrameSource`` - takes the picture out of an observation, a render or a larger frame
* ``Asked`` - what is asked for it: an environment, or several at once
* ``check_recorded_settings`` - camera, render settings and action repeat are those of the recording
* ``stated`` - what an environment says of itself in its metadata
* ``check_size``, ``check_upright`` - two first frames have one size and are the same way up
"""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping
from typing import Any, Protocol, cast

import cv2
import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from regil_wrappers.demonstration import Demonstration

__all__ = [
    "AS_RECORDED",
    "Asked",
    "FrameSource",
    "check_recorded_settings",
    "check_size",
    "check_upright",
    "stated",
]

AS_RECORDED = ("camera", "render", "action_repeat")
"""What decides how frames look and follow each other, where an environment states it."""

# A first frame counts as turned when most of a 28 x 28 picture differs from the demonstration's (by
# more than _DIFFERENT of 255 in some channel) and turning it leaves less than half of that. Objects
# at other places change fewer pixels than _TURNED. Exchanged colours show wherever there is colour,
# of which there may be little: _SWAPPED is smaller, but most coloured pixels must have changed.
_DIFFERENT = 25
_TURNED = 0.25
_SWAPPED = 0.05


class Asked(Protocol):
    """A `gymnasium.Env`; or several of them, which answer `render` and methods with sequences."""

    @property
    def observation_space(self) -> gym.Space[Any]:
        """Of one environment."""
        ...

    @property
    def render_mode(self) -> str | None:
        """How `render` draws."""
        ...

    @property
    def unwrapped(self) -> Any:
        """What has the ``metadata``."""
        ...

    def render(self) -> Any:
        """The picture, or that of each."""
        ...

    def has_wrapper_attr(self, name: str) -> bool:
        """Whether it, or each of them, has this attribute."""
        ...

    def get_wrapper_attr(self, name: str) -> Any:
        """The attribute; of several a function that calls each one's."""
        ...


class FrameSource:
    """Takes the current picture of an environment, the way the demonstration's was taken.

    Of several environments it takes the pictures together: `another` for each one checks them.

    Args:
        env: the environment, or several.
        demo: the demonstration that pictures will be compared with.
        label: what errors call it.
        image: "obs", "obs:KEY" or "render".
        resets_at_once: whether the environment begins its next episode in the step that ends one,
            so that only an observation can show an episode's last picture.

    Raises:
        ValueError: if there is no such picture, or it has another size than the demonstration's.
    """

    def __init__(
        self,
        env: Asked,
        demo: Demonstration,
        label: str,
        image: str,
        resets_at_once: bool = False,
    ) -> None:
        self._env = env
        self._demo = demo
        self._label = label
        self._render = image == "render"
        self._key: str | None = None
        self._channels_first = False
        self._first_is_checked = False
        self._encoder_size: int | None = None
        self._resets_at_once = resets_at_once
        if self._render:
            self._check_last("image='render'")
            if env.render_mode != "rgb_array":
                raise ValueError(
                    f"image='render' needs render_mode='rgb_array', but the environment was made "
                    f"with {env.render_mode!r}"
                )
            return
        space: gym.Space[Any] = env.observation_space
        if isinstance(space, gym.spaces.Dict):
            pictures = [name for name, inside in space.spaces.items() if _is_picture(inside)]
            self._key = image.removeprefix("obs:") if image.startswith("obs:") else None
            # Where there is no picture at all, it is said below why the one named is none
            if self._key is None or self._key not in (pictures or space.spaces):
                raise ValueError(
                    f"image={image!r} with dict observations: use one of "
                    f"{[f'obs:{name}' for name in pictures] + ['render']}"
                )
            space = space.spaces[self._key]
        elif image != "obs":
            raise ValueError(
                f"image={image!r}: use 'obs' or 'render' ('obs:KEY' needs dict observations)"
            )
        if not _is_picture(space):
            raise ValueError(
                f"observations are {space.dtype} {space.shape}, not one RGB picture "
                f"uint8 (H, W, 3): {_cure(space)}"
            )
        height, width, depth = cast("tuple[int, int, int]", space.shape)
        self._channels_first = depth != 3
        size = (width, depth) if self._channels_first else (height, width)
        check_size(size, demo.frames.shape[1:3], label)

    @property
    def hand_starts_elsewhere(self) -> bool:
        """Whether the environment says that its hand does not start in one place."""
        return stated(self._env.unwrapped.metadata).get("start_std") is not None

    def use_encoder_frames(self) -> bool:
        """Take the environment's larger pictures from now on, where there are such.

        They are asked for in the size that was recorded: only pictures rendered alike compare.

        Returns:
            whether both have them.
        """
        larger = self._demo.encoder_frames
        if larger is None or not self._env.has_wrapper_attr("encoder_frame"):
            return False
        self._check_last(f"{self._label} holds {larger.shape[1]}-pixel encoder_frames")
        self._encoder_size = larger.shape[1]
        self._channels_first = False  # observations may be; these are (H, W, 3)
        return True

    def _check_last(self, why: str) -> None:
        if self._resets_at_once:
            raise ValueError(
                f"{why}, but these environments begin the next episode before the last picture of "
                "one can be asked for: put the picture into observations "
                "(gymnasium.wrappers.AddRenderObservation) and use image='obs' or 'obs:KEY', or "
                "another autoreset mode where there is one"
            )

    def another(self) -> FrameSource:
        """One more that has compared no picture yet, for an environment beside this one."""
        twin = copy.copy(self)
        twin._first_is_checked = False
        return twin

    @property
    def recorded_first(self) -> NDArray[np.uint8]:
        """The first of `recorded`, (H, W, 3) uint8."""
        return cast("NDArray[np.uint8]", self.recorded[0])

    @property
    def recorded(self) -> NDArray[np.uint8]:
        """The demonstration's pictures of the kind that `picture` gives, (T, H, W, 3) uint8."""
        if self._encoder_size is not None:
            return cast("NDArray[np.uint8]", self._demo.encoder_frames)
        return self._demo.frames

    def raw(self, observation: Any) -> Any:
        """What the current picture is made of, as the environment gives it.

        Args:
            observation: the environment's last observation.

        Returns:
            of several environments, a sequence.
        """
        if self._encoder_size is not None:
            return self._env.get_wrapper_attr("encoder_frame")(self._encoder_size)
        if self._render:
            return self._env.render()
        return observation if self._key is None else observation[self._key]

    def picture(self, raw: Any) -> NDArray[np.uint8]:
        """The picture, (H, W, 3) uint8; the very first one is compared with the recording.

        Args:
            raw: what `raw` gave, of one environment.

        Raises:
            ValueError: if it is no RGB picture, or the first one has another size or is not the
                same way up.
        """
        frame = np.moveaxis(raw, 0, -1) if self._channels_first else raw
        rgb = np.shape(frame)[2:] == (3,)
        if not isinstance(frame, np.ndarray) or frame.dtype != np.uint8 or not rgb:
            got = f"{getattr(frame, 'dtype', type(frame).__name__)} {np.shape(frame)}"
            raise ValueError(f"the environment's picture is {got}: it must be uint8 (H, W, 3), RGB")
        if not self._first_is_checked:
            recorded = self.recorded_first
            check_size(frame.shape[:2], recorded.shape[:2], self._label)
            check_upright(frame, recorded, self._label)
            self._first_is_checked = True
        return frame


def _is_picture(space: gym.Space[Any]) -> bool:
    return (
        isinstance(space, gym.spaces.Box)
        and space.dtype == np.uint8
        and len(space.shape) == 3
        and 3 in (space.shape[0], space.shape[2])
    )


def _cure(space: gym.Space[Any]) -> str:
    """What to do about observations that are no picture."""
    shape = space.shape or ()
    channels = min(shape[0], shape[2]) if len(shape) == 3 else 0
    if len(shape) == 4 or (channels > 3 and channels % 3 == 0):
        return "put frame stacking outside this wrapper"
    if channels == 3:
        return "convert them to uint8, 0 to 255, inside this wrapper, or use image='render'"
    if channels or (len(shape) == 2 and space.dtype == np.uint8):
        return "give three channels, RGB without alpha, or use image='render'"
    return "use image='render'"


def stated(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """What an environment states of itself in its ``metadata["regil"]``; nothing is fine."""
    return dict(metadata.get("regil") or {})


def check_recorded_settings(env: Asked, metadata: dict[str, Any], label: str) -> None:
    """Refuse a camera, render settings or action repeat other than the recording's.

    Environments that do not state theirs (``metadata["regil"]``) pass.

    Args:
        env: the environment.
        metadata: the demonstration's.
        label: what errors call the demonstration.

    Raises:
        ValueError: naming the setting and both values.
    """
    here = stated(env.unwrapped.metadata)
    for name in AS_RECORDED:
        recorded = metadata[name]
        if recorded not in (None, {}) and _as_json(here.get(name, recorded)) != _as_json(recorded):
            raise ValueError(
                f"{label} was recorded with {name} {recorded!r} but the environment has "
                f"{here[name]!r}: make the environment with the recorded one, or record again"
            )


def _as_json(value: Any) -> Any:
    """As a file would give it back: what was recorded has been in one."""

    def plain(one: Any) -> Any:
        return one.tolist() if isinstance(one, np.ndarray | np.generic) else str(one)

    return json.loads(json.dumps(value, default=plain))


def check_size(size: tuple[int, ...], recorded: tuple[int, ...], label: str) -> None:
    """Refuse pictures of another size than the recording's, both (height, width) in pixels.

    Raises:
        ValueError: naming both.
    """
    if size != recorded:
        height, width = size
        again = f"with --size {height}" if height == width else "at that size"
        raise ValueError(
            f"{label} has {recorded[0]}x{recorded[1]} frames but the environment gives "
            f"{height}x{width}: record it again {again}"
        )


def check_upright(frame: NDArray[np.uint8], recorded: NDArray[np.uint8], label: str) -> None:
    """Refuse a first frame that is the recording's upside down, mirrored or with colours exchanged.

    Args:
        frame: (H, W, 3) uint8, the environment's first frame.
        recorded: (H, W, 3) uint8, the demonstration's first frame.
        label: what the error calls the demonstration.

    Raises:
        ValueError: naming what was done to it.
    """
    here, there = (
        cv2.resize(picture, (28, 28), interpolation=cv2.INTER_AREA).astype(np.int16)
        for picture in (frame, recorded)
    )

    def changed(picture: NDArray[np.int16], among: Any = ...) -> float:
        return float((np.abs(picture - there).max(axis=2) > _DIFFERENT)[among].mean())

    coloured = np.abs(there[..., 0] - there[..., 2]) > _DIFFERENT
    swaps = coloured.any() and changed(here, coloured) > 0.5
    turned = {
        "upside down": here[::-1],
        "mirrored": here[:, ::-1],
        "turned by 180 degrees": here[::-1, ::-1],
    }
    swapped = {
        f"{name}, with red and blue exchanged": picture[..., ::-1]
        for name, picture in turned.items()
    }
    for least, variants in (
        (_SWAPPED, {"with red and blue exchanged": here[..., ::-1] if swaps else here}),
        (_TURNED, turned | swapped),
    ):
        name, picture = min(variants.items(), key=lambda variant: changed(variant[1]))
        if changed(here) > least and changed(picture) < 0.5 * changed(here):
            raise ValueError(
                f"the environment's first frame is that of {label} {name}: "
                f"fix the environment's picture, or record again"
            )
