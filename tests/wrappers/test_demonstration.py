from __future__ import annotations

import errno
import fcntl
import json
import os
import stat
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from regil_wrappers import Demonstration

RNG = np.random.default_rng(0)
FRAMES = RNG.integers(0, 256, (7, 8, 10, 3), dtype=np.uint8)
ACTIONS = RNG.uniform(-1, 1, (6, 4)).astype(np.float32)
EVERYTHING: dict[str, Any] = {
    "frames": FRAMES,
    "actions": ACTIONS,
    "observations": {
        "state": RNG.normal(size=(7, 5)),
        "touch": RNG.integers(0, 2, 7).astype(bool),
        "depth": RNG.integers(0, 256, (7, 4, 4, 1), dtype=np.uint8),
    },
    "encoder_frames": RNG.integers(0, 256, (7, 16, 16, 3), dtype=np.uint8),
    "successes": np.arange(7) >= 6,
    "metadata": {
        "env_id": "Some-v0",
        "camera": "corner2",
        "render": {"shadows": False},
        "action_repeat": 2,
        "control_rate": 40.0,
        "action_low": [-1, -1, -1, -1],
        "action_high": [1, 1, 1, 1],
        "seed": 3,
        "seeds_tried": 1,
        "versions": {"numpy": "2.0"},
        "note": "other keys are kept",
    },
}


def same(a: Any, b: Any) -> None:
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            same(a[key], b[key])
    elif a is None:
        assert b is None
    else:
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    "given",
    [
        EVERYTHING,
        {"frames": FRAMES},
        {"frames": FRAMES, "actions": ACTIONS},
        {"frames": FRAMES[:6], "actions": ACTIONS},
        {"frames": FRAMES, "actions": ACTIONS, "observations": RNG.normal(size=(7, 3))},
        {"frames": FRAMES, "observations": np.arange(7.0)},
    ],
    ids=["everything", "frames", "actions", "T frames", "array", "without actions"],
)
def test_saved_and_loaded(given: dict[str, Any], tmp_path: Path) -> None:
    demo = Demonstration(**given)
    demo.save(tmp_path / "new" / "demo.hdf5")
    loaded = Demonstration.load(tmp_path / "new" / "demo.hdf5")
    for name in ("frames", "actions", "observations", "encoder_frames", "successes"):
        same(getattr(demo, name), getattr(loaded, name))
    assert loaded.metadata == demo.metadata
    assert len(loaded) == len(given["frames"])
    outline = Demonstration.load_outline(tmp_path / "new" / "demo.hdf5")
    assert vars(outline) | {"actions": None} == vars(loaded.outline) | {"actions": None}
    same(outline.actions, loaded.actions)
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["demo.hdf5"]


def test_the_file_has_robomimics_layout(tmp_path: Path) -> None:
    Demonstration(**EVERYTHING).save(tmp_path / "demo.hdf5")
    with h5py.File(tmp_path / "demo.hdf5") as file:
        assert list(file) == ["data"]
        assert file["data"].attrs["total"] == 6
        assert json.loads(file["data"].attrs["env_args"])["env_name"] == "Some-v0"
        demo = file["data/demo_0"]
        assert demo.attrs["num_samples"] == 6
        assert demo["actions"].shape == (6, 4)
        assert set(demo["obs"]) == {"agentview_image", "encoder_image", "state", "touch", "depth"}
        assert all(len(demo["obs"][key]) == 6 for key in demo["obs"])
        assert set(demo["final_obs"]) == set(demo["obs"])
        np.testing.assert_array_equal(demo["final_obs/agentview_image"], FRAMES[6])
        for name in ("actions", "obs/agentview_image", "obs/state", "obs/touch", "successes"):
            assert demo[name].compression == "gzip"


def test_metadata_is_filled_in() -> None:
    metadata = Demonstration(FRAMES).metadata
    assert metadata["image_size"] == [8, 10]
    assert metadata["format_version"] == 1
    assert metadata["render"] == metadata["versions"] == {}
    for key in ("env_id", "camera", "action_repeat", "control_rate", "seed", "seeds_tried"):
        assert metadata[key] is None


def test_wider_floats_become_float32() -> None:
    actions = Demonstration(FRAMES, ACTIONS.astype(np.float64)).actions
    assert actions is not None
    assert actions.dtype == np.float32


