"""Files that are not what they say: one line each, nothing executed, no memory for mere claims."""

from __future__ import annotations

import io
import json
import pickle
import struct
import sys
import zipfile
import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from regil_wrappers import Demonstration, formats
from regil_wrappers.formats import fuzz
from regil_wrappers.formats.footer import claims
from regil_wrappers.formats.fuzz import example
from regil_wrappers.formats.parquet import batches
from regil_wrappers.limits import Budget

DEMO = example()
IMAGE = "data/demo_0/obs/agentview_image"


def refused(path: Path, message: str, **options: Any) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        formats.read(path, **options)
    assert "\n" not in str(caught.value)
    assert not isinstance(caught.value.__cause__, MemoryError)


@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited as Linux does it")
def test_damaged_files_in_a_process_that_may_not_grow() -> None:
    counts, wrong = fuzz.run(300)
    assert not wrong
    assert counts["read"] + counts["refused"] == 300
    assert counts["refused"] > 100


@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited as Linux does it")
@pytest.mark.parametrize(
    "case",
    [
        7885,  # an index of a parquet column that ended pyarrow 26's interpreter
        9893,  # a film's description that claims 45 kB of its 173 bytes
        25557,  # one that FFmpeg does not know yet
        29623,  # a chunk of a PNG that claims gigabytes
    ],
)
def test_damaged_files_that_once_were_too_much(case: int) -> None:
    counts, wrong = fuzz.run(1, first=case)
    assert not wrong
    assert counts["read"] + counts["refused"] == 1  # pyarrow 17 reads the first


def test_claims_of_a_parquet_file(tmp_path: Path) -> None:
    pyarrow, parquet = map(pytest.importorskip, ("pyarrow", "pyarrow.parquet"))
    columns = {
        "lists": [[1, 2], [3], None],
        "structs": [{"x": 1, "y": "s"}] * 3,
        "truths": [True, False, None],
        "numbers": [1.5, 2.5, float("nan")],
        **{f"more {i}": [i] * 3 for i in range(20)},
    }
    table = pyarrow.table({k: pyarrow.array(v) for k, v in columns.items()})
    parquet.write_table(table, tmp_path / "a.parquet", row_group_size=1)
    index = parquet.read_metadata(tmp_path / "a.parquet")
    groups = [index.row_group(i) for i in range(index.num_row_groups)]
    expected = [
        (tuple(column.path_in_schema.split(".")), column.num_values, column.total_uncompressed_size)
        for column in (group.column(i) for group in groups for i in range(index.num_columns))
    ]
    with (tmp_path / "a.parquet").open("rb") as stream:
        assert list(claims(stream, 2**24)) == expected
        with pytest.raises(ValueError, match=r"at most 100 are read$"):
            list(claims(stream, 100))
    # What nobody asks for is skipped: a megabyte of truths, and lists in lists
    data = (tmp_path / "a.parquet").read_bytes()
    length = int.from_bytes(data[-8:-4], "little")
    odd = {"truths": b"\x11" * 1_000_000, "deep": b"\x19" + b"\x19" * 10 + b"\x15\x00"}
    for extra in odd.values():
        index = data[-8 - length : -9] + extra + b"\0"
        (tmp_path / "b.parquet").write_bytes(
            data[: -8 - length] + index + len(index).to_bytes(4, "little") + b"PAR1"
        )
        with (tmp_path / "b.parquet").open("rb") as stream:
            assert list(claims(stream, 2**24)) == expected


def test_columns_with_dots_are_claimed(tmp_path: Path) -> None:
    pyarrow, parquet = map(pytest.importorskip, ("pyarrow", "pyarrow.parquet"))
    path = tmp_path / "a.parquet"
    parquet.write_table(pyarrow.table({"images.main": [bytes(100)] * 3, "images": [0] * 3}), path)
    claimed = []

    class Listening(Budget):
        def claim(self, what: str, size: int) -> None:
            claimed.append(what)
            super().claim(what, size)

    assert [b.num_rows for b in batches(path, ["images.main"], Listening(), "lerobot")] == [3]
    assert claimed == ["a.parquet, column 'images.main',"]


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited as Linux does it")
def test_thousands_of_damaged_files() -> None:
    counts, wrong = fuzz.run(5000, first=1000)
    assert not wrong
    assert counts["read"] + counts["refused"] == 5000


class Trap:
    """Says so when it is unpickled."""

    sprung = False

    def __reduce__(self) -> Any:
        return setattr, (Trap, "sprung", True)


