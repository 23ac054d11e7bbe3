"""Evaluating a run that has learned: what comes of it whatever the folder and the film are like."""

from __future__ import annotations

import dataclasses
import errno
import json
import shutil

import gymnasium as gym
import numpy as np
import pytest
import toy_env
import yaml
from regil_wrappers import Demonstration

from regil_sb3 import run_folder, training
from regil_sb3.cli import main
from regil_sb3.settings import Settings
from regil_sb3.training import evaluate_run, make_env


@pytest.fixture
def run(toy_run, tmp_path):
    """A copy that has not been evaluated."""
    shutil.copytree(toy_run, tmp_path / "run")
    for name in ("evaluation.json", "episode.hdf5"):
        (tmp_path / "run" / name).unlink()
    return tmp_path / "run"


def other_demo(run, **changes):
    """Put another demonstration into a run."""
    demo = Demonstration.load(run / "demo.hdf5")
    metadata = {**demo.metadata, **changes.pop("metadata", {})}
    dataclasses.replace(demo, metadata=metadata, **changes).save(run / "demo.hdf5")


def config(run, change):
    """Change what a run's config.yaml says."""
    said = yaml.safe_load((run / "config.yaml").read_text())
    change(said)
    (run / "config.yaml").write_text(yaml.safe_dump(said))


def test_without_the_policy_there_is_no_film(run):
    found = evaluate_run(run, 1, only=("guide",))
    assert found["guide"]["successes"] == [True]
    assert json.loads((run / "evaluation.json").read_text()) == found
    assert not (run / "episode.hdf5").exists()


def test_the_film_has_the_environments_limits(run):
    """The demonstration's own may be narrower than what a policy does."""
    actions = Demonstration.load(run / "demo.hdf5").actions * np.float32(0.001)
    limits = {"action_low": [-0.001] * 2, "action_high": [0.001] * 2}
    other_demo(run, actions=actions, metadata=limits)
    evaluate_run(run, 1, only=("policy",))
    episode = Demonstration.load(run / "episode.hdf5")
    assert np.abs(episode.actions).max() > 0.001
    assert episode.metadata["action_high"] == [1, 1]


class Rendered(toy_env.ToyReach):
    """Rendered larger than it is observed."""

    def render(self):
        return self.encoder_frame(64)


def test_the_film_has_the_size_that_the_policy_sees(run):
    gym.register("ToyRendered-v0", entry_point=Rendered)
    frames = Demonstration.load(run / "demo.hdf5").frames
    larger = np.array([np.kron(f, np.ones((4, 4, 1), np.uint8))[::3, ::3] for f in frames])
    assert larger.shape[1:] == (64, 64, 3)
    other_demo(run, frames=larger, metadata={"image_size": None})

    def rendered(said):
        said["env"] = "ToyRendered-v0"
        for wrapper in said["env_wrapper"]:
            next(iter(wrapper.values()))["image"] = "render"

    config(run, rendered)
    evaluate_run(run, 1, only=("policy",))
    gym.registry.pop("ToyRendered-v0")
    assert Demonstration.load(run / "episode.hdf5").metadata["image_size"] == [48, 48]


def test_a_film_that_does_not_fit_costs_the_film_alone(run, capsys):
    (run / "episode.hdf5").mkdir()
    found = evaluate_run(run, 1, only=("policy",))
    assert json.loads((run / "evaluation.json").read_text()) == found
    assert "episode.hdf5 is not saved: " in capsys.readouterr().err


