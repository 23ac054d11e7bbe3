"""SAC from state vectors, once with our reward and once with the task's own success alone.

python docs/compare_sac.py learn regil|sparse SEED FOLDER    one run, into FOLDER
python docs/compare_sac.py table FOLDER                      its table, and docs/images/sac.png

Settings are those of `zoo_configs/sac.yml`. Meta-World's own reward is dense and knows the state;
the sparse one is 1 at success, which ends the episode, and 0 before. Nothing is rendered for it.
"""

import json
import sys
import time
from pathlib import Path

import gymnasium as gym
import matplotlib as mpl
import numpy as np
import yaml
from regil_wrappers import RetrievalRewardWrapper
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

import regil_sb3  # noqa: F401
from regil_sb3.evaluation import EVALUATION_SEED, SELECTION_SEED, evaluate, policy_act
from regil_sb3.recording import record_expert

mpl.use("Agg")

from matplotlib import pyplot as plt

TASK = "regil/metaworld-drawer-close"
STEPS = 30_000
NAMES = {"regil": "our reward", "sparse": "success alone"}
COLOURS = {"regil": "#d1495b", "sparse": "#3d7ea6"}
ROOT = Path(__file__).parents[1]


class Sparse(gym.Wrapper):
    """1 at success, 0 elsewhere."""

    def step(self, action):
        """Step; the reward is whether the task is solved."""
        observation, _, terminated, truncated, info = self.env.step(action)
        return observation, float(info["is_success"]), terminated, truncated, info


class Curve(BaseCallback):
    """Success of the policy on unseen seeds, as it learns."""

    def __init__(self, env, every=2_500, episodes=20):
        super().__init__()
        self.env, self.every, self.episodes = env, every, episodes
        self.steps, self.success = [], []

    def _on_step(self):
        if self.num_timesteps % self.every == 0:
            done = evaluate(policy_act(self.model), self.env, self.episodes, SELECTION_SEED)
            self.steps.append(self.num_timesteps)
            self.success.append(float(np.mean(done.successes)))
            print(self.num_timesteps, self.success[-1], flush=True)
        return True


def learn(arm, seed, folder, steps=STEPS):
    """One run; its curve and its success on 40 further seeds go to FOLDER/arm-seed.json."""
    sections = yaml.safe_load((ROOT / "zoo_configs" / "sac.yml").read_text(encoding="utf-8"))
    settings = sections[f"{TASK}-state-v0"]
    arguments = settings["env_wrapper"][0]["regil_wrappers.RetrievalRewardWrapper"]
    names = ("learning_rate", "batch_size", "learning_starts")

    def make(reward):
        env = gym.make(f"{TASK}-state-v0")
        if reward == "regil":
            demo = record_expert(f"{TASK}-v0", seed=0)
            env = RetrievalRewardWrapper(env, **{**arguments, "demo": demo})
        return Sparse(env) if reward == "sparse" else env

    plain = DummyVecEnv([lambda: make(None)])  # success needs no pictures
    model = SAC(
        settings["policy"],
        DummyVecEnv([lambda: make(arm)]),
        seed=seed,
        **{name: settings[name] for name in names},
    )
    curve = Curve(plain)
    began = time.perf_counter()
    model.learn(steps, callback=curve)
    minutes = (time.perf_counter() - began) / 60
    last = evaluate(policy_act(model), plain, 40, EVALUATION_SEED)
    result = {
        "arm": arm,
        "seed": seed,
        "steps": curve.steps,
        "success": curve.success,
        "last": float(np.mean(last.successes)),
        "minutes": minutes,
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{arm}-{seed}.json").write_text(json.dumps(result, indent=1))
    print(f"{arm} {seed}: {result['last']:.3f} after {steps} steps, {minutes:.1f} minutes")


def table(folder):
    """Print the table, and draw the curves."""
    runs = [json.loads(path.read_text()) for path in sorted(folder.glob("*-*.json"))]
    print("| reward | seed | 10,000 steps | 20,000 | 30,000 | 40 further goals | minutes |")
    print("|" + "---|" * 7)
    figure, axis = plt.subplots(figsize=(5, 3))
    for run in runs:
        at = dict(zip(run["steps"], run["success"], strict=True))
        cells = [
            NAMES[run["arm"]],
            run["seed"],
            *(f"{at[s]:.2f}" for s in (10_000, 20_000, 30_000)),
        ]
        print(
            "| "
            + " | ".join(map(str, [*cells, f"{run['last']:.3g}", f"{run['minutes']:.1f}"]))
            + " |"
        )
        axis.plot(run["steps"], run["success"], ".-", color=COLOURS[run["arm"]],
                  label=NAMES[run["arm"]] if run["seed"] == 0 else None)  # fmt: skip
    axis.set(xlabel="agent steps (two frames each)", ylabel="success, 20 unseen goals")
    axis.set_ylim(-0.03, 1.03)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(Path(__file__).parent / "images" / "sac.png", dpi=80)


if __name__ == "__main__":
    if sys.argv[1] == "learn":
        learn(sys.argv[2], int(sys.argv[3]), Path(sys.argv[4]), *map(int, sys.argv[5:]))
    else:
        table(Path(sys.argv[2]))
