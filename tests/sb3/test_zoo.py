"""rl_zoo3's own command with our YAML, and the launcher with TD3BC."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import optuna
import pytest
import yaml

from regil_sb3 import zoo
from regil_sb3.arguments import check_arguments
from regil_sb3.cli import main as regil

ROOT = Path(__file__).parents[2]
CONFIGS = ROOT / "zoo_configs"
STATE = "regil/metaworld-drawer-close-state-v0"
TINY = """
ToyReach-v0:
  n_timesteps: 60
  policy: CnnPolicy
  demo: {demo}
  frame_stack: 2
  learning_starts: 10
  batch_size: 4
  buffer_size: 300
  warmup_steps: 30
  bc_pretrain_steps: 2
  env_wrapper:
    - regil_wrappers.RetrievalGuideWrapper: {{demo: {demo}}}
    - regil_wrappers.RetrievalRewardWrapper: {{demo: {demo}}}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where demonstrations lie that our YAML names."""
    path = tmp_path_factory.mktemp("zoo")
    out = path / f"demos/{STATE.rpartition('/')[2]}.hdf5"
    assert regil(["record", STATE, "-o", str(out)]) == 0
    return path


@pytest.fixture
def tiny(demo_path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("td3bc.yml").write_text(TINY.format(demo=demo_path))
    words = ["--algo", "td3bc", "--env", "ToyReach-v0"]
    return [*words, "--conf-file", "td3bc.yml", "--eval-freq", "-1", "-f", "logs"], words


def run_of(env, number=1, algo="td3bc"):
    name = env.replace("/", "-")
    return Path("logs") / algo / f"{name}_{number}", name


def test_the_stock_command_learns_with_our_yaml(folder):
    done = subprocess.run(
        [sys.executable, "-m", "rl_zoo3.train", "--algo", "sac", "--env", STATE,
         "--conf-file", str(CONFIGS / "sac.yml"), "-n", "110", "--eval-freq", "60",
         "--eval-episodes", "1", "-f", "logs", "-params", "learning_starts:50", "batch_size:8"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}"},
        capture_output=True,
        text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    run = folder / "logs" / "sac" / f"{STATE.replace('/', '-')}_1"
    assert (run / "best_model.zip").stat().st_size > 0
    with np.load(run / "evaluations.npz") as evaluations:
        # our reward is never above 0, Meta-World's own never below: the wrappers are there
        assert (evaluations["results"] < 0).all()
        assert evaluations["timesteps"].tolist() == [60]
    assert "is_success" in (run / "0.monitor.csv").read_text()


@pytest.mark.parametrize(
    ("algo", "smaller"),
    [
        ("tqc", ["learning_starts:30", "callback:[{'regil_sb3.GuidedWarmup': {'steps': 40}}]"]),
        ("td3", ["learning_starts:30"]),
        ("ppo", ["n_envs:2", "n_steps:16"]),
    ],
)
def test_other_algorithms_learn_with_our_yaml(algo, smaller, folder, monkeypatch, tmp_path):
    monkeypatch.chdir(folder)
    words = ["train", "--algo", algo, "--env", STATE, "--conf-file", str(CONFIGS / f"{algo}.yml")]
    few = ["-n", "60", "--eval-freq", "-1", "-f", str(tmp_path)]
    assert zoo.main([*words, *few, "-params", "batch_size:8", *smaller]) == 0
    assert list(tmp_path.rglob(f"{STATE.replace('/', '-')}.zip"))


def test_stopped_and_resumed(tiny, monkeypatch):
    common, names = tiny

    def interrupt(self):
        if self.num_timesteps == 45:
            raise KeyboardInterrupt
        return True

    with monkeypatch.context() as patch:
        patch.setattr(zoo._KeepCalibration, "_on_step", interrupt)
        assert zoo.main(["train", *common, "--save-replay-buffer"]) == 0
    first, name = run_of("ToyReach-v0")
    stopped = zoo.GoingOn.load(first / f"{name}.zip")
    assert stopped.num_timesteps == 45
    assert stopped.pretrained

    guided = []
    act = zoo.GoingOn._sample_action

    def watch(self, *args):
        guided.append(self.in_warmup)
        return act(self, *args)

    monkeypatch.setattr(zoo.GoingOn, "_sample_action", watch)
    again = [*common, "--save-replay-buffer", "-n", "20", "-i", str(first / f"{name}.zip")]
    assert zoo.main(["train", *again]) == 0
    second, _ = run_of("ToyReach-v0", 2)
    assert zoo.GoingOn.load(second / f"{name}.zip").num_timesteps == 65
    assert guided == [False] * 20  # no second warm-up
    for buffer in ("success_buffer.npz", "replay_buffer.npz"):
        with np.load(first / buffer) as old, np.load(second / buffer) as new:
            assert old.files
            assert old.keys() <= new.keys()
    with (
        np.load(first / "success_buffer.npz") as old,
        np.load(second / "success_buffer.npz") as new,
    ):
        assert all(np.array_equal(old[name], new[name]) for name in old.files if "/" in name)
    with np.load(first / "replay_buffer.npz") as old, np.load(second / "replay_buffer.npz") as new:
        assert len(old["actions"]) == 44  # the last step was interrupted
        assert len(new["actions"]) == 64
        assert np.array_equal(new["actions"][:44], old["actions"])

    assert zoo.main(["enjoy", *names, "-f", "logs", "-n", "20", "--no-render"]) == 0
    assert zoo.main(["record_video", *names, "-f", "logs", "-n", "10", "-o", "video"]) == 0
    assert next(Path("video").glob("*.mp4")).stat().st_size > 0


@pytest.mark.filterwarnings("ignore:Argument ``multivariate``")  # rl_zoo3's; Optuna 3 warns
def test_two_workers_on_one_storage(tiny):
    common, _ = tiny
    search = ["-optimize", "--n-trials", "1", "--n-evaluations", "2", "--eval-episodes", "1",
              "--storage", "logs/study.log", "--study-name", "toy", "--no-optim-plots",
              "--optimization-log-path", "trials",
              "-params", "warmup_steps:1000"]  # fmt: skip
    for seed in ("1", "2"):
        assert zoo.main(["train", *common, *search, "-n", "30", "--seed", seed]) == 0
    storage = optuna.storages.JournalStorage(
        optuna.storages.journal.JournalFileBackend("logs/study.log")
    )
    trials = optuna.load_study(study_name="toy", storage=storage).trials
    assert len(trials) == 2
    for trial in trials:
        assert trial.state == optuna.trial.TrialState.COMPLETE
        assert trial.value <= 0  # our reward, and not the environment's own
        with np.load(f"trials/trial_{trial.number}/evaluations.npz") as evaluations:
            assert trial.value == evaluations["results"][-1].mean()


def test_the_search_space_fits_td3bc():
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    defaults = {n: p.default for n, p in inspect.signature(zoo.TD3BC).parameters.items()}
    for _ in range(50):
        trial = study.ask()
        sampled = zoo.sample_td3bc(trial, 4, 1, {})
        assert zoo.convert_td3bc(trial.params) == sampled
        assert sampled.keys() <= defaults.keys()
        check_arguments(defaults | sampled)


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yml")), ids=lambda path: path.stem)
def test_no_yaml_of_ours_is_evaluated(path):
    sections = yaml.safe_load(path.read_text(encoding="utf-8"))
    for name, section in sections.items():
        assert not [key for key in zoo.EVALUATED if isinstance(section.get(key), str)], name


def test_text_that_would_be_evaluated_is_refused(tiny, capsys):
    common, _ = tiny
    with Path("td3bc.yml").open("a") as file:
        file.write("  policy_kwargs: \"__import__('os').mkdir('evaluated')\"\n")
    assert zoo.main(["train", *common]) == 2
    error = capsys.readouterr().err.strip()
    assert "would be evaluated as Python" in error
    assert len(error.splitlines()) == 1
    assert not Path("evaluated").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "use one of train, enjoy"),
        (["fly"], "'fly' is no command"),
        (["train", "--algo", "td3bc", "--env", "regil/metaworld-fly-v0"], "not found"),
        (["enjoy", "--algo", "td3bc", "--env", "ToyReach-v0", "-f", "nowhere"], "nowhere"),
    ],
)
def test_bad_input_is_one_line_and_status_2(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert zoo.main(words) == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert len(error.splitlines()) == 1


def test_custom_envs_registers_our_environments():
    done = subprocess.run(
        [sys.executable, "-c", f"import custom_envs, gymnasium; gymnasium.spec({STATE!r})"],
        cwd=ROOT,
        check=False,
    )
    assert done.returncode == 0