def test_pickles_are_not_opened(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", frames=DEMO.frames, actions=np.array([Trap()], dtype=object))
    refused(tmp_path / "a.npz", "no objects")
    with zipfile.ZipFile(tmp_path / "b.npz", "w") as archive:
        archive.writestr("frames.npy", pickle.dumps(Trap()))
    refused(tmp_path / "b.npz", "magic string")
    DEMO.save(tmp_path / "c.hdf5")
    with h5py.File(tmp_path / "c.hdf5", "r+") as file:
        del file[IMAGE]
        file[IMAGE] = np.void(pickle.dumps(Trap()))
    refused(tmp_path / "c.hdf5", "does not hold numbers")
    assert not Trap.sprung


def npy(shape: tuple[int, ...], content: bytes) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": "|u1", "fortran_order": False, "shape": shape}
    )
    return stream.getvalue() + content


def test_zip_bombs(tmp_path: Path) -> None:
    claims = (
        ((10**5, 500, 500, 3), "claims"),
        ((2**40, 8, 8, 3), "claims"),
        ((-1, 8, 8, 3), "only numbers"),
    )
    for shape, message in claims:
        with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("frames.npy", npy(shape, bytes(10**6)))
        refused(tmp_path / "a.npz", message)
    with zipfile.ZipFile(tmp_path / "c.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        length = 10**8
        header = b"\x93NUMPY\x02\x00" + length.to_bytes(4, "little") + b" " * length
        archive.writestr("frames.npy", header)
    refused(tmp_path / "c.npz", "header of 100000000 bytes")
    with zipfile.ZipFile(tmp_path / "b.npz", "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("frames.npy", npy((10**4, 10, 10, 3), bytes(3 * 10**6)))
    refused(tmp_path / "b.npz", "packed in a way")


@pytest.mark.parametrize("name", ["regil", "robomimic"])
def test_hdf5_that_is_packed_twice(name: str, tmp_path: Path) -> None:
    path = tmp_path / "demo.hdf5"
    DEMO.save(path)
    with h5py.File(path, "r+") as file:
        del file[IMAGE]
        properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        properties.set_chunk((1, 16, 16, 3))
        properties.set_deflate(9)
        properties.set_filter(h5py.h5z.FILTER_DEFLATE, 0, (9,))
        space = h5py.h5s.create_simple((5, 16, 16, 3))
        h5py.h5d.create(
            file["data/demo_0/obs"].id, b"agentview_image", h5py.h5t.NATIVE_UINT8, space, properties
        )
    refused(path, "filters", format=name)


@pytest.mark.parametrize("name", ["regil", "robomimic"])
@pytest.mark.parametrize("kind", ["soft", "external", "virtual", "chunks", "huge"])
def test_hdf5_that_leads_elsewhere_or_claims(kind: str, name: str, tmp_path: Path) -> None:
    path = tmp_path / "demo.hdf5"
    DEMO.save(path)
    with h5py.File(path, "r+") as file:
        del file["data/demo_0/actions"]
        group = file["data/demo_0"]
        if kind == "soft":
            group["actions"] = h5py.SoftLink("/data/demo_0/successes")
        elif kind == "external":
            group["actions"] = h5py.ExternalLink("/dev/zero", "/x")
        elif kind == "virtual":
            layout = h5py.VirtualLayout((5, 3), np.float32)
            layout[:] = h5py.VirtualSource(tmp_path / "other.h5", "x", (5, 3))
            group.create_virtual_dataset("actions", layout)
        elif kind == "chunks":
            chunks = (2**10, 2**18)
            group.create_dataset("actions", (5, 3), "f4", chunks=chunks, maxshape=(None, None))
        else:
            group.create_dataset("actions", (2**40, 3), "f4", chunks=(64, 3))
    message = {"soft": "link", "external": "link", "virtual": "another file"}
    refused(path, message.get(kind, "claims"), format=name)


def test_a_heap_that_hdf5_would_walk_for_ever(tmp_path: Path) -> None:
    path = tmp_path / "demo.hdf5"
    DEMO.save(path)
    content = bytearray(path.read_bytes())
    heap = content.index(b"GCOL")
    # Its first part becomes free space of no size.
    content[heap + 16 : heap + 32] = bytes(16)
    path.write_bytes(content)
    for name in ("regil", "robomimic", None):
        refused(path, "a heap's part does not fit", format=name)


def test_lengths_of_a_kind_that_crashes_hdf5(tmp_path: Path) -> None:
    formats.write(DEMO, tmp_path / "set", "minari")
    path = tmp_path / "set/data/main_data.hdf5"
    with h5py.File(path, "r+") as file:
        del file["episode_0/observations"]
        lengths = h5py.vlen_dtype(np.uint8)
        stored = file.create_dataset("episode_0/observations", len(DEMO), lengths)
        for i, frame in enumerate(DEMO.frames):
            stored[i] = np.frombuffer(fuzz.jpeg(frame), np.uint8)
    assert len(formats.read(tmp_path / "set")) == len(DEMO)
    content = path.read_bytes()
    path.write_bytes(content.replace(b"\x19\0\0\0\x10", b"\x19\x09\0\0\x10"))
    refused(tmp_path / "set", "does not hold pictures")


def test_a_picture_that_claims_too_many_pixels(tmp_path: Path) -> None:
    (tmp_path / "shots").mkdir()
    for width, height in ((5000, 5000), (12_000, 12_000), (60_000, 60_000)):
        head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
        parts = ((b"IHDR", head), (b"IDAT", zlib.compress(b"")), (b"IEND", b""))
        png = b"".join(
            struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d))
            for k, d in parts
        )
        (tmp_path / "shots/0.png").write_bytes(b"\x89PNG\r\n\x1a\n" + png)
        refused(tmp_path / "shots", "pixels")
    formats.write(DEMO, tmp_path / "a.gif")
    content = bytearray((tmp_path / "a.gif").read_bytes())
    content[6:10] = b"\xff\xff\xff\xff"
    (tmp_path / "a.gif").write_bytes(content)
    refused(tmp_path / "a.gif", "pixels")


