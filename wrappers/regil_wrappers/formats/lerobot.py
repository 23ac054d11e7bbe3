"""LeRobot's datasets, v2.x and v3.0, read and written without LeRobot.

A dataset is a folder: ``meta/info.json`` says where things are, parquet files hold a row for each
step, and pictures are films (mp4) or PNG files inside the parquet. A row holds what was seen and
the action that followed; the frame after the last action is not kept. v2 has a file for each
episode, v3 puts many into one.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from regil_wrappers.demonstration import Demonstration
from regil_wrappers.formats.changes import Pictures
from regil_wrappers.formats.parquet import batches, json_file, numbers
from regil_wrappers.formats.pictures import decoded, png
from regil_wrappers.formats.video import read_mp4
from regil_wrappers.limits import Budget, need

__all__ = ["CAMERA", "VERSIONS", "read", "write"]

CAMERA = "observation.images.main"
"""Name of the pictures in what is written."""
VERSIONS = ("v2.1", "v3.0")

_MAX_INFO = 16 * 1024**2
_PREFIX = "observation."
_NUMBERS = ("float32", "float64", "bool", "int8", "int16", "int32", "int64", "uint8", "uint16")
_OURS = "meta/regil.json"
_PATHS = {
    "v2.1": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    "v3.0": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
}
_EPISODES = "meta/episodes/chunk-000/file-000.parquet"


def read(
    path: Path,
    pictures: Pictures,
    episode: int = 0,
    camera: str | None = None,
    observations: list[str] | None = None,
) -> dict[str, Any]:
    """Read one episode.

    Args:
        path: the dataset's folder.
        pictures: takes the frames.
        episode: its ``episode_index``.
        camera: name of the pictures, e.g. "observation.images.top"; None where there is one.
        observations: other ``observation.`` names to keep, without that; None keeps all that are
            numbers or vectors.

    Raises:
        ValueError: if something is missing, damaged, leads out of the folder or claims too much.
        ImportError: if it needs PyAV, Pillow or pyarrow, and they are not there.
    """
    info = json_file(path / "meta" / "info.json", _MAX_INFO)
    version, features = _text(info, "codebase_version"), info.get("features")
    if not version.startswith(("v2.", "v3.")):
        raise ValueError(f"codebase_version is {version!r}: v2.x and v3.x are read")
    if not isinstance(features, dict) or not all(isinstance(f, dict) for f in features.values()):
        raise ValueError("meta/info.json has no features")
    cameras = [k for k, f in features.items() if f.get("dtype") in ("video", "image")]
    if camera is None and len(cameras) == 1:
        camera = cameras[0]
    if camera is None or camera not in cameras:
        raise ValueError(f"camera={camera!r}: choose one of {cameras}")
    vectors = [
        name.removeprefix(_PREFIX)
        for name, feature in features.items()
        if name.startswith(_PREFIX)
        and feature.get("dtype") in _NUMBERS
        and len(feature.get("shape", ())) == 1
    ]
    keys = vectors if observations is None else observations
    if not set(keys) <= set(vectors):
        raise ValueError(f"observations={keys}: choose from {vectors}")

    place = (
        _place_v2(path, info, episode) if version.startswith("v2.") else _place_v3(path, episode)
    )
    data = _inside(path, _text(info, "data_path"), place)
    wanted = [_PREFIX + key for key in keys]
    film = features[camera]["dtype"] == "video"
    if not film:
        wanted.append(camera)
    rows = _episode_rows(data, episode, ["episode_index", *wanted], ["action", "next.success"])
    length = sum(len(part) for part in rows["episode_index"])
    rate = info.get("fps")
    if isinstance(rate, bool) or not isinstance(rate, (int, float)) or not 0 < rate <= 1000:
        raise ValueError(f"fps in meta/info.json is {rate!r}")
    if film:
        start = place.get(f"videos/{camera}/from_timestamp", 0.0)
        for name in ("chunk_index", "file_index"):
            place[name] = place.get(f"videos/{camera}/{name}", place.get(name, 0))
        target = _inside(path, _text(info, "video_path"), place | {"video_key": camera})
        read_mp4(target, pictures, start=float(start), frames=length)
    else:
        for part in rows.pop(camera):
            for value in part:
                pictures.add(_stored_picture(path, value.as_py()))
    found = {name: numbers(rows[name], name) for name in rows if name != "episode_index"}
    solved = found.get("next.success")
    metadata, as_array = _ours(path)
    kept: Any = {key: _two_dimensional(found[_PREFIX + key]) for key in keys} or None
    if as_array and len(keys) == 1:
        kept = kept[keys[0]]
    return {
        "actions": _two_dimensional(found["action"]) if "action" in found else None,
        "observations": kept,
        "successes": None
        if solved is None
        else np.concatenate([[False], np.asarray(solved, dtype=bool).reshape(-1)[:-1]]),
        "metadata": {"control_rate": rate} | metadata,
        "details": {"episode": episode, "camera": camera, "version": version},
    }


def _two_dimensional(vectors: NDArray[Any]) -> NDArray[Any]:
    """Vectors of one number are stored as a plain column."""
    return vectors[:, None] if vectors.ndim == 1 else vectors


def _text(info: Any, name: str) -> str:
    value = info.get(name) if isinstance(info, dict) else None
    if not isinstance(value, str) or len(value) > 1000:
        raise ValueError(f"{name} in meta/info.json is {value!r:.100}: it must be a short text")
    return value


def _inside(root: Path, template: str, values: dict[str, Any]) -> Path:
    """The file that a path like "data/chunk-{chunk_index:03d}/..." names, inside the folder.

    `str.format` is not used: a template could ask it for attributes, or for gigabytes of zeros.
    """

    def put(match: re.Match[str]) -> str:
        value = values.get(match[1])
        if value is None:
            raise ValueError(f"the path {template!r} asks for {match[1]!r}, which is not known")
        return str(value).zfill(int(match[2] or 0))

    name = re.sub(r"\{(\w+)(?::0?(\d{1,2})d)?\}", put, template)
    file = (root / name).resolve()
    if "{" in name or not file.is_relative_to(root.resolve()):
        raise ValueError(
            f"the path {name!r} leads out of the dataset's folder: where it is a link, as in the "
            "hub's cache, download with --local-dir"
        )
    if not file.is_file():
        raise ValueError(f"the dataset has no file {name!r}: is it downloaded, with this episode?")
    return file


def _place_v2(path: Path, info: dict[str, Any], episode: int) -> dict[str, Any]:
    total, size = info.get("total_episodes"), info.get("chunks_size", 1000)
    if type(total) is int and not 0 <= episode < total:
        raise ValueError(f"there is no episode {episode}: it has {total}")
    if type(size) is not int or size < 1:
        raise ValueError(f"chunks_size in meta/info.json is {size!r}")
    return {"episode_index": episode, "episode_chunk": episode // size}


def _place_v3(path: Path, episode: int) -> dict[str, Any]:
    """The row of ``meta/episodes`` that says where the episode lies."""
    for file in sorted((path / "meta" / "episodes").glob("*/[!.]*.parquet")):
        for batch in batches(file, ["episode_index"], Budget(), "lerobot", _says_where):
            columns = [name for name in batch.schema.names if _says_where(name)]
            indices = numbers([batch.column("episode_index")], "episode_index")
            for row in np.flatnonzero(indices == episode):
                found = {name: batch.column(name)[int(row)].as_py() for name in columns}
                plain = {k.removeprefix("data/"): v for k, v in found.items()}
                if not all(isinstance(v, (int, float)) for v in plain.values()):
                    raise ValueError(f"meta/episodes does not say where episode {episode} lies")
                return plain
    raise ValueError(f"there is no episode {episode} in meta/episodes")


def _says_where(name: str) -> bool:
    return name.startswith(("data/", "videos/"))


def _episode_rows(
    file: Path, episode: int, columns: list[str], optional: list[str]
) -> dict[str, list[Any]]:
    """The episode's rows, column by column, as arrow arrays in parts."""
    import pyarrow  # type: ignore[import-untyped]

    found: dict[str, list[Any]] = {}
    for batch in batches(file, columns, Budget(), "lerobot", optional.__contains__):
        mask = numbers([batch.column("episode_index")], "episode_index") == episode
        if mask.any():
            part = batch.filter(pyarrow.array(mask))
            for name in part.schema.names:
                found.setdefault(name, []).append(part.column(name))
    if not found:
        raise ValueError(f"{file.name} has no rows of episode {episode}")
    return found


