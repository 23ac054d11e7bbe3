"""Other people's demonstrations: what goes out comes back, and what was stored is what is read."""

from __future__ import annotations

import dataclasses
import json
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from regil_wrappers import Demonstration, RetrievalRewardWrapper, formats
from regil_wrappers.formats.changes import FLIPS
from regil_wrappers.formats.fuzz import example, jpeg, lerobot_film, minari_arrow
from toy_env import ToyReach

DEMO = example()
EXACT = [name for name, known in formats.FORMATS.items() if known.exact]


def out(folder: Path, name: str) -> Path:
    return folder / f"out{(formats.FORMATS[name].suffixes or ('.hdf5',))[0]}"


@pytest.mark.parametrize("name", EXACT)
def test_round_trips_are_exact(name: str, tmp_path: Path) -> None:
    path = out(tmp_path, name)
    lost = formats.write(DEMO, path, name)
    back = formats.read(path, name)
    n = len(DEMO) - ("the last frame" in lost)
    np.testing.assert_array_equal(back.frames, DEMO.frames[:n])
    if "actions" not in lost:
        assert DEMO.actions is not None
        assert back.actions is not None
        np.testing.assert_array_equal(back.actions, DEMO.actions)
        assert back.metadata["action_low"] == [-1] * 3
        assert isinstance(back.observations, dict)
        assert isinstance(DEMO.observations, dict)
        np.testing.assert_array_equal(back.observations["state"], DEMO.observations["state"][:n])
    if name in ("regil", "minari", "npz", "lerobot"):
        assert DEMO.successes is not None
        np.testing.assert_array_equal(back.successes, DEMO.successes[:n])
    provenance = back.metadata["provenance"]
    assert provenance == [] if name == "regil" else provenance[0]["read"] == name
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    assert formats.detect(path) == ("regil" if name == "robomimic" else name)


FULL_DISK = """
import resource, sys
import numpy as np
from regil_wrappers import Demonstration, formats
frames = np.random.default_rng(0).integers(0, 256, (20, 64, 64, 3), np.uint8)
demo = Demonstration(frames, np.zeros((19, 2), np.float32), metadata={"control_rate": 10})
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, resource.RLIM_INFINITY))
try:
    formats.write(demo, sys.argv[2], sys.argv[1])
except OSError as error:
    print(error)
"""


@pytest.mark.parametrize("name", [name for name in EXACT if name != "pictures"])
def test_a_full_disk_is_one_line_and_leaves_nothing(name: str, tmp_path: Path) -> None:
    """In a process of its own: HDF5 may crash."""
    words = [sys.executable, "-c", FULL_DISK, name, str(out(tmp_path, name))]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "File too large" in done.stdout
    assert len(done.stdout.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["mp4", "gif"])
def test_films_come_back_nearly(name: str, tmp_path: Path) -> None:
    path = out(tmp_path, name)
    assert "actions" in formats.write(DEMO, path)
    back = formats.read(path)
    assert back.metadata["control_rate"] == 10
    assert back.actions is None
    error = np.abs(back.frames.astype(float) - DEMO.frames)
    assert error.mean() < 12
    wrong = np.abs(back.frames[::-1].astype(float) - DEMO.frames)
    assert error.mean() < wrong.mean() / 4


def test_robomimics_own_layout(tmp_path: Path) -> None:
    """Two demonstrations, two cameras, as robomimic's documentation describes them."""
    rng = np.random.default_rng(1)
    seen = rng.integers(0, 256, (6, 8, 8, 3), dtype=np.uint8)
    with h5py.File(tmp_path / "low_dim.hdf5", "w") as file:
        file.create_group("data").attrs["env_args"] = json.dumps(
            {"env_name": "Lift", "type": 1, "env_kwargs": {"control_freq": 20}}
        )
        for name in ("demo_0", "demo_12"):
            group = file["data"].create_group(name)
            group["actions"] = rng.uniform(-1, 1, (5, 7))
            for part, rows in (("obs", seen[:5]), ("next_obs", seen[1:])):
                group[f"{part}/robot0_eye_in_hand_image"] = rows
                group[f"{part}/agentview_image"] = 255 - rows
                group[f"{part}/eef"] = np.full((5, 3), 2.0)
    path = tmp_path / "low_dim.hdf5"
    assert formats.detect(path) == "robomimic"
    demo = formats.read(path, episode=12, camera="robot0_eye_in_hand_image")
    np.testing.assert_array_equal(demo.frames, seen)
    assert demo.metadata["control_rate"] == 20
    assert list(demo.observations or ()) == ["eef"]
    np.testing.assert_array_equal(formats.read(path).frames, 255 - seen)
    with pytest.raises(ValueError, match="no demo_3: it has 2"):
        formats.read(path, episode=3)
    with pytest.raises(
        ValueError, match=r"no camera 'top': choose camera= from \['agentview_image"
    ):
        formats.read(path, camera="top")