def nan_at(array: np.ndarray, *index: int) -> np.ndarray:
    array = array.copy()
    array[index] = np.nan
    return array


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": FRAMES / 255}, r"frames are float64 \(7, 8, 10, 3\): they must be uint8"),
        ({"frames": FRAMES[..., 0]}, "frames are"),
        ({"frames": np.zeros((0, 8, 8, 3), np.uint8)}, "frames are"),
        ({"actions": ACTIONS[:4]}, r"4 actions for 7 frames: there must be 6 \(or 7\)"),
        ({"actions": ACTIONS.astype(int)}, "actions are int64"),
        ({"actions": ACTIONS[:, 0]}, "actions are float32 "),
        ({"actions": nan_at(ACTIONS, 2, 1)}, r"actions\[2\] has NaN or infinity in dimension 1"),
        ({"actions": ACTIONS * 3}, r"actions\[\d\] is .* beyond action_(low|high)"),
        ({"actions": ACTIONS[:, :2]}, "action_low has 4 numbers but actions have 2"),
        ({"observations": np.zeros((6, 2))}, "one row for each of 7 frames"),
        ({"observations": {"s": np.full((7, 2), "x")}}, r"observations\['s'\] are <U1"),
        ({"observations": {"a/b": np.zeros((7, 2))}}, "key 'a/b'"),
        ({"observations": {"agentview_image": np.zeros((7, 2))}}, "key 'agentview_image'"),
        ({"observations": nan_at(np.zeros((7, 2)), 5, 0)}, "NaN or infinity in row 5"),
        ({"encoder_frames": FRAMES[:6]}, "6 encoder_frames but 7 frames"),
        ({"successes": np.zeros(6, bool)}, "one for each of 7 frames"),
        ({"successes": np.zeros(7)}, "successes are float64"),
        ({"successes": np.ones(7, bool)}, r"successes\[0\] is True"),
        ({"metadata": {"seed": "3"}}, "metadata seed is '3': it must be int or None"),
        ({"metadata": {"camera": np.zeros(2)}}, "JSON values only"),
        ({"metadata": {"control_rate": float("nan")}}, "JSON values only"),
        ({"metadata": {"image_size": [9, 9]}}, r"image_size is \[9, 9\] but frames are \[8, 10\]"),
        ({"metadata": {"format_version": 2}}, "update regil-wrappers"),
        ({"metadata": {"action_low": "low"}}, "action_low is 'low'"),
        ({"metadata": [1]}, "metadata is list"),
    ],
)
def test_bad_content(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        Demonstration(**(EVERYTHING | change))
    assert "\n" not in str(caught.value)


def test_a_missing_file_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"record one with 'regil record ENV -o .*no\.h5'"):
        Demonstration.load(tmp_path / "no.h5")


