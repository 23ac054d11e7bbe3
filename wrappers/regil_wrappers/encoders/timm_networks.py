"""``TimmEncoder`` - pretrained networks of timm. torch and timm are imported when one is made."""

from __future__ import annotations

import hashlib
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["TimmEncoder"]


class TimmEncoder:
    """A pretrained network of `timm <https://huggingface.co/docs/timm>`_.

    The embedding is its pooled features, L2-normalised. Frames are resized to the network's own
    input size (area when shrinking, cubic when enlarging; the whole picture, no crop) and
    standardised by its own mean and standard deviation.

    Args:
        model: timm's name, for example ``"vit_small_patch16_dinov3.lvd1689m"``.
        file: checkpoint to read instead of the Hugging Face download.
        size: side of the input in pixels; None is the network's own.
        device: torch device; None is "cuda" where there is one, else "cpu".

    Raises:
        ImportError: if torch or timm is not installed.
        ValueError: if timm has no such model, or its weights are neither here nor downloadable.
    """

    slow = True

    def __init__(
        self,
        model: str,
        file: str | None = None,
        size: int | None = None,
        device: str | None = None,
    ) -> None:
        timm, torch = _import_timm()
        name = f"timm:{model}"
        if not timm.is_model(model):
            close = timm.list_models(f"*{model.split('.')[0].split('_')[0]}*", pretrained=True)[:5]
            raise ValueError(
                f"encoder {name!r}: timm {timm.__version__} has no model of that name"
                + (f": did you mean one of {close}?" if close else "")
            )
        if file is not None and not Path(file).is_file():
            raise ValueError(f"encoder {name!r}: there is no checkpoint file {file!r}")
        options: dict[str, Any] = {} if size is None else {"img_size": size}
        if file is not None:
            options["pretrained_cfg_overlay"] = {"file": file}
        try:
            network = timm.create_model(model, pretrained=True, num_classes=0, **options)
        except Exception as error:  # timm and its hub client raise a dozen unrelated types here
            reason = f"{type(error).__name__}: {error}".splitlines()[0][:200]
            if file is not None:
                what = f"its weights could not be read from {file!r} ({reason})"
            else:
                what = (
                    f"its weights could not be downloaded ({type(error).__name__}): get "
                    f"model.safetensors from https://huggingface.co/timm/{model} and add '@' and "
                    f"that file's path to the encoder's name"
                )
            raise ValueError(f"encoder {name!r}: {what}") from error
        config = timm.data.resolve_model_data_config(network)
        self._torch = torch
        self._device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        self._network = network.eval().requires_grad_(False).to(self._device)
        self._size: int = size or config["input_size"][-1]
        self._mean = torch.tensor(config["mean"], device=self._device).view(1, 3, 1, 1)
        self._std = torch.tensor(config["std"], device=self._device).view(1, 3, 1, 1)
        self.frame_size: int | None = self._size
        weights = hashlib.sha256()
        for key, value in sorted(network.state_dict().items()):
            weights.update(f"{key} {tuple(value.shape)} {value.dtype}".encode())
            weights.update(value.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy())
        self.cache_key: str | None = (
            f"{name} size={self._size} mean={config['mean']} std={config['std']} "
            f"timm={timm.__version__} torch={torch.__version__} device={self._device} "
            f"weights={weights.hexdigest()}"
        )

    def encode(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Encode (B, H, W, 3) uint8 as (B, D) float32 of length 1."""
        torch = self._torch
        size = (self._size, self._size)
        resized = [
            cv2.resize(f, size, interpolation=_interpolation(f, self._size))
            if f.shape[:2] != size
            else f
            for f in frames
        ]
        with torch.inference_mode():
            batch = torch.from_numpy(np.stack(resized)).to(self._device)
            batch = (batch.permute(0, 3, 1, 2).float() / 255 - self._mean) / self._std
            features = torch.nn.functional.normalize(self._network(batch).float(), dim=1)
            return cast("NDArray[np.float32]", features.cpu().numpy())


def _interpolation(frame: NDArray[np.uint8], size: int) -> int:
    return cv2.INTER_AREA if min(frame.shape[:2]) >= size else cv2.INTER_CUBIC


def _import_timm() -> tuple[Any, Any]:
    try:
        torch = import_module("torch")
        try:
            return import_module("timm"), torch
        except RuntimeError as error:
            # A torchvision built for another torch has no compiled operators. timm only imports it.
            if "torchvision::nms" not in str(error):
                raise
        library = torch.library.Library("torchvision", "DEF")
        for name in ("nms", "qnms"):
            library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        _libraries.append(library)  # the operators vanish with the object
        return import_module("timm"), torch
    except ImportError as error:
        raise ImportError(
            f"timm's encoders need torch and timm ({error}): pip install 'regil-wrappers[timm]'"
        ) from error


_libraries: list[Any] = []
