"""Damaged files of every format, read in a process that may not grow.

    python -m regil_wrappers.formats.fuzz COUNT [FIRST]

reads COUNT of them and says what became of them. Exit status 0: each was read or refused in one
line. A crash of the interpreter, a file that takes over 20 seconds, or one that asks for more than
512 MiB ends it.

* ``run`` - the cases of any such worker, in a process of their own
* ``limited`` - what that process does
* ``damaged``, ``damaged_json`` - a file's content, damaged
"""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py  # type: ignore[import-untyped]
import numpy as np

from regil_wrappers import Demonstration, formats

ROOM = 512 * 1024**2
SECONDS = 20


def example(n: int = 6, side: int = 16) -> Demonstration:
    """A demonstration of everything that formats hold."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 256, (n, 4, 4, 3), dtype=np.uint8)
    return Demonstration(
        coarse.repeat(side // 4, axis=1).repeat(side // 4, axis=2),
        rng.uniform(-1, 1, (n - 1, 3)).astype(np.float32),
        {"state": rng.normal(size=(n, 4)).astype(np.float32)},
        successes=np.arange(n) == n - 1,
        metadata={"control_rate": 10, "action_low": [-1] * 3, "action_high": [1] * 3},
    )


def jpeg(frame: np.ndarray[Any, np.dtype[np.uint8]]) -> bytes:
    """A frame as a file."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(frame).save(stream, format="JPEG")
    return stream.getvalue()


def minari_arrow(folder: Path, demo: Demonstration, storage: str) -> None:
    """As Minari stores an episode in arrow or parquet, `jpeg_encoding=False`."""
    import pyarrow as pa  # type: ignore[import-untyped]
    from pyarrow import ipc, parquet

    assert demo.actions is not None

    n = len(demo)
    flat = pa.FixedSizeListArray.from_arrays(demo.frames.reshape(-1), demo.frames[0].size)
    actions = np.vstack([demo.actions, np.zeros((1, 3), np.float32)])
    table = pa.table(
        {
            "observations": flat,
            "actions": pa.FixedSizeListArray.from_arrays(actions.reshape(-1), 3),
            "rewards": np.zeros(n),
        }
    )
    (folder / "data" / "0").mkdir(parents=True)
    file = folder / "data" / "0" / f"part-0.{storage}"
    if storage == "parquet":
        parquet.write_table(table, file)
    else:
        with ipc.new_file(file, table.schema) as writer:
            writer.write_table(table)
    space = {"type": "Box", "dtype": "uint8", "shape": list(demo.frames.shape[1:])}
    about = {"data_format": storage, "observation_space": json.dumps(space)}
    (folder / "data" / "metadata.json").write_text(json.dumps(about))


def lerobot_film(folder: Path, demo: Demonstration, version: str) -> None:
    """As LeRobot stores an episode whose pictures are a film."""
    import pyarrow.parquet as pq  # type: ignore[import-untyped]

    formats.write(demo, folder, "lerobot", version=version)
    info = json.loads((folder / "meta/info.json").read_text())
    camera = formats.lerobot.CAMERA
    info["features"][camera]["dtype"] = "video"
    part = "chunk-000/file-000" if version == "v3.0" else "chunk-000/episode_000000"
    if version == "v3.0":
        info["video_path"] = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        film = folder / f"videos/{camera}/{part}.mp4"
        episodes = folder / "meta/episodes/chunk-000/file-000.parquet"
        table = pq.read_table(episodes)
        for name, value in (("chunk_index", 0), ("file_index", 0), ("from_timestamp", 0.0)):
            table = table.append_column(f"videos/{camera}/{name}", [[value]])
        pq.write_table(table, episodes)
    else:
        info["video_path"] = (
            "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
        )
        film = folder / f"videos/chunk-000/{camera}/episode_000000.mp4"
    (folder / "meta/info.json").write_text(json.dumps(info))
    data = folder / f"data/{part}.parquet"
    pq.write_table(pq.read_table(data).drop_columns([camera]), data)
    film.parent.mkdir(parents=True)
    formats.write(demo, film)


