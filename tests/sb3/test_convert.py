"""`regil convert`: the flags reach the formats, and bad input is one line and status 2."""

import numpy as np
import pytest
from regil_wrappers import Demonstration, formats

from regil_sb3.cli import main


@pytest.fixture
def source(tmp_path):
    frames = np.random.default_rng(0).integers(0, 256, (9, 12, 16, 3), dtype=np.uint8)
    actions = np.full((8, 3), 0.25, np.float32)
    demo = Demonstration(frames, actions, metadata={"control_rate": 20})
    formats.write(demo, tmp_path / "in.npz")
    return tmp_path / "in.npz"


def test_convert(source, tmp_path, capsys):
    words = ["convert", str(source), str(tmp_path / "out.hdf5"), "--flip", "rows", "--size", "8"]
    words += ["--crop", "0", "2", "12", "12", "--fps", "10", "--actions", "sum", "--held", "2"]
    assert main(words) == 0
    assert "5 frames of 8x8, 4 actions" in capsys.readouterr().out
    demo = Demonstration.load(tmp_path / "out.hdf5")
    assert demo.actions[0].tolist() == [0.5, 0.5, 0.25]
    assert [next(iter(step)) for step in demo.metadata["provenance"]] == [
        "read", "flip", "crop", "size", "fps",
    ]  # fmt: skip
    assert main(["convert", str(source), str(tmp_path / "set"), "--format", "lerobot"]) == 0
    assert "not kept: the last frame" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--fps", "10"], "executed at 20 Hz"),
        (["--fps", "inf"], "fps=inf"),
        (["--from", "zarr"], "format='zarr'"),
        (["--format", "zarr"], "format='zarr'"),
        (["--size", "1", "2", "3"], "size=[1, 2, 3]"),
        (["--episode", "2"], "episode=2: npz takes"),
        (["--actions", "sum"], "give both"),
    ],
)
def test_bad_input_is_one_line_and_status_2(source, tmp_path, flags, message, capsys):
    assert main(["convert", str(source), str(tmp_path / "out.hdf5"), *flags]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1
    assert [file.name for file in tmp_path.iterdir()] == ["in.npz"]


def test_nothing_is_written_over(source, capsys):
    assert main(["convert", str(source), str(source)]) == 2
    assert "exists already" in capsys.readouterr().err