def test_libero_is_stored_upside_down(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "task_demo.hdf5", "w") as file:
        group = file.create_group("data/demo_0")
        group["actions"] = np.zeros((6, 7))
        group["obs/agentview_rgb"] = DEMO.frames[:, ::-1]
    demo = formats.read(tmp_path / "task_demo.hdf5")
    np.testing.assert_array_equal(demo.frames, DEMO.frames)
    assert demo.metadata["provenance"][0]["rows"] == "turned round"


@pytest.mark.filterwarnings("ignore::UserWarning")  # Minari's, on what a toy leaves out
@pytest.mark.parametrize("storage", ["hdf5", "arrow", "parquet"])
@pytest.mark.parametrize("coded", [False, True])
@pytest.mark.parametrize("several", [False, True])
def test_what_minari_wrote(
    storage: str, coded: bool, several: bool, tmp_path: Path, monkeypatch: Any
) -> None:
    import gymnasium as gym

    minari = pytest.importorskip("minari")
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    assert DEMO.actions is not None
    assert isinstance(DEMO.observations, dict)
    picture = gym.spaces.Box(0, 255, DEMO.frames.shape[1:], np.uint8)
    space: gym.Space[Any] = picture
    observations: Any = DEMO.frames
    if several:
        state = gym.spaces.Box(-9, 9, (4,), np.float32)
        space = gym.spaces.Dict({"top": picture, "state": state})
        observations = {"top": DEMO.frames, **DEMO.observations}
    flags = np.zeros(5, bool)
    one = EpisodeBuffer(
        observations=observations,
        actions=DEMO.actions,
        rewards=np.zeros(5),
        terminations=flags,
        truncations=flags,
    )
    minari.create_dataset_from_buffers(
        "toy/reach-v0",
        [one],
        observation_space=space,
        action_space=gym.spaces.Box(-1, 1, (3,)),
        data_format=storage,
        jpeg_encoding=coded,
        description="toy",
        algorithm_name="expert",
        author="none",
        author_email="none",
        code_permalink="none",
    )
    back = formats.read(tmp_path / "toy/reach-v0")
    np.testing.assert_array_equal(back.actions, DEMO.actions)
    assert back.metadata["action_high"] == [1] * 3
    assert back.frames.shape == DEMO.frames.shape
    if coded:
        assert np.abs(back.frames.astype(float) - DEMO.frames).mean() < 25
    else:
        np.testing.assert_array_equal(back.frames, DEMO.frames)
    if several:
        assert isinstance(back.observations, dict)
        np.testing.assert_array_equal(back.observations["state"], DEMO.observations["state"])


def test_minari_reads_what_we_write(tmp_path: Path) -> None:
    minari = pytest.importorskip("minari")
    formats.write(DEMO, tmp_path / "reach", "minari")
    episode = minari.MinariDataset(tmp_path / "reach/data")[0]
    np.testing.assert_array_equal(episode.observations["image"], DEMO.frames)
    np.testing.assert_array_equal(episode.actions, DEMO.actions)
    assert episode.terminations.tolist() == [False] * 4 + [True]


@pytest.mark.parametrize("version", formats.lerobot.VERSIONS)
def test_lerobots_films(version: str, tmp_path: Path) -> None:
    lerobot_film(tmp_path / "set", DEMO, version)
    demo = formats.read(tmp_path / "set")
    assert len(demo) == 5
    assert np.abs(demo.frames.astype(float) - DEMO.frames[:5]).mean() < 12
    np.testing.assert_array_equal(demo.actions, DEMO.actions)
    with pytest.raises(ValueError, match="no episode 1"):
        formats.read(tmp_path / "set", episode=1)