def test_films_that_claim(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    formats.write(DEMO, path)
    whole = path.read_bytes()
    for box, at in ((b"stsz", 12), (b"stts", 8), (b"stco", 8), (b"stsc", 8)):
        content = bytearray(whole)
        place = content.index(box) + at
        content[place : place + 4] = struct.pack(">I", 2**29)
        path.write_bytes(content)
        refused(path, "claims 536870912 entries")
    path.write_bytes(whole[: len(whole) // 2])
    refused(path, "cut short")


def test_a_play_list_is_no_film(tmp_path: Path) -> None:
    """FFmpeg would open what it lists."""
    (tmp_path / "a.mp4").write_text("#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n")
    refused(tmp_path / "a.mp4", "box", format="mp4")
    refused(tmp_path / "a.mp4", "no format that is known")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("data_path", "../../{episode_index}.parquet", "leads out|not known"),
        ("data_path", "/etc/passwd", "leads out"),
        ("data_path", "{chunk_index.__class__}", "leads out"),
        ("data_path", "{chunk_index:9999999999d}", "leads out"),
        ("data_path", "data/{shard}.parquet", "asks for 'shard'"),
        ("codebase_version", "v9.9", "v2.x and v3.x are read"),
        ("fps", "fast", "fps in meta/info.json"),
        ("features", [], "has no features"),
    ],
)
def test_lerobots_info(key: str, value: Any, message: str, tmp_path: Path) -> None:
    formats.write(DEMO, tmp_path / "set", "lerobot")
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    (tmp_path / "set/meta/info.json").write_text(json.dumps(info | {key: value}))
    refused(tmp_path / "set", message)


def test_parquet_with_other_columns(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    formats.write(DEMO, tmp_path / "set", "lerobot")
    file = tmp_path / "set/data/chunk-000/file-000.parquet"
    table = pq.read_table(file)
    pq.write_table(table.drop_columns(["observation.state"]), file)
    refused(tmp_path / "set", "no column 'observation.state'")
    i = table.schema.get_field_index("action")
    pq.write_table(table.set_column(i, "action", pa.array(["x"] * 5)), file)
    refused(tmp_path / "set", "numbers or lists of them")
    ragged = pa.array([[1.0], [1.0, 2.0], [], [1.0], [1.0]])
    pq.write_table(table.set_column(i, "action", ragged), file)
    refused(tmp_path / "set", "several lengths")


def test_observations_named_twice(tmp_path: Path) -> None:
    DEMO.save(tmp_path / "demo.hdf5")
    with h5py.File(tmp_path / "demo.hdf5", "r+") as file:
        file["data/demo_0"].attrs["observations"] = json.dumps(["state"] * 1000)
    with pytest.raises(ValueError, match="twice"):
        Demonstration.load(tmp_path / "demo.hdf5")