def full(*_, **__):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_folder_in_which_nothing_can_be_written_is_said_first(run, monkeypatch, capsys):
    monkeypatch.setattr(run_folder.tempfile, "TemporaryFile", full)
    monkeypatch.setattr(training, "evaluate", None)
    assert main(["evaluate", str(run), "--episodes", "1"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"nothing can be written in {run} (No space left on device)" in line


def test_a_disk_that_is_full_at_the_end_costs_the_files_alone(run, monkeypatch, capsys):
    """Methods are evaluated, and printed, whichever of their files cannot be written."""
    (run / "bc_model.zip").unlink()
    monkeypatch.setattr(training, "BC_UPDATES", 3)
    monkeypatch.setattr(training, "replacing", full)
    monkeypatch.setattr(run_folder, "replacing", full)
    assert main(["evaluate", str(run), "--episodes", "1"]) == 2
    said = capsys.readouterr()
    assert "BC on the demo" in said.out
    assert "bc_model.zip is not saved: " in said.err
    assert said.err.splitlines()[-1].startswith(f"regil: {run}/evaluation.json is not saved: ")
    assert not (run / "evaluation.json").exists()


def with_encoder(run, encoder, wrapper="regil_wrappers.RetrievalRewardWrapper"):
    """Let the config name an encoder, in a wrapper more."""
    config(run, lambda said: said["env_wrapper"].append({wrapper: {"encoder": encoder}}))


@pytest.mark.parametrize("wrapper", ["RetrievalRewardWrapper", "wrappers.RetrievalGuideWrapper"])
@pytest.mark.parametrize("encoder", ["subprocess:call?args=touch,{}", "torchscript:{}"])
def test_code_that_a_config_names_is_not_run(encoder, wrapper, run, tmp_path, capsys):
    encoder = encoder.format(tmp_path / "executed")
    with_encoder(run, encoder, f"regil_wrappers.{wrapper}")
    assert main(["evaluate", str(run), "--episodes", "1"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert encoder in line
    assert "--trust" in line
    with pytest.raises(ValueError, match=r"trust=True \(--trust\)"):
        make_env(Settings.load(run / "config.yaml"), run / "demo.hdf5", n_envs=1)  # as the card has
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize(
    ("wrapper", "arguments"),
    [
        ("regil_wrappers.formats.fuzz.run", {"module": "run.evil"}),
        ("gymnasium.wrappers.RecordVideo", {"video_folder": "films"}),
    ],
)
def test_wrappers_of_a_downloaded_config_are_ours(wrapper, arguments, run, tmp_path, capsys):
    (run / "evil.py").write_text(f"open({str(tmp_path / 'executed')!r}, 'w')\n")
    config(run, lambda said: said["env_wrapper"].append({wrapper: arguments}))
    assert main(["evaluate", str(run), "--episodes", "1"]) == 2
    assert f"names code to run, wrapper '{wrapper}'" in capsys.readouterr().err
    with pytest.raises(ValueError, match="trust=True"):
        Settings.load(run / "config.yaml")
    trusted = Settings.load(run / "config.yaml", trust=True)
    if "fuzz" in wrapper:
        with pytest.raises(ValueError, match=r"fuzz\.run' is no gymnasium\.Wrapper"):
            trusted.wrappers("demo.hdf5")
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"algo": "sac"}, "algo 'sac' is not known here; it was made by"),
        ({"frame_stack": None}, "frame_stack is None"),
        ({"hyperparams": 3}, "hyperparams is 3"),
    ],
)
def test_a_config_of_another_version_gets_one_line(change, said, run, capsys):
    config(run, lambda own: own.update(change))
    for words in (["evaluate", str(run), "--episodes", "1"], ["train", "--resume", str(run)]):
        assert main(words) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert said in line


def test_a_damaged_calibration_gets_one_line(run, capsys):
    (run / "calibration.json").write_text("[" * 200_000)
    with pytest.raises(ValueError, match="is damaged"):
        run_folder.load_calibration(None, run / "calibration.json")


@pytest.mark.parametrize("module", ["run.evil", "evil"])
def test_a_downloaded_environment_is_not_imported(module, run, tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(run if module == "evil" else tmp_path)
    (run / "evil.py").write_text("raise SystemExit('executed')\n")
    config(run, lambda said: said.update(env=f"{module}:ToyReach-v0"))
    assert main(["evaluate", str(run), "--episodes", "1"]) == 2
    assert f"names code to run, environment '{module}:T" in capsys.readouterr().err
    for own in ("toy_env:ToyReach-v0", "nowhere:ToyReach-v0", ":ToyReach-v0"):
        config(run, lambda said, own=own: said.update(env=own))
        assert Settings.load(run / "config.yaml").env == own


def test_encoders_of_ones_own_are_run(words, monkeypatch, tmp_path):
    monkeypatch.setattr(training, "BC_UPDATES", 3)
    run, named = tmp_path / "run", "toy_encoder:grey"
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "toy_encoder.py").write_text(
        "class Grey:\n    def encode(self, frames):\n"
        "        return frames.mean((2, 3), dtype='float32')\n\n\n"
        "def grey():\n    return Grey()\n"
    )
    assert main([*words, "--set", f"encoder={named}"]) == 0
    assert main(["evaluate", str(run), "--episodes", "1"]) == 2
    assert main(["evaluate", str(run), "--episodes", "1", "--trust"]) == 0
    for name in ("model.zip", "progress.csv"):  # as if it had been killed early
        (run / name).unlink()
    assert main(["train", "--resume", str(run), "--episodes", "1"]) == 0
