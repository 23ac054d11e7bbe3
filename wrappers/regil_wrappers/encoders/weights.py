"""Where a network's weights lie: a file that was named, the user's folder, the hub's cache.

* ``weights_folder`` - the user's folder: ``REGIL_ENCODERS``
* ``find_weights``, ``local_weights``, ``timm_weights`` - the path of a
  file, or one line that says what to put where: ``MissingWeightsError``
* ``read_weights`` - the tensors of a checkpoint; never other objects
"""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path
from typing import Any

from regil_wrappers.encoders.cache import cache_folder
from regil_wrappers.encoders.network import import_torch

__all__ = [
    "MissingWeightsError",
    "find_weights",
    "local_weights",
    "read_weights",
    "timm_weights",
    "weights_folder",
]

# What a repository of timm's holds, unless timm says otherwise; older ones have the second alone.
_HUB_NAMES = ("model.safetensors", "pytorch_model.bin")


class MissingWeightsError(ValueError):
    """A network's weights are neither here nor to be downloaded."""


def weights_folder() -> Path:
    """The folder that ``REGIL_ENCODERS`` names, else ``encoders`` in the user's cache folder."""
    return Path(os.environ.get("REGIL_ENCODERS") or cache_folder() / "encoders")


def find_weights(name: str, file: str | None) -> Path | None:
    """A file that was named, or one called `name` in the user's folder; None if there is none.

    Raises:
        ValueError: if the named file does not exist.
    """
    if file is not None:
        if not Path(file).is_file():
            raise ValueError(f"there is no checkpoint file {file!r}")
        return Path(file)
    path = weights_folder() / name
    return path if path.is_file() else None


def local_weights(timm: Any, model: str, file: str | None = None) -> Path | None:
    """The same where they are here already; None where they would have to be downloaded.

    Raises:
        ValueError: if the named file does not exist.
    """
    config = timm.get_pretrained_cfg(model)
    full = _full_name(config)
    found = find_weights(f"{full}.safetensors", file) or find_weights(f"{full}.bin", None)
    if found is not None or not config.hf_hub_id:
        return found
    hub = import_module("huggingface_hub")
    for name in _hub_names(config):
        cached = hub.try_to_load_from_cache(config.hf_hub_id, name)
        if isinstance(cached, str):
            return Path(cached)
    return None


def _full_name(config: Any) -> str:
    return str(config.architecture) + (f".{config.tag}" if config.tag else "")


def _hub_names(config: Any) -> list[str]:
    return [config.hf_hub_filename] if config.hf_hub_filename else list(_HUB_NAMES)


def timm_weights(timm: Any, model: str, file: str | None) -> Path:
    """The file with the weights of a model of timm's: downloaded, if nothing else helps.

    The hub is asked once, and given five seconds: its own client tries for most of a minute.

    Raises:
        MissingWeightsError: of one line, if they are neither here nor to be downloaded.
        ValueError: if timm has none.
    """
    found = local_weights(timm, model, file)
    if found is not None:
        return found
    config = timm.get_pretrained_cfg(model)
    full = _full_name(config)
    repository = config.hf_hub_id
    if not repository:
        raise ValueError(f"timm has no weights for {model!r}: add '@' and a checkpoint's path")
    names = _hub_names(config)
    hub = import_module("huggingface_hub")
    for name in names:
        try:
            hub.get_hf_file_metadata(hub.hf_hub_url(repository, name), timeout=5)
            return Path(hub.hf_hub_download(repository, name))
        except Exception as error:  # the hub and its client raise a dozen unrelated types here
            failed = error
            if not isinstance(error, import_module("huggingface_hub.errors").EntryNotFoundError):
                break
    source = hub.hf_hub_url(repository, names[0])
    if len(names) > 1:
        source += f" (where there is none, {names[1]} beside it, for {full}.bin)"
    raise MissingWeightsError(
        missing_weights(source, f"{full}.safetensors", f"no download: {type(failed).__name__}")
    ) from failed


def missing_weights(source: str, name: str, reason: str) -> str:
    """The line that says which file to put where."""
    return (
        f"its weights are not here ({reason}): get {source} and save it as "
        f"{weights_folder() / name} (the environment variable REGIL_ENCODERS names the folder), "
        f"or add '@' and the file's path to the encoder's name"
    )


def read_weights(file: Path) -> Any:
    """What a checkpoint holds: tensors in dicts; a pickle of anything else is refused.

    Raises:
        ValueError: of one line, if it cannot be read so.
    """
    try:
        return import_torch().load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # torch, zipfile and pickle raise many unrelated types here
        raise ValueError(unreadable(file, error)) from error


def unreadable(file: Path, error: Exception) -> str:
    """The line that says why a network did not come out of a file."""
    reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
    return f"its network could not be read from '{file}' ({reason})"