def samples(folder: Path) -> dict[str, tuple[Path, str]]:
    """One whole file or folder of each kind, and its format."""
    demo = example()
    made: dict[str, tuple[Path, str]] = {}
    for name, known in formats.FORMATS.items():
        suffix = known.suffixes[0] if known.suffixes else ""
        path = folder / f"{name}{suffix}"
        formats.write(demo, path, name)
        made[name] = path, name
    for storage in ("arrow", "parquet"):
        minari_arrow(folder / f"minari-{storage}", demo, storage)
        made[f"minari-{storage}"] = folder / f"minari-{storage}", "minari"
    formats.write(demo, folder / "minari-jpeg", "minari")
    with h5py.File(folder / "minari-jpeg/data/main_data.hdf5", "r+") as file:
        del file["episode_0/observations"]
        files = [np.frombuffer(jpeg(frame), np.uint8) for frame in demo.frames]
        stored = file.create_dataset(
            "episode_0/observations", len(files), h5py.vlen_dtype(np.uint8)
        )
        for i, content in enumerate(files):
            stored[i] = content
    made["minari-jpeg"] = folder / "minari-jpeg", "minari"
    formats.write(demo, folder / "lerobot-v2.1", "lerobot", version="v2.1")
    made["lerobot-v2.1"] = folder / "lerobot-v2.1", "lerobot"
    for version in formats.lerobot.VERSIONS:
        lerobot_film(folder / f"lerobot-film-{version}", demo, version)
        made[f"lerobot-film-{version}"] = folder / f"lerobot-film-{version}", "lerobot"
    (folder / "jpegs").mkdir()
    for i, frame in enumerate(demo.frames):
        (folder / f"jpegs/{i}.jpg").write_bytes(jpeg(frame))
    made["jpegs"] = folder / "jpegs", "pictures"
    return made


_NUMBERS = (
    0,
    1,
    2**7,
    2**15,
    2**16 - 1,
    2**24,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**40,
    2**63 - 1,
    2**64 - 1,
)
_VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 10**12, 1e308, "", "../../etc/passwd", "{a.__class__}",
    "{episode_index:99d}", [], [[]], {}, [1] * 9, "x" * 2000, "[" * 3000,
)  # fmt: skip


def damaged(data: bytes, rng: np.random.Generator, other: bytes) -> bytes:
    """Cut short, bits turned, numbers replaced, or a piece of another file put in."""
    content = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        size = max(len(content), 1)
        at = int(rng.integers(size))
        # Claims stand in headers, mostly near the beginning or the end.
        if rng.random() < 0.5:
            at = min(at, int(rng.integers(1, 2000)))
        elif rng.random() < 0.3:
            at = max(0, size - int(rng.integers(1, 2000)))
        match int(rng.integers(6)):
            case 0:
                content = content[:at]
            case 1:
                for place in rng.integers(0, size, int(rng.integers(1, 30))):
                    if place < len(content):
                        content[place] ^= int(rng.integers(1, 256))
            case 2:
                width = int(rng.choice([1, 2, 4, 8]))
                number = _NUMBERS[int(rng.integers(len(_NUMBERS)))] % 2 ** (8 * width)
                order = "little" if rng.random() < 0.6 else "big"
                content[at : at + width] = number.to_bytes(width, order)
            case 3:
                del content[at : at + int(rng.integers(1, 64))]
            case 4:
                start = int(rng.integers(max(len(other), 1)))
                piece = other[start : start + int(rng.integers(1, 512))]
                content[at : at + len(piece)] = piece
            case 5:
                if at < len(content):
                    content[at] ^= 1 << int(rng.integers(8))
    return bytes(content)


def damaged_json(text: str, rng: np.random.Generator) -> str:
    """Some value in it replaced by one of another kind."""
    whole = json.loads(text)
    places: list[tuple[Any, Any]] = []

    def walk(value: Any) -> None:
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inner in items:
            places.append((value, key))
            if isinstance(inner, (dict, list)) and len(places) < 2000:
                walk(inner)

    walk(whole)
    holder, key = places[int(rng.integers(len(places)))]
    holder[key] = _VALUES[int(rng.integers(len(_VALUES)))]
    return json.dumps(whole)