def _stored_picture(root: Path, value: Any) -> NDArray[np.uint8]:
    content = value.get("bytes") if isinstance(value, dict) else value
    if isinstance(content, bytes):
        return decoded(content)
    name = value.get("path") if isinstance(value, dict) else None
    if not isinstance(name, str):
        raise ValueError("a row has no picture")
    with _inside(root, name, {}).open("rb") as stream:
        return decoded(stream)


def _ours(path: Path) -> tuple[dict[str, Any], bool]:
    """What `write` left beside LeRobot's own files."""
    if not (path / _OURS).is_file():
        return {}, False
    stored = json_file(path / _OURS, 1_000_000)
    if not isinstance(stored, dict) or not isinstance(stored.get("metadata"), dict):
        raise ValueError(f"{_OURS} does not hold metadata")
    return stored["metadata"], stored.get("observations_are_an_array") is True


# -- out -------------------------------------------------------------------------------------------


def write(
    demo: Demonstration, path: Path, version: Literal["v2.1", "v3.0"] = "v3.0", task: str = ""
) -> None:
    """Write a dataset of one episode, pictures as PNG files inside the parquet: nothing is blurred.

    The frame after the last action is not kept.

    Args:
        demo: with actions and a ``control_rate``.
        path: a new folder.
        version: "v2.1" or "v3.0".
        task: LeRobot's description of the task; the environment's id if it is empty.

    Raises:
        ValueError: if the rate is not known.
        ImportError: without pyarrow or Pillow.
    """
    pa = need("pyarrow", "lerobot", "writing LeRobot's datasets")
    parquet = need("pyarrow.parquet", "lerobot", "writing LeRobot's datasets")
    if version not in VERSIONS:
        raise ValueError(f"version={version!r}: choose one of {list(VERSIONS)}")
    rate = demo.metadata["control_rate"]
    if rate is None or rate <= 0:
        raise ValueError(
            f"LeRobot needs frames a second, and control_rate is {rate}: give source_fps="
        )
    assert demo.actions is not None
    t = len(demo.actions)
    columns: dict[str, NDArray[Any]] = {"action": demo.actions}
    others = demo.observations
    if others is not None:
        others = others if isinstance(others, dict) else {"state": others}
        columns |= {_PREFIX + key: value[:t] for key, value in others.items()}
    if demo.successes is not None:
        columns["next.success"] = np.append(demo.successes[1:], demo.successes[-1])[:t]
    columns |= {
        "timestamp": (np.arange(t) / rate).astype(np.float32),
        "frame_index": np.arange(t),
        "episode_index": np.zeros(t, dtype=np.int64),
        "index": np.arange(t),
        "task_index": np.zeros(t, dtype=np.int64),
    }
    for name, values in columns.items():
        if values.ndim > 2:
            raise ValueError(f"{name} is {values.shape}: LeRobot's columns are numbers or vectors")
    features: dict[str, Any] = {
        CAMERA: {
            "dtype": "image",
            "shape": list(demo.frames.shape[1:]),
            "names": ["height", "width", "channels"],
        }
    }
    features |= {
        name: {"dtype": str(v.dtype), "shape": list(v.shape[1:]) or [1], "names": None}
        for name, v in columns.items()
    }
    stored = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    files = [{"bytes": content, "path": None} for content in png(demo.frames[:t])]
    arrays = {CAMERA: pa.array(files, stored)}
    arrays |= {name: _arrow(pa, values) for name, values in columns.items()}
    task = task or demo.metadata["env_id"] or "unknown"
    stats = {CAMERA: _stats(demo.frames[:t] / np.float32(255), pictures=True)}
    stats |= {name: _stats(values) for name, values in columns.items()}
    place = {"episode_chunk": 0, "episode_index": 0, "chunk_index": 0, "file_index": 0}
    info = {
        "codebase_version": version,
        "robot_type": None,
        "total_episodes": 1,
        "total_frames": t,
        "total_tasks": 1,
        "chunks_size": 1000,
        "fps": int(rate) if rate == int(rate) else rate,
        "splits": {"train": "0:1"},
        "data_path": _PATHS[version],
        "video_path": None,
        "features": features,
    }
    meta = path / "meta"
    meta.mkdir(parents=True)
    data = path / _PATHS[version].format(**place)
    data.parent.mkdir(parents=True)
    parquet.write_table(pa.table(arrays), data, compression="snappy")
    if version == "v2.1":
        info |= {"total_videos": 0, "total_chunks": 1}
        lines = {
            "episodes": {"episode_index": 0, "tasks": [task], "length": t},
            "tasks": {"task_index": 0, "task": task},
            "episodes_stats": {"episode_index": 0, "stats": stats},
        }
        for name, line in lines.items():
            (meta / f"{name}.jsonl").write_text(json.dumps(line) + "\n", encoding="utf-8")
    else:
        info |= {"data_files_size_in_mb": 100, "video_files_size_in_mb": 200}
        (meta / "stats.json").write_text(json.dumps(stats), encoding="utf-8")
        # pandas takes the index, the task, from this note.
        index = {"index_columns": ["task"], "columns": [], "column_indexes": []}
        tasks = pa.table({"task_index": [0], "task": [task]})
        tasks = tasks.replace_schema_metadata({"pandas": json.dumps(index)})
        parquet.write_table(tasks, meta / "tasks.parquet")
        episode: dict[str, Any] = {
            "episode_index": [0],
            "tasks": [[task]],
            "length": [t],
            "data/chunk_index": [0],
            "data/file_index": [0],
            "dataset_from_index": [0],
            "dataset_to_index": [t],
            "meta/episodes/chunk_index": [0],
            "meta/episodes/file_index": [0],
        }
        episode |= {f"stats/{n}/{k}": [v] for n, one in stats.items() for k, v in one.items()}
        (path / _EPISODES).parent.mkdir(parents=True)
        parquet.write_table(pa.table(episode), path / _EPISODES)
    (meta / "info.json").write_text(json.dumps(info, indent=4), encoding="utf-8")
    ours = {
        "metadata": demo.metadata,
        "observations_are_an_array": isinstance(demo.observations, np.ndarray),
    }
    (path / _OURS).write_text(json.dumps(ours), encoding="utf-8")


def _arrow(pa: Any, values: NDArray[Any]) -> Any:
    """(T,) as it is; (T, K) as lists of K, one number alone as a plain column."""
    if values.ndim == 2 and values.shape[1] > 1:
        kind = pa.list_(pa.from_numpy_dtype(values.dtype), values.shape[1])
        return pa.FixedSizeListArray.from_arrays(values.reshape(-1), type=kind)
    return pa.array(values.reshape(-1))


def _stats(values: NDArray[Any], pictures: bool = False) -> dict[str, Any]:
    """LeRobot's statistics over steps; of pictures over pixels too, (3, 1, 1), in [0, 1]."""
    found = {}
    wide = values.astype(np.float64) if not pictures else values
    for name in ("min", "max", "mean", "std"):
        if pictures:
            found[name] = getattr(wide, name)(axis=(0, 1, 2)).reshape(3, 1, 1).tolist()
        else:
            found[name] = np.atleast_1d(getattr(wide, name)(axis=0)).tolist()
    return found | {"count": [len(values)]}
