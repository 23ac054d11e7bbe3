"""rl_zoo3's own command with our YAML, and the launcher with TD3BC."""

from __future__ import annotations

import inspect
import json
import os
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import optuna
import pytest
import yaml
from matplotlib import pyplot as plt
from stable_baselines3.common.monitor import load_results
from toy_env import ToyReach

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


PPO = "ToyReach-v0: {n_timesteps: 8, policy: MlpPolicy, n_steps: 8, batch_size: 8}"


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


SEARCHED = {
    *("learning_rate", "batch_size", "gamma", "tau", "gradient_steps", "policy_delay"),
    *("bc_coef", "bc_floor", "bc_schedule", "bc_pretrain_steps", "exploration_std"),
}
SMALLER = {
    "sac": ["learning_starts:10"],
    "tqc": ["learning_starts:10", "callback:[{'regil_sb3.GuidedWarmup': {'steps': 15}}]"],
    "td3": ["learning_starts:10"],
    "ppo": ["n_envs:2", "n_steps:8"],
}


def words_of(algo):
    """A run of our YAML in seconds, with one evaluation."""
    return ["--algo", algo, "--env", STATE, "--conf-file", str(CONFIGS / f"{algo}.yml"), "-n", "36",
            "--eval-freq", "30", "--eval-episodes", "1", "--env-kwargs", "max_steps:20",
            "-f", "logs", "-params", "batch_size:8", *SMALLER[algo]]  # fmt: skip