def test_an_episode_inside_a_longer_film(tmp_path: Path) -> None:
    """v3 puts many episodes into one film; `from_timestamp` says where one begins."""
    rng = np.random.default_rng(0)
    shades = rng.integers(0, 256, (40, 1, 1, 3), dtype=np.uint8)
    frames = np.broadcast_to(shades, (40, 16, 16, 3)).copy()
    formats.write(Demonstration(frames, metadata={"control_rate": 10}), tmp_path / "all.mp4")
    whole = formats.read(tmp_path / "all.mp4").frames
    part = formats.read(tmp_path / "all.mp4", start=1.7, frames=9).frames
    np.testing.assert_array_equal(part, whole[17:26])
    with pytest.raises(ValueError, match=r"has 3 frames from 3.7 s on, not 9"):
        formats.read(tmp_path / "all.mp4", start=3.7, frames=9)


def test_a_telephones_rotation_is_applied(tmp_path: Path) -> None:
    path = tmp_path / "phone.mov"
    formats.write(DEMO, path, "mp4")
    plain = formats.read(path).frames
    content = bytearray(path.read_bytes())
    matrix = content.index(b"tkhd") + 4 + 40
    one = 1 << 16
    # a quarter turn, as telephones held upright write it
    content[matrix : matrix + 36] = struct.pack(">9i", 0, one, 0, -one, 0, 0, 0, 0, 1 << 30)
    path.write_bytes(content)
    turned = formats.read(path).frames
    np.testing.assert_array_equal(turned, np.rot90(plain, -1, axes=(1, 2)))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_cameras_orientation_is_applied(orientation: int, suffix: str, tmp_path: Path) -> None:
    upright = np.kron(np.random.default_rng(0).integers(0, 256, (2, 3, 3)), np.ones((16, 16, 1)))
    upright = upright.astype(np.uint8)
    # EXIF's definition: where the first row and the first column of what is stored belong
    stored = {1: upright, 2: upright[:, ::-1], 3: upright[::-1, ::-1], 4: upright[::-1]}
    stored |= {5: upright.swapaxes(0, 1), 6: np.rot90(upright), 8: np.rot90(upright, -1)}
    stored[7] = stored[5][::-1, ::-1]
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(stored[orientation]).save(tmp_path / f"0{suffix}", quality=100, exif=exif)
    (frame,) = formats.read(tmp_path).frames
    assert frame.shape == upright.shape
    assert np.abs(frame.astype(int) - upright).mean() < 3


def test_pictures_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    (tmp_path / "shots").mkdir()
    for i in range(12):
        (tmp_path / f"shots/shot{i}.jpg").write_bytes(jpeg(np.full((8, 8, 3), 20 * i, np.uint8)))
    (tmp_path / "shots/notes.txt").write_text("not a picture")
    (tmp_path / "shots/._shot0.jpg").write_bytes(b"of a Macintosh")
    means = formats.read(tmp_path / "shots").frames.mean(axis=(1, 2, 3))
    assert (np.diff(means) > 10).all()


@pytest.mark.parametrize("name", ["arrow", "parquet", "lerobot"])
def test_hidden_files_of_a_data_set_are_left_alone(name: str, tmp_path: Path) -> None:
    if name == "lerobot":
        formats.write(DEMO, tmp_path / "set", "lerobot")
    else:
        minari_arrow(tmp_path / "set", DEMO, name)
    for file in [f for f in (tmp_path / "set").rglob("*") if f.is_file()]:
        file.with_name(f"._{file.name}").write_bytes(b"of a Macintosh")
    assert len(formats.read(tmp_path / "set")) >= len(DEMO) - 1


def test_a_film_of_a_person_rewards_but_cannot_guide(demo: Demonstration, tmp_path: Path) -> None:
    from regil_wrappers import RetrievalGuideWrapper

    formats.write(Demonstration(demo.frames), tmp_path / "film", "pictures")
    film = formats.read(tmp_path / "film")
    env = RetrievalRewardWrapper(ToyReach(), film)
    env.reset(seed=0)
    rewards = [env.step(ToyReach.expert_action(env.unwrapped))[1] for _ in range(5)]  # type: ignore[arg-type]
    assert rewards == [0] * 5
    with pytest.raises(ValueError, match="has no actions, so it cannot guide: record one that has"):
        RetrievalGuideWrapper(ToyReach(), film)


# -- changes on the way in -------------------------------------------------------------------------


