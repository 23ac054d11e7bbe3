"""``NetworkEncoder`` - any torch network as an encoder. torch is imported when one is made."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from importlib import import_module
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from regil_wrappers.encoders.options import one_of, whole_number
from regil_wrappers.encoders.preprocessing import Preprocessing

__all__ = ["NetworkEncoder", "check_execution", "import_torch", "weights_digest"]

PRECISIONS = ("float32", "float16", "bfloat16")


class NetworkEncoder:
    """A network's features, flattened and L2-normalised: float32 of length 1.

    Squared distances between them are 2 - 2 cos.

    Args:
        key: what `features` depends on: the network's name, its weights' digest, versions.
        network: a ``torch.nn.Module``; it is moved to the device and set to evaluation.
        features: (B, 3, h, w) float -> (B, ...), calls the network.
        preprocessing: what is done to a frame before.
        device: torch device; None is "cuda" where there is one, else "cpu".
        precision: "float32", or "float16" or "bfloat16" for ``torch.autocast``: about half the time
            on a GPU, hardly worth it on a processor.
        compile: whether ``torch.compile`` compiles `features`, at the first call and for each new
            batch size once: seconds to minutes.
        batch: at most so many frames are encoded at once; more are taken in turns. None: 2 on a
            processor, whose caches more of them leave (docs/retrieval.md), else 32.

    Raises:
        ValueError: if an option is out of range, or there is no such device.
    """

    slow = True

    def __init__(
        self,
        key: str,
        network: Any,
        features: Callable[[Any], Any],
        preprocessing: Preprocessing,
        *,
        device: str | None = None,
        precision: str = "float32",
        compile: bool = False,
        batch: int | None = None,
    ) -> None:
        self._torch = torch = import_torch()
        self._device = check_execution(device, precision, compile, batch)
        self._network = network.eval().to(self._device)
        self._features = torch.compile(features) if compile else features
        self._precision = precision
        self._batch = batch or (2 if self._device.type == "cpu" else 32)
        self._preprocessing = preprocessing
        self._mean, self._std = (
            torch.tensor(values, device=self._device).view(1, 3, 1, 1)
            for values in (preprocessing.mean, preprocessing.std)
        )
        where = str(self._device)
        if self._device.type == "cuda":
            where += f" {torch.cuda.get_device_name(self._device)}"
        self.frame_size: int | None = preprocessing.frame_size
        self.cache_key: str | None = (
            f"{key} {preprocessing} precision={precision} compile={compile} "
            f"torch={torch.__version__} device={where}"
        )

    def encode(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Encode (B, H, W, 3) uint8 as (B, D) float32 of length 1."""
        steps = range(0, len(frames), self._batch)
        return np.concatenate([self._encode(frames[i : i + self._batch]) for i in steps])

    def _encode(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        torch = self._torch
        dtype = getattr(torch, self._precision)
        half = torch.autocast(self._device.type, dtype, enabled=self._precision != "float32")
        with torch.inference_mode(), half:
            batch = torch.from_numpy(self._preprocessing.pictures(frames)).to(self._device)
            batch = (batch.permute(0, 3, 1, 2).float() / 255 - self._mean) / self._std
            features = self._features(batch).float().flatten(1)
            features = torch.nn.functional.normalize(features, dim=1)
            return cast("NDArray[np.float32]", features.cpu().numpy())


def check_execution(
    device: str | None = None,
    precision: str = "float32",
    compile: bool = False,
    batch: int | None = None,
) -> Any:
    """Refuse options out of range, before a network is loaded; return the torch device.

    Raises:
        ValueError: naming the option and its value.
    """
    one_of("precision", precision, PRECISIONS)
    one_of("compile", compile, (True, False))
    if batch is not None:
        whole_number("batch", batch)
    torch = import_torch()
    name = device or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        found = torch.device(name)
        torch.empty(1, device=found)
    except (AssertionError, NotImplementedError, RuntimeError, TypeError) as error:
        reason = str(error).splitlines()[0][:100]
        raise ValueError(
            f"device={name!r}: torch {torch.__version__} has no such device here ({reason}): "
            f"choose cpu, or leave it out"
        ) from error
    return found


def import_torch() -> Any:
    """The torch package.

    Raises:
        ImportError: of one line, if it is not installed.
    """
    try:
        return import_module("torch")
    except ImportError as error:
        raise ImportError(
            f"this encoder needs torch ({error}): pip install 'regil-wrappers[timm]'"
        ) from error


def weights_digest(network: Any) -> str:
    """SHA-256 of a torch network's parameters and buffers, with their names and types."""
    torch = import_torch()
    digest = hashlib.sha256()
    for name, value in sorted(network.state_dict().items()):
        digest.update(f"{name} {tuple(value.shape)} {value.dtype}".encode())
        digest.update(value.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy())
    return digest.hexdigest()