@pytest.fixture(scope="module")
def stock(folder):
    """Runs of `python -m rl_zoo3.train`, in one process that knows nothing of our launcher."""
    code = (
        "import json, runpy, sys\n"
        "for words in json.load(sys.stdin):\n"
        "    sys.argv = ['rl_zoo3.train', *words]\n"
        "    runpy.run_module('rl_zoo3.train', run_name='__main__')\n"
        "assert 'regil_sb3.zoo' not in sys.modules"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        input=json.dumps([words_of(algo) for algo in SMALLER]),
        cwd=folder,
        env=os.environ | {"PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder / "logs"


@pytest.mark.parametrize("algo", SMALLER)
def test_the_stock_command_learns_with_our_yaml(algo, stock):
    name = STATE.replace("/", "-")
    run = stock / algo / f"{name}_1"
    assert (run / f"{name}.zip").stat().st_size > 0
    assert (run / "best_model.zip").stat().st_size > 0
    with np.load(run / "evaluations.npz") as evaluations:
        # our reward is never above 0, Meta-World's own never below: the wrappers are there
        assert (evaluations["results"] < 0).all()
        assert evaluations["timesteps"].tolist() == [30]
    assert "is_success" in (run / "0.monitor.csv").read_text()


@pytest.mark.parametrize("algo", SMALLER)
def test_the_launcher_runs_other_algorithms(algo, folder, monkeypatch, tmp_path):
    monkeypatch.chdir(folder)
    words = [*words_of(algo), "-f", str(tmp_path)]
    assert zoo.main(["train", *words, "--eval-freq", "-1"]) == 0
    assert list(tmp_path.rglob(f"{STATE.replace('/', '-')}.zip"))


@pytest.mark.parametrize(
    ("said", "seen"),
    [([], [False, False]), (["--eval-env-kwargs", "frozen:True"], [True, False])],
)
@pytest.mark.parametrize("algo", ["td3bc", "ppo"])
def test_evaluation_environments_get_the_env_kwargs(algo, said, seen, tiny, monkeypatch):
    common, _ = tiny
    if algo == "ppo":
        Path("td3bc.yml").write_text(PPO)
    sections = yaml.safe_load(Path("td3bc.yml").read_text())
    sections["ToyReach-v0"]["env_kwargs"] = {"frozen": False}
    Path("td3bc.yml").write_text(yaml.safe_dump(sections))
    made = []
    init = ToyReach.__init__

    def noted(self, *args, **kwargs):
        made.append(kwargs["frozen"])
        init(self, *args, **kwargs)

    monkeypatch.setattr(ToyReach, "__init__", noted)
    words = [*common, "--algo", algo, "--eval-freq", "50", "-n", "8", *said]
    assert zoo.main(["train", *words]) == 0
    assert made == seen  # for evaluation, for training


def test_stopped_and_resumed(tiny, monkeypatch, capsys):
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
    assert "--save-replay-buffer" not in capsys.readouterr().err  # nothing is missing
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


@pytest.mark.parametrize(
    ("obs", "missing"),
    [("pixels", "success_buffer.npz and no replay_buffer.npz"),
     ("state", "success_buffer.npz and no replay_buffer.pkl")],
)  # fmt: skip
def test_going_on_without_buffers_is_said(obs, missing, tiny, capsys):
    common, _ = tiny
    if obs == "state":
        words = ["record", "ToyReach-v0", "-o", "state.hdf5", "--env-kwargs", "obs=state"]
        assert regil(words) == 0
        section = yaml.safe_load(Path("td3bc.yml").read_text())["ToyReach-v0"]
        del section["frame_stack"]
        seen = {"demo": "state.hdf5", "image": "render"}
        wrappers = [{name: seen for name in wrapper} for wrapper in section["env_wrapper"]]
        section |= {"policy": "MlpPolicy", "demo": "state.hdf5", "env_wrapper": wrappers}
        section["env_kwargs"] = {"obs": "state", "render_mode": "rgb_array"}
        Path("td3bc.yml").write_text(yaml.safe_dump({"ToyReach-v0": section}))
    assert zoo.main(["train", *common, "-n", "35"]) == 0
    run, name = run_of("ToyReach-v0")
    capsys.readouterr()
    assert zoo.main(["train", *common, "-n", "5", "-i", str(run / f"{name}.zip")]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"regil_sb3.zoo: {run} has no {missing}: ")
    assert "--save-replay-buffer" in line


def curves_of(figure):
    return plt.figure(figure).axes[0].lines


# rl_zoo3's drawing with older pandas
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
def test_plots_of_runs(tiny, monkeypatch):
    common, _ = tiny
    few = ["-n", "65", "--eval-freq", "30", "--eval-episodes", "2"]
    assert all(zoo.main(["train", *common, *few, "--seed", seed]) == 0 for seed in ("1", "2"))
    runs = [run_of("ToyReach-v0", number)[0] for number in (1, 2)]
    monkeypatch.setattr(plt, "show", lambda: None)
    of = ["-e", "ToyReach-v0", "-f", "logs"]
    try:
        assert zoo.main(["plot", "-a", "td3bc", *of, "-y", "success", "-w", "1"]) == 0
        assert [curve.get_ydata().tolist() for curve in curves_of("Training Success Rate")] == [
            load_results(run)["is_success"].tolist() for run in runs
        ]
        assert zoo.main(["all_plots", "-a", "td3bc", *of, "-o", "results", "--no-display"]) == 0
        plt.close("all")
        assert zoo.main(["plot_from_file", "-i", "results"]) == 0
        (curve,) = curves_of("Results ToyReach-v0")
        results = [np.load(run / "evaluations.npz")["results"] for run in runs]
        assert curve.get_ydata() == pytest.approx(np.mean(results, axis=(0, 2)))
    finally:
        plt.close("all")


WORKER = """
import os, time
from pathlib import Path
import gymnasium as gym
import toy_env

class Meeting(toy_env.ToyReach):
    def step(self, action):  # as a trial does: it waits until the other worker is in one, too
        Path("met").mkdir(exist_ok=True)
        Path(f"met/{os.getpid()}").touch()
        end = time.monotonic() + 120
        while len(list(Path("met").iterdir())) < 2:
            assert time.monotonic() < end, "the other worker never came"
            time.sleep(0.02)
        return super().step(action)

gym.register("Meeting-v0", entry_point=Meeting)
"""


def test_two_workers_on_one_storage(tiny):
    """Two processes, each with a trial open while the other has one."""
    Path("worker.py").write_text(WORKER)
    Path("td3bc.yml").write_text(Path("td3bc.yml").read_text().replace("ToyReach", "Meeting"))
    words = ["train", "--algo", "td3bc", "--env", "Meeting-v0", "--gym-packages", "worker",
             "--conf-file", "td3bc.yml", "--eval-freq", "-1", "-f", "logs", "-n", "30",
             "-optimize", "--n-trials", "1", "--n-evaluations", "2", "--eval-episodes", "1",
             "--storage", "logs/study.log", "--study-name", "toy", "--no-optim-plots",
             "--optimization-log-path", "trials", "-params", "warmup_steps:1000"]  # fmt: skip
    paths = [os.getcwd(), ROOT / "tests/wrappers", os.environ.get("PYTHONPATH", "")]
    workers = [
        subprocess.Popen(
            [sys.executable, "-m", "regil_sb3.zoo", *words, "--seed", seed],
            env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths))},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for seed in ("1", "2")
    ]
    try:
        for worker in workers:
            _, error = worker.communicate(timeout=200)
            assert worker.returncode == 0, error
    finally:
        for worker in workers:
            worker.kill()
    storage = optuna.storages.JournalStorage(
        optuna.storages.journal.JournalFileBackend("logs/study.log")
    )
    trials = optuna.load_study(study_name="toy", storage=storage).trials
    assert len(trials) == 2
    assert max(t.datetime_start for t in trials) < min(t.datetime_complete for t in trials)
    for trial in trials:
        assert trial.state == optuna.trial.TrialState.COMPLETE
        assert trial.value <= 0  # our reward, and not the environment's own
        with np.load(f"trials/trial_{trial.number}/evaluations.npz") as evaluations:
            assert trial.value == evaluations["results"][-1].mean()