def test_a_folder(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is a folder"):
        Demonstration.load(tmp_path)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    Demonstration(**EVERYTHING).save(tmp_path / "demo.hdf5")
    return tmp_path / "demo.hdf5"


def refused(path: Path, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        Demonstration.load(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_text_file(path: Path) -> None:
    path.write_text("this is no HDF5")
    refused(path, "not an HDF5 file")


@pytest.mark.parametrize("part", [0.02, 0.1, 0.5, 0.9, 0.99])
def test_a_truncated_file(path: Path, part: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(part * len(data))])
    refused(path, "cut short|damaged")


def test_damaged_bytes_never_give_anything_but_one_line(path: Path) -> None:
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    messages = []
    for _ in range(150):
        damaged = bytearray(data)
        for at in rng.integers(8, len(data), 20):
            damaged[at] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        try:
            Demonstration.load(path)
        except ValueError as error:
            messages.append(str(error))
    assert len(messages) > 50
    assert all(str(path) in message and "\n" not in message for message in messages)


def edit(path: Path, change: Any) -> None:
    with h5py.File(path, "r+") as file:
        change(file, file["data"], file["data/demo_0"])


def without(name: str) -> Any:
    def change(file: Any, data: Any, demo: Any) -> None:
        del file[name]

    return change


def rewritten(name: str, value: Any) -> Any:
    def change(file: Any, data: Any, demo: Any) -> None:
        del file[name]
        file[name] = value

    return change


def attribute(name: str, value: Any) -> Any:
    def change(file: Any, data: Any, demo: Any) -> None:
        (data if name == "regil_metadata" else demo).attrs[name] = value

    return change


IMAGE = "data/demo_0/obs/agentview_image"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without("data"), "not a ReGIL demonstration"),
        (without("data/demo_0"), "no '/data/demo_0'"),
        (without(IMAGE), "no '/data/demo_0/obs/agentview_image'"),
        (without("data/demo_0/final_obs/state"), "no '/data/demo_0/final_obs/state'"),
        (without("data/demo_0/final_obs"), "7|6"),
        (lambda f, data, demo: data.attrs.pop("regil_metadata"), "no attribute 'regil_metadata'"),
        (attribute("regil_metadata", "{"), "Expecting"),
        (attribute("regil_metadata", "[" * 100_000), "recursion"),
        (attribute("regil_metadata", 3), "not a JSON text"),
        (attribute("regil_metadata", '{"format_version": 9}'), "format_version is 9"),
        (attribute("observations", '{"a": 1}'), "null, a name or a list"),
        (attribute("observations", '["../../actions"]'), "no name of a member"),
        (attribute("observations", "[3]"), "no name of a member"),
        (rewritten("data/demo_0/actions", np.full((6, 4), np.nan)), "NaN"),
        (rewritten("data/demo_0/actions", np.full((6, 4), 7.0)), "beyond action_high"),
        (rewritten("data/demo_0/actions", "text"), "does not hold numbers"),
        (rewritten("data/demo_0/actions", h5py.Empty("f")), "does not hold numbers"),
        (rewritten(IMAGE, np.zeros((6, 8, 9, 3), np.uint8)), "does not fit"),
        (rewritten(IMAGE, np.zeros((6, 8, 10, 3))), "does not fit"),
        (rewritten("data/demo_0/actions", h5py.SoftLink("/data/demo_0/successes")), "link"),
        (rewritten("data/demo_0/actions", h5py.ExternalLink("x.h5", "/a")), "link"),
        (rewritten("data/demo_0/obs", h5py.SoftLink("/data/demo_0/final_obs")), "link"),
        (rewritten("data/demo_0/obs", np.zeros(3)), "is not a group"),
    ],
)
def test_foreign_content(path: Path, change: Any, message: str) -> None:
    edit(path, change)
    refused(path, message)


def test_a_dataset_may_not_live_in_another_file(path: Path, tmp_path: Path) -> None:
    (tmp_path / "secret").write_bytes(b"\0" * 96)

    def external(file: Any, data: Any, demo: Any) -> None:
        del demo["actions"]
        secret = [(str(tmp_path / "secret"), 0, 96)]
        demo.create_dataset("actions", (6, 4), np.float32, external=secret)

    edit(path, external)
    refused(path, "another file")

    def virtual(file: Any, data: Any, demo: Any) -> None:
        del demo["actions"]
        layout = h5py.VirtualLayout((6, 4), np.float32)
        layout[:] = h5py.VirtualSource(tmp_path / "secret.h5", "x", (6, 4))
        demo.create_virtual_dataset("actions", layout)

    edit(path, virtual)
    refused(path, "another file")


@pytest.mark.parametrize("length", [10**5, 10**9, 2**50])
def test_a_size_that_is_only_claimed_is_not_allocated(path: Path, length: int) -> None:
    def huge(file: Any, data: Any, demo: Any) -> None:
        del file[IMAGE]
        file.create_dataset(IMAGE, (length, 84, 84, 3), np.uint8, chunks=(1, 84, 84, 3))

    edit(path, huge)
    refused(path, "claims .* bytes")


def test_an_interrupted_save_leaves_the_old_file(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = path.read_bytes()

    def interrupted(*args: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        Demonstration(FRAMES).save(path)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_the_file_that_is_written_reaches_the_disk(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the descriptor that wrote it: Windows refuses those that are open for reading alone."""
    synced = []

    def fsync(descriptor: int, real: Any = os.fsync) -> None:
        if not stat.S_ISDIR(os.fstat(descriptor).st_mode):
            if fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
                raise OSError(errno.EBADF, "Bad file descriptor")
            synced.append(descriptor)
        real(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    Demonstration(FRAMES).save(path)
    assert len(synced) == 1


def test_saved_files_are_as_readable_as_any_new_file(path: Path) -> None:
    (path.parent / "other").touch()
    assert path.stat().st_mode == (path.parent / "other").stat().st_mode
