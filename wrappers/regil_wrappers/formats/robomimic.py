"""robomimic's HDF5, and LIBERO's, which has the same layout under other names.

``data/demo_N/actions``, ``data/demo_N/obs/KEY`` and, in robomimic, ``data/demo_N/next_obs/KEY``,
whose last row is the outcome of the last action. LIBERO stores pictures upside down and no
``next_obs``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py  # type: ignore[import-untyped]
import numpy as np
from numpy.typing import NDArray

from regil_wrappers import hdf5
from regil_wrappers.demonstration import Demonstration
from regil_wrappers.formats.changes import Pictures
from regil_wrappers.limits import Budget

__all__ = [
    "LIBERO_CAMERA",
    "ROBOMIMIC_CAMERA",
    "read_libero",
    "read_robomimic",
    "write_libero",
    "write_robomimic",
]

ROBOMIMIC_CAMERA = "agentview_image"
LIBERO_CAMERA = "agentview_rgb"


def read_robomimic(
    path: Path,
    pictures: Pictures,
    episode: int = 0,
    camera: str = ROBOMIMIC_CAMERA,
    observations: list[str] | None = None,
) -> dict[str, Any]:
    """Read ``data/demo_<episode>``.

    Args:
        path: the file.
        pictures: takes the frames.
        episode: which demonstration.
        camera: key of the pictures in ``obs``.
        observations: keys of ``obs`` to keep; None keeps all that are numbers or vectors.

    Raises:
        ValueError: if something is missing, damaged or claims too much.
    """
    return _read(path, pictures, episode, camera, observations, upside_down=False)


def read_libero(
    path: Path,
    pictures: Pictures,
    episode: int = 0,
    camera: str = LIBERO_CAMERA,
    observations: list[str] | None = None,
) -> dict[str, Any]:
    """The same for LIBERO's files; the rows of its pictures are turned round."""
    return _read(path, pictures, episode, camera, observations, upside_down=True)


def _read(
    path: Path,
    pictures: Pictures,
    episode: int,
    camera: str,
    keys: list[str] | None,
    upside_down: bool,
) -> dict[str, Any]:
    budget = Budget(path.stat().st_size)
    with hdf5.opened(path) as file:
        data = hdf5.member(file, "data", h5py.Group)
        if not hdf5.has(data, f"demo_{episode}"):
            names = [name for name in data if name.startswith("demo_")]
            raise ValueError(f"there is no demo_{episode}: it has {len(names)}, {names[:3]} ...")
        demo = hdf5.member(data, f"demo_{episode}", h5py.Group)
        obs = hdf5.member(demo, "obs", h5py.Group)
        following = (
            hdf5.member(demo, "next_obs", h5py.Group) if hdf5.has(demo, "next_obs") else None
        )
        if not hdf5.has(obs, camera):
            raise ValueError(f"there is no camera {camera!r}: choose camera= from {_cameras(obs)}")
        with_last = following is not None and hdf5.has(following, camera)

        def joined(key: str) -> NDArray[Any]:
            values = hdf5.array(obs, key, budget)
            if not with_last:
                return values
            last = hdf5.array(following, key, budget, row=-1)
            if last.shape != values.shape[1:]:
                raise ValueError(f"next_obs/{key} does not fit obs/{key}")
            return np.concatenate([values, last[None]])

        frames = joined(camera)
        if frames.ndim != 4:
            raise ValueError(f"obs/{camera} is {frames.dtype} {frames.shape}: no pictures")
        pictures.add_all(frames[:, ::-1] if upside_down else frames)
        if keys is None:
            keys = [
                key
                for key in obs
                if isinstance(obs.get(key, getlink=True), h5py.HardLink)
                and isinstance(obs[key], h5py.Dataset)
                and obs[key].ndim in (1, 2)
                and obs[key].dtype.kind in "biuf"
                and (not with_last or hdf5.has(following, key))
            ]
        kept = {key: joined(key) for key in keys}
        return {
            "actions": hdf5.array(demo, "actions", budget) if hdf5.has(demo, "actions") else None,
            "observations": kept or None,
            "metadata": _metadata(data),
            "details": {"episode": episode, "camera": camera}
            | ({"rows": "turned round"} if upside_down else {}),
        }