def spoil(path: Path, rng: np.random.Generator, other: bytes) -> None:
    """Damage the file, or one of the folder's."""
    if path.is_dir():
        files = sorted(f for f in path.rglob("*") if f.is_file())
        path = files[int(rng.integers(len(files)))]
        if rng.random() < 0.05:
            path.unlink()
            return
    if path.suffix == ".json" and rng.random() < 0.7:
        path.write_text(damaged_json(path.read_text(), rng))
    else:
        path.write_bytes(damaged(path.read_bytes(), rng, other))


def one(case: int, made: dict[str, tuple[Path, str]], folder: Path) -> str:
    """Read one damaged file.

    Returns:
        "read", "refused", or what went wrong.
    """
    rng = np.random.default_rng(case)
    names = list(made)
    name = names[case % len(names)]
    source, format = made[name]
    others = [f for f in made[names[int(rng.integers(len(names)))]][0].rglob("*") if f.is_file()]
    other = others[int(rng.integers(len(others)))].read_bytes() if others else b""
    target = folder / f"case{source.suffix}"
    copy = shutil.copytree if source.is_dir() else shutil.copy
    copy(source, target)
    try:
        spoil(target, rng, other)
        if format == "regil" and rng.random() < 0.3:
            Demonstration.load_outline(target)
            return "read"
        chosen = None if rng.random() < 0.3 else format
        formats.read(target, chosen, size=8 if rng.random() < 0.5 else None)
        return "read"
    except Exception as error:
        return outcome(error)
    finally:
        if target.is_dir():
            shutil.rmtree(target)
        else:
            target.unlink(missing_ok=True)


def outcome(error: Exception) -> str:
    """What an error says of a reader: "refused" is one line of a kind that may be raised."""
    if not isinstance(error, (ValueError, FileNotFoundError)):
        return f"{type(error).__name__}: {error}"
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError):
            return f"over {ROOM} bytes: {error}"
        cause = cause.__cause__
    return "refused" if len(str(error).splitlines()) == 1 else f"not one line: {error}"


def limited(first: int, count: int, case: Callable[[int], str]) -> None:
    """Do the cases in a process that may not grow; the number of each is printed before it."""
    import resource

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + ROOM
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for number in range(first, first + count):
        signal.alarm(SECONDS)
        print(number, end=" ", flush=True)
        print(case(number), flush=True)
    signal.alarm(0)
    print("peak", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024, "MiB", flush=True)


def worker(first: int, count: int, folder: Path) -> None:
    """Read the cases."""
    made = samples(folder)
    for path, format in made.values():  # everything imported, every pool of memory begun
        formats.read(path, format)
    limited(first, count, lambda number: one(number, made, folder))


def run(
    count: int, first: int = 0, module: str = __spec__.name, kind: str = ""
) -> tuple[dict[str, int], list[str]]:
    """Do as many cases of a worker in another process.

    Args:
        count: of them.
        first: number of the first.
        module: whose worker it is.
        kind: of its cases, where it has several.

    Returns:
        how many were read and refused, and a line for each that was neither.
    """
    counts = {"read": 0, "refused": 0}
    wrong = []
    own = [kind] if kind else []
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-m", module, "--worker", *own, str(first), str(count), folder],
            capture_output=True,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            check=False,
        )
    for line in done.stdout.splitlines():
        case, _, outcome = line.partition(" ")
        if outcome in counts:
            counts[outcome] += 1
        elif case != "peak":
            wrong.append(f"case {case}: {outcome or 'the interpreter ended'}")
    if done.returncode:
        wrong.append(f"exit status {done.returncode}: {done.stderr[-2000:]}")
    return counts, wrong


if __name__ == "__main__":
    if sys.argv[1] == "--worker":
        worker(int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]))
    else:
        counts, wrong = run(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0)
        print(counts, *wrong, sep="\n")
        sys.exit(bool(wrong))
