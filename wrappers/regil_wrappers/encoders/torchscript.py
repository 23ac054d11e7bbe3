"""``torchscript`` - ``"torchscript:FILE"``: a network saved by ``torch.jit.save``."""

from __future__ import annotations

import hashlib
import warnings
from pathlib import Path
from typing import Any, Literal

from regil_wrappers.encoders.network import NetworkEncoder, check_execution, import_torch
from regil_wrappers.encoders.preprocessing import Preprocessing
from regil_wrappers.encoders.weights import unreadable

__all__ = ["torchscript"]


def torchscript(
    file: str,
    *,
    size: int | None = None,
    crop: float | None = None,
    mean: Any = (0.0, 0.0, 0.0),
    std: Any = (1.0, 1.0, 1.0),
    order: Literal["rgb", "bgr"] = "rgb",
    **execution: Any,
) -> NetworkEncoder:
    """A network from a TorchScript file: (B, 3, h, w) float32 to (B, ...), L2-normalised here.

    A TorchScript file is a program: load only what you would run.

    Args:
        file: what ``torch.jit.save`` wrote.
        size: side of the input in pixels; None leaves frames as they are.
        crop: None for the whole picture, else the share of it that is kept (`Preprocessing`).
        mean: subtracted from values in [0, 1]: one number, or three.
        std: divided by then: one number, or three.
        order: of the channels, "rgb" or "bgr".
        execution: device, precision, compile, batch (`NetworkEncoder`).

    Raises:
        ImportError: if torch is not installed.
        ValueError: if the file is missing or no TorchScript, or an option does not fit.
    """
    preprocessing = Preprocessing(size, crop, mean, std, order)
    device = check_execution(**execution)
    path = Path(file)
    if not path.is_file():
        raise ValueError(f"there is no file {file!r}: give one that torch.jit.save wrote")
    try:
        with warnings.catch_warnings():
            # torch would like other formats better, and says so at every load.
            warnings.simplefilter("ignore", DeprecationWarning)
            network = import_torch().jit.load(file, map_location=device)
    except (RuntimeError, ValueError) as error:
        raise ValueError(unreadable(path, error)) from error
    key = f"torchscript {hashlib.sha256(path.read_bytes()).hexdigest()}"
    return NetworkEncoder(key, network, network, preprocessing, **execution)
