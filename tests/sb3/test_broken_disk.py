"""A disk, a log or a run folder that breaks while `regil train` runs, for real."""

from __future__ import annotations

import resource
import shutil

import pytest

from regil_sb3 import TD3BC, training
from regil_sb3.checkpoint import CheckpointCallback
from regil_sb3.cli import main
from regil_sb3.training import TrainingCallback

# of the thread that writes TensorBoard's log
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")


@pytest.fixture
def at_step(monkeypatch):
    """Do something at a step of a run that saves a checkpoint every 20."""
    monkeypatch.setattr(training, "BC_UPDATES", 3)
    monkeypatch.setattr(
        training,
        "CheckpointCallback",
        lambda *args, **kw: CheckpointCallback(*args, **kw, steps=20),
    )
    step = TrainingCallback._on_step

    def do(at, what):
        def on_step(self):
            if self.num_timesteps == at:
                what(self)
            return step(self)

        monkeypatch.setattr(TrainingCallback, "_on_step", on_step)

    return do


def test_a_removed_run_folder_ends_it_in_one_line(words, at_step, tmp_path, capsys):
    at_step(90, lambda _: shutil.rmtree(tmp_path / "run"))
    assert main(words) == 2
    error = capsys.readouterr().err
    assert f"regil: {tmp_path / 'run'} was removed, or can no longer be read, at step 90" in error
    assert not (tmp_path / "run").exists()


def test_logs_that_cannot_be_written_cost_their_lines(words, at_step, tmp_path, capsys):
    def close_files(callback):
        for log in callback.logger.output_formats:
            if hasattr(log._log, "file"):
                log._log.file.close()
            else:
                writer = log._log.writer.file_writer.event_writer._async_writer._writer._writer
                writer.close()

    at_step(90, close_files)
    assert main(words) == 0
    error = capsys.readouterr().err
    assert error.count("progress.csv cannot be written (") == 1
    assert error.count("TensorBoard's log cannot be written (") == 1
    assert TD3BC.load(tmp_path / "run" / "model.zip").num_timesteps == 200


# Python 3.10: an archive that could not be written complains once more when it is forgotten
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_full_disk_leaves_what_can_go_on(words, at_step, tmp_path, capsys):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    at_step(70, lambda _: resource.setrlimit(resource.RLIMIT_FSIZE, (1_000, limits[1])))
    try:
        with pytest.warns(UserWarning, match=r"could not be saved .* the last one is of step 60"):
            assert main(words) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    error = capsys.readouterr().err
    assert error.splitlines()[-1].startswith("regil: [Errno 27] File too large")
    at_step(0, None)
    assert main(["train", "--resume", str(tmp_path / "run"), "--episodes", "2"]) == 0
    assert TD3BC.load(tmp_path / "run" / "model.zip").num_timesteps == 200
