"""Encoders by name.

* ``encoder_names``, ``make_encoder``, ``register_encoder``
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

from regil_wrappers.encoders.pixels import PixelsEncoder
from regil_wrappers.encoders.protocol import Encoder
from regil_wrappers.encoders.timm_networks import TimmEncoder

__all__ = ["encoder_names", "make_encoder", "register_encoder"]

_factories: dict[str, Callable[[], Encoder]] = {
    "pixels": PixelsEncoder,
}

#: Short names: timm's model and the side of its input (None: its own).
_TIMM_NAMES: dict[str, tuple[str, int | None]] = {
    # At its own 518 pixels one picture takes about a second on a processor.
    "dinov2": ("vit_small_patch14_dinov2.lvd142m", 224),
    "dinov3": ("vit_small_patch16_dinov3.lvd1689m", None),
}


def encoder_names() -> list[str]:
    """Names that `make_encoder` takes, ``"timm:<model>"`` standing for all of timm's."""
    return [*sorted([*_factories, *_TIMM_NAMES]), "timm:<model>"]


def register_encoder(name: str, factory: Callable[[], Encoder]) -> None:
    """Make an encoder available by name, in this process.

    Args:
        name: what ``encoder=`` takes then; not one that exists, and without ':' and '@'.
        factory: called without arguments, once a process.

    Raises:
        ValueError: if the name is taken or has one of these.
    """
    if name in _factories or name in _TIMM_NAMES or ":" in name or "@" in name:
        raise ValueError(f"encoder name {name!r} is taken, or has ':' or '@': choose another")
    _factories[name] = factory


@lru_cache(maxsize=4)
def make_encoder(name: str) -> Encoder:
    """The encoder of that name; when asked again the same object, so that weights are shared.

    Args:
        name: one of `encoder_names()`; ``"timm:<model>@FILE"`` and ``"dinov3@FILE"`` read the
            weights from a file.

    Raises:
        ValueError: if there is no encoder of that name, or its weights cannot be had.
        ImportError: if it needs a package that is not installed.
    """
    if name in _factories:
        return _factories[name]()
    known, _, file = name.partition("@")
    if known in _TIMM_NAMES:
        model, size = _TIMM_NAMES[known]
        return TimmEncoder(model, file or None, size)
    if known.startswith("timm:"):
        return TimmEncoder(known.removeprefix("timm:"), file or None)
    raise ValueError(f"unknown encoder {name!r}: choose one of {encoder_names()}")
