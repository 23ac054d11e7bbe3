"""A run folder without a run: films of a square, a log of straight lines."""

from __future__ import annotations

import csv
import json

import numpy as np
import yaml
from regil_wrappers import Demonstration

from regil_sb3.report.success_films import save_films
from regil_sb3.success_buffer import SuccessBuffer


def film(length, tint, **metadata):
    """A bright square that moves to the right over a fixed background."""
    frames = np.full((length, 36, 36, 3), 40, np.uint8)
    frames[:, ::2] += np.uint8(tint)
    for t in range(length):
        x = 28 * t // length
        frames[t, 10:18, x : x + 8] = 180 + t % 70
    actions = np.zeros((length - 1, 4), np.float32)
    return Demonstration(frames, actions=actions, metadata={"control_rate": 40, **metadata})


def buffer_of(episodes):
    """A success buffer, the first episode pinned."""
    buffer = SuccessBuffer(10_000, n_stack=2)
    for i in range(episodes):
        frames = np.moveaxis(film(20 + i, 0).frames, -1, 1)
        stacked = np.concatenate([np.zeros_like(frames), frames], axis=1)
        buffer.add(stacked, np.zeros((20 + i, 4), np.float32), pinned=i == 0)
    return buffer


def _row(step, best):
    return {
        "time/total_timesteps": step,
        "time/guided": int(step <= 4000),
        "rollout/success_rate": step / 20_000,
        "rollout/retrieval_reward": -200 + step / 100,
        "rollout/env_reward": step / 50,
        "eval/success_rate": best * step / 15_000 if step % 5000 == 0 else "",
        "train/bc_coef": 2 - step / 8000,
        "success_buffer/steps": step / 3,
        "success_buffer/episodes": step // 300,
    }


def _result(solved):
    successes = [i < solved for i in range(20)]
    return {"success": solved / 20, "episodes": 20, "successes": successes}


def run(
    folder, env="regil/metaworld-button-press-v0", seed=0, solved=19, films=True, **hyperparams
):
    """Write one; 20 episodes, of which the policy solved so many."""
    folder.mkdir(parents=True)
    config = {
        "env": env,
        "seed": seed,
        "encoder": "pixels",
        "k": 3,
        "horizon": 4,
        "env_wrapper": [{"regil_wrappers.RetrievalRewardWrapper": {"reward": "progress"}}],
        "hyperparams": {"bc_coef": 2.0, **hyperparams},
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    with (folder / "progress.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, _row(0, 0))
        writer.writeheader()
        writer.writerows(_row(step, solved / 20) for step in range(500, 15_001, 500))
    evaluation = {
        "steps": 15_000,
        "frames": 30_000,
        "seeds": list(range(1_000_000, 1_000_020)),
        "policy": _result(solved),
        "guide": _result(5),
        "bc": _result(6),
    }
    (folder / "evaluation.json").write_text(json.dumps(evaluation))
    if films:
        film(30, 0).save(folder / "demo.hdf5")
        film(40, 6, success=True, seed=1_000_000).save(folder / "episode.hdf5")
        save_films(buffer_of(5), folder / "success_buffer.npz")
    return folder