def test_changes_are_made_in_order_and_recorded(tmp_path: Path) -> None:
    path = tmp_path / "demo.npz"
    formats.write(DEMO, path)
    demo = formats.read(path, flip="rows", crop=[2, 4, 8, 8], size=4, encoder_size=[16, 12])
    expected = DEMO.frames[:, ::-1][:, 2:10, 4:12].reshape(6, 4, 2, 4, 2, 3).mean(axis=(2, 4))
    assert np.abs(demo.frames - expected).max() <= 1
    assert demo.encoder_frames is not None
    assert demo.encoder_frames.shape == (6, 16, 12, 3)
    assert demo.metadata["image_size"] == [4, 4]
    assert demo.metadata["provenance"] == [
        {"read": "npz", "file": "demo.npz"},
        {"flip": "rows"},
        {"crop": [2, 4, 8, 8]},
        {"size": [4, 4]},
        {"encoder_size": [16, 12]},
    ]
    for name, turned in FLIPS.items():
        flipped = formats.read(path, flip=name).frames
        np.testing.assert_array_equal(flipped[0], DEMO.frames[0][turned])


def numbered(n: int, t: int, rate: float) -> Demonstration:
    frames = np.broadcast_to(np.arange(n, dtype=np.uint8)[:, None, None, None], (n, 2, 2, 3))
    actions = np.random.default_rng(n).uniform(-1, 1, (t, 2)).astype(np.float32)
    return Demonstration(frames, actions, metadata={"control_rate": rate})


@given(st.integers(3, 40), st.booleans(), st.sampled_from([5, 10, 20, 30]), st.floats(1, 60))
@settings(max_examples=150, deadline=None)
def test_resampling(n: int, outcome: bool, rate: int, fps: float) -> None:
    demo = numbered(n, n - outcome, rate)
    assert demo.actions is not None
    total = demo.actions.astype(np.float64).sum(axis=0)
    summed = formats.resample(demo, fps, "sum", held=[1])
    meant = formats.resample(demo, fps, "mean")
    for new in (summed, meant, formats.resample(demo, fps, "drop")):
        shown = new.frames[:, 0, 0, 0]
        assert shown[0] == 0
        assert shown[-1] == n - 1  # the outcome is never lost
        moments = np.arange(len(shown) - 1) / fps
        if fps != rate:  # at a boundary within rounding, either frame is right
            assert (shown[:-1] >= np.floor(moments * rate - 1e-3)).all()
            assert (shown[:-1] <= np.floor(moments * rate + 1e-3)).all()
    assert summed.actions is not None
    assert meant.actions is not None
    np.testing.assert_allclose(summed.actions[:, 0].sum(dtype=np.float64), total[0], atol=1e-3)
    assert (np.abs(meant.actions) <= np.abs(demo.actions).max(axis=0)).all()
    assert set(summed.actions[:, 1]) <= set(demo.actions[:, 1])
    assert len(summed.actions) == len(summed) - outcome


def test_half_the_rate() -> None:
    demo = numbered(7, 6, 20)
    a = demo.actions
    assert a is not None
    for how, expected in (
        ("sum", a[::2] + a[1::2]),
        ("mean", (a[::2] + a[1::2]) / 2),
        ("last", a[1::2]),
    ):
        new = formats.resample(demo, 10, how)  # type: ignore[arg-type]
        np.testing.assert_allclose(new.actions, expected, rtol=1e-6)  # type: ignore[arg-type]
        assert new.frames[:, 0, 0, 0].tolist() == [0, 2, 4, 6]
        assert new.metadata["control_rate"] == 10
        assert new.metadata["provenance"][-1]["actions"] == how
    assert formats.resample(demo, 20) is demo
    with pytest.raises(ValueError, match=r"executed at 20 Hz .* at 10 Hz: say actions='drop'"):
        formats.resample(demo, 10)


def test_uneven_films_are_made_even(tmp_path: Path) -> None:
    """A gif shows an idle frame longer instead of twice."""
    idle = np.repeat(DEMO.frames, [1, 4, 1, 1, 1, 1], axis=0)
    formats.write(Demonstration(idle, metadata={"control_rate": 10}), tmp_path / "idle.gif")
    uneven = formats.read(tmp_path / "idle.gif")
    assert len(uneven) == 6
    assert uneven.metadata["frame_times"] == pytest.approx([0, 0.1, 0.5, 0.6, 0.7, 0.8])
    even = formats.read(tmp_path / "idle.gif", fps=10)
    np.testing.assert_array_equal(even.frames, np.repeat(uneven.frames, [1, 4, 1, 1, 1, 1], axis=0))