def test_the_search_space_fits_td3bc():
    """What makes a task easier or a run longer is not in it: demo, wrappers, warm-up, steps."""
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    defaults = {n: p.default for n, p in inspect.signature(zoo.TD3BC).parameters.items()}
    for _ in range(50):
        trial = study.ask()
        sampled = zoo.sample_td3bc(trial, 4, 1, {})
        assert zoo.convert_td3bc(trial.params) == sampled
        assert sampled.keys() == SEARCHED
        check_arguments(defaults | sampled)


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yml")), ids=lambda path: path.stem)
def test_no_yaml_of_ours_is_evaluated(path):
    sections = yaml.safe_load(path.read_text(encoding="utf-8"))
    for name, section in sections.items():
        assert not [key for key in zoo.EVALUATED if isinstance(section.get(key), str)], name


@pytest.mark.parametrize(
    ("given", "made"),
    [
        ("toy_env.Named", ["Named"]),
        ({"toy_env.Named": {"word": "said"}}, ["Named said"]),
        (["toy_env.Named", {"toy_env.Named": {"word": "said"}}], ["Named", "Named said"]),
        (None, []),
    ],
)
def test_env_wrapper_is_text_a_mapping_or_a_list(given, made, tiny, monkeypatch):
    seen = []

    class Named(gym.Wrapper):
        def __init__(self, env, word=""):
            super().__init__(env)
            seen.append(f"Named {word}".strip())

    monkeypatch.setattr("toy_env.Named", Named, raising=False)
    file = Path("td3bc.yml")
    section = yaml.safe_load(file.read_text())
    section["ToyReach-v0"] |= {"env_wrapper": given, "warmup_steps": 0, "n_timesteps": 5}
    file.write_text(yaml.safe_dump(section))
    assert zoo.main(["train", *tiny[0]]) == 0
    assert seen == made
    folder, _ = run_of("ToyReach-v0")
    assert list(folder.glob("*.monitor.csv"))


def test_text_that_would_be_evaluated_is_refused(tiny, capsys):
    common, _ = tiny
    with Path("td3bc.yml").open("a") as file:
        file.write("  policy_kwargs: \"__import__('os').mkdir('evaluated')\"\n")
    assert zoo.main(["train", *common]) == 2
    error = capsys.readouterr().err.strip()
    assert "would be evaluated as Python" in error
    assert len(error.splitlines()) == 1
    assert not Path("evaluated").exists()


def test_a_section_without_steps_is_named(tiny, capsys):
    common, _ = tiny
    section = Path("td3bc.yml")
    section.write_text(section.read_text().replace("  n_timesteps: 60\n", ""))
    assert zoo.main(["train", *common]) == 2
    error = capsys.readouterr().err.strip()
    assert error.endswith(
        "ToyReach-v0: its section of the YAML file has no n_timesteps: add it, or say -n STEPS"
    )


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
