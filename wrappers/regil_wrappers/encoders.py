"""Encoders: pictures in, embeddings out. The only module that may import torch, and lazily.

* ``Encoder`` - the protocol
* ``register_encoder``, ``make_encoder``, ``encoder_names`` - encoders by name
* ``PixelsEncoder`` - ``"pixels"``, the default: a small picture, no download
* ``TimmEncoder`` - ``"timm:<model>"``, ``"dinov2"``, ``"dinov3"``: pretrained networks
* ``embed`` - the embeddings of a demonstration's frames, cached
"""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, cast

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Encoder",
    "PixelsEncoder",
    "TimmEncoder",
    "embed",
    "encoder_names",
    "make_encoder",
    "register_encoder",
]


class Encoder(Protocol):
    """Turns pictures into embeddings.

    An encoder may also have these attributes:

    * ``frame_size`` (int or None): the side of the square picture it would like to be given.
      Environments that can render one are asked for it; otherwise it gets the observation's
      picture.
    * ``cache_key`` (str or None): everything that its output depends on (name, settings, digest of
      the weights). Without it embeddings are not cached.
    * ``slow`` (bool): whether embeddings of a demonstration are worth a file in the user's cache
      folder.
    """

    def encode(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Encode pictures.

        Args:
            frames: (B, H, W, 3) uint8, RGB.

        Returns:
            (B, D) float32.
        """
        ...


class PixelsEncoder:
    """The picture itself, made small: no network, no download, 0.01 ms.

    Each frame is resized to 28 x 28 by area, divided by 255 and flattened (D = 2352); not
    normalised.
    """

    frame_size: int | None = None
    cache_key: str | None = "pixels-28"
    slow = False

    def encode(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Encode (B, H, W, 3) uint8 as (B, 2352) float32 in [0, 1]."""
        small = [cv2.resize(frame, (28, 28), interpolation=cv2.INTER_AREA) for frame in frames]
        embeddings: NDArray[np.float32] = (
            np.stack(small).reshape(len(frames), -1).astype(np.float32)
        )
        embeddings /= 255
        return embeddings


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


_CACHED_DEMONSTRATIONS = 8
_cache: OrderedDict[str, NDArray[np.float32]] = OrderedDict()


def embed(encoder: Encoder, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Embeddings of a demonstration's frames, from the cache where possible.

    Frames are encoded one at a time, as they will be in an episode: a network's output depends in
    its last bits on the size of the batch, and a frame must have distance 0 to itself.

    Args:
        encoder: cached by its ``cache_key`` together with the frames: in this process, and if it is
            ``slow`` also in the folder ``regil`` of the user's cache (``XDG_CACHE_HOME``,
            ``~/.cache``).
        frames: (N, H, W, 3) uint8.

    Returns:
        (N, D) float32, not to be written to.

    Raises:
        ValueError: if the encoder's output has another shape or type, or is not finite.
    """
    key = getattr(encoder, "cache_key", None)
    if key is None:
        return _embed(encoder, frames)
    digest = hashlib.sha256(f"{key} {frames.shape}".encode())
    digest.update(np.ascontiguousarray(frames).data)
    name = digest.hexdigest()
    if name not in _cache:
        file = _cache_folder() / f"{name}.npz" if getattr(encoder, "slow", False) else None
        embeddings = None if file is None else _read_cached(file, len(frames))
        if embeddings is None:
            embeddings = _embed(encoder, frames)
            if file is not None:
                _write_cached(file, embeddings)
        _cache[name] = embeddings
        if len(_cache) > _CACHED_DEMONSTRATIONS:
            _cache.popitem(last=False)
    _cache.move_to_end(name)
    return _cache[name]


def _embed(encoder: Encoder, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
    rows = []
    for i in range(len(frames)):
        row = encoder.encode(frames[i : i + 1])
        check_embedding(row, f"frame {i} of the demonstration")
        rows.append(row)
    embeddings = np.concatenate(rows)
    embeddings.flags.writeable = False
    return embeddings


def check_embedding(row: Any, which: str) -> None:
    """Refuse anything but (1, D) finite float32.

    Args:
        row: what an encoder returned for one frame.
        which: the frame, as the error names it.

    Raises:
        ValueError: naming the frame.
    """
    if not isinstance(row, np.ndarray) or row.dtype != np.float32 or row.ndim != 2 or len(row) != 1:
        got = f"{row.dtype} {row.shape}" if isinstance(row, np.ndarray) else type(row).__name__
        raise ValueError(f"the encoder gave {got} for {which}: it must be a float32 array (1, D)")
    if not np.isfinite(row).all():
        raise ValueError(f"the encoder gave NaN or infinity for {which}")


def _cache_folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "regil"


def _read_cached(file: Path, frames: int) -> NDArray[np.float32] | None:
    try:
        # Opened here: np.load leaves a file open that it cannot read.
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            embeddings = archive["embeddings"]
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None  # not there, or not readable: it is only a cache, and is written again
    if embeddings.dtype != np.float32 or embeddings.ndim != 2 or len(embeddings) != frames:
        return None
    if not np.isfinite(embeddings).all():
        return None
    embeddings.flags.writeable = False
    return cast("NDArray[np.float32]", embeddings)


def _write_cached(file: Path, embeddings: NDArray[np.float32]) -> None:
    temporary = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as stream:
            np.savez(stream, embeddings=embeddings)
        temporary.replace(file)
    except OSError:  # a full or read-only cache costs time, nothing else
        with suppress(OSError):
            temporary.unlink()