# -- bad input -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"format": "zarr"}, r"format='zarr': choose one of \['regil', 'robomimic'"),
        ({"flip": "up"}, "flip='up'"),
        ({"crop": [0, 0, 99, 4]}, "reaches beyond pictures of 16x16"),
        ({"crop": [0, 0, 4]}, "give top, left, height, width"),
        ({"size": 0}, "size=0"),
        ({"fps": 0}, "fps=0"),
        ({"fps": 5, "actions": "add"}, "actions='add'"),
        ({"actions": "sum"}, "give both"),
        ({"fps": 5, "actions": "sum", "held": [3]}, r"held=\[3\]"),
        ({"source_fps": float("nan")}, "source_fps=nan"),
        ({"episode": 1}, "episode=1: npz takes"),
        ({"camera": "front"}, "no array 'front'"),
    ],
)
def test_bad_options(options: dict[str, Any], message: str, tmp_path: Path) -> None:
    formats.write(DEMO, tmp_path / "demo.npz")
    with pytest.raises(ValueError, match=message) as caught:
        formats.read(tmp_path / "demo.npz", **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["x.dat", "REACH.NPZ", "plain", "reach.npz"])
def test_an_archive_of_any_name(name: str, tmp_path: Path) -> None:
    formats.write(DEMO, tmp_path / name, "npz")
    assert [file.name for file in tmp_path.iterdir()] == [name]
    np.testing.assert_array_equal(formats.read(tmp_path / name).frames, DEMO.frames)


def test_unknown_files_and_places(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(ValueError, match=r"no format that is known: regil .*; npz \(NumPy's"):
        formats.read(tmp_path / "notes.txt")
    with pytest.raises(FileNotFoundError, match=r"there is no '.*none'"):
        formats.read(tmp_path / "none")
    with pytest.raises(ValueError, match="names no format: say format="):
        formats.write(DEMO, tmp_path / "demo")
    with pytest.raises(FileExistsError, match="exists already"):
        formats.write(DEMO, tmp_path, "lerobot")
    for name in ("robomimic", "libero", "minari", "lerobot"):
        with pytest.raises(ValueError, match=f"has no actions, which {name} needs"):
            formats.write(Demonstration(DEMO.frames), tmp_path / "new", name)
    with pytest.raises(ValueError, match="control_rate is None: give source_fps="):
        formats.write(Demonstration(DEMO.frames), tmp_path / "new.mp4")
    assert [file.name for file in tmp_path.iterdir()] == ["notes.txt"]


def test_a_missing_package_names_its_extra(tmp_path: Path, monkeypatch: Any) -> None:
    import sys

    formats.write(DEMO, tmp_path / "demo.mp4")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ImportError, match=r"pip install 'regil-wrappers\[video\]'"):
        formats.read(tmp_path / "demo.mp4")


def test_plain_arrow_only(tmp_path: Path) -> None:
    """Compressed arrow claims any size for a buffer, so it is refused before it is unpacked."""
    import pyarrow as pa
    from pyarrow import ipc

    minari_arrow(tmp_path / "set", DEMO, "arrow")
    np.testing.assert_array_equal(formats.read(tmp_path / "set").frames, DEMO.frames)
    file = tmp_path / "set/data/0/part-0.arrow"
    table = ipc.open_file(pa.py_buffer(file.read_bytes())).read_all()
    with ipc.new_file(file, table.schema, options=ipc.IpcWriteOptions(compression="zstd")) as out:
        out.write_table(table)
    with pytest.raises(ValueError, match="compressed"):
        formats.read(tmp_path / "set")


def test_lerobots_vectors_of_one_number(tmp_path: Path) -> None:
    one = DEMO.frames[:, 0, 0, :1].astype(np.float32)
    demo = dataclasses.replace(DEMO, observations={"width": one})
    formats.write(demo, tmp_path / "set", "lerobot")
    found = formats.read(tmp_path / "set").observations
    assert isinstance(found, dict)
    np.testing.assert_array_equal(found["width"], one[:-1])  # the last frame is lost