def _cameras(obs: h5py.Group) -> list[str]:
    found = []
    for key in obs:
        if isinstance(obs.get(key, getlink=True), h5py.HardLink):
            item = obs[key]
            if isinstance(item, h5py.Dataset) and item.ndim == 4 and item.dtype == np.uint8:
                found.append(key)
    return found


def _metadata(data: h5py.Group) -> dict[str, Any]:
    """Our own, if the file was written here; else the control rate, if it says one."""
    if "regil_metadata" in data.attrs:
        metadata = hdf5.json_attribute(data, "regil_metadata")
        if not isinstance(metadata, dict):
            raise ValueError("attribute 'regil_metadata' must hold a dict")
        return metadata
    try:
        rate = hdf5.json_attribute(data, "env_args")["env_kwargs"]["control_freq"]
    except (ValueError, TypeError, KeyError):
        return {}  # other environments say no rate, and none is needed
    usable = isinstance(rate, (int, float)) and not isinstance(rate, bool) and 0 < rate <= 1000
    return {"control_rate": rate} if usable else {}


def write_robomimic(demo: Demonstration, path: Path) -> None:
    """Write our own file with ``next_obs``, ``rewards`` and ``dones``, which robomimic wants.

    Rewards are 1 where `Demonstration.successes` says so of the frame that follows, dones there and
    in the last step.

    Raises:
        ValueError: without actions.
    """
    assert demo.actions is not None
    t = len(demo.actions)
    with hdf5.created(path) as file:
        demo._write(file)
        group = file["data/demo_0"]
        if len(demo) > t:
            for key in group["obs"]:
                stored = group[f"obs/{key}"]
                following = np.concatenate([stored[1:], group[f"final_obs/{key}"][()][None]])
                group.create_dataset(
                    f"next_obs/{key}", data=following, compression="gzip", chunks=stored.chunks
                )
        _write_outcome(demo, group)


def write_libero(demo: Demonstration, path: Path) -> None:
    """Write LIBERO's names, rows turned round. The frame after the last action is not kept.

    Raises:
        ValueError: without actions.
    """
    assert demo.actions is not None
    t = len(demo.actions)
    arrays = {LIBERO_CAMERA: demo.frames[:t, ::-1]}
    if isinstance(demo.observations, dict):
        arrays |= {key: value[:t] for key, value in demo.observations.items()}
    elif demo.observations is not None:
        arrays["observation"] = demo.observations[:t]
    with hdf5.created(path) as file:
        data = file.create_group("data")
        rate = demo.metadata["control_rate"]
        env_args = {
            "env_name": demo.metadata["env_id"],
            "type": 1,
            "env_kwargs": {} if rate is None else {"control_freq": rate},
        }
        data.attrs["env_args"] = json.dumps(env_args)
        data.attrs["regil_metadata"] = json.dumps(demo.metadata)
        data.attrs["macros_image_convention"] = "opengl"
        data.attrs["num_demos"] = 1
        data.attrs["total"] = t
        group = data.create_group("demo_0")
        group.attrs["num_samples"] = t
        for key, values in arrays.items():
            group.create_dataset(f"obs/{key}", data=values, compression="gzip")
        _write_outcome(demo, group)
        group.create_dataset("actions", data=demo.actions.astype(np.float64), compression="gzip")


def _write_outcome(demo: Demonstration, group: h5py.Group) -> None:
    """Rewards are 1 where the next frame is solved; done there, and at the end."""
    assert demo.actions is not None
    rewards = np.zeros(len(demo.actions))
    if demo.successes is not None:
        after = demo.successes[1:]
        rewards[: len(after)] = after
    group.create_dataset("rewards", data=rewards)
    dones = rewards.astype(np.uint8)
    dones[-1] = 1
    group.create_dataset("dones", data=dones)
