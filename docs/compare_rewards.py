"""The plain guide with one reward against another: one run, and its success.

    python docs/compare_rewards.py drawer-close 0 sdtw runs/drawer-close-0-sdtw

Everything but the reward is preset `plain`: the demonstrator's actions as they are. `progress` has
its pictures moved back (`register`), `sdtw` is the paper's. The demonstration is the scripted
expert's with the run's own seed. Prints one line of JSON: task, seed, reward, and the last policy's
success at 40 unseen goals.
"""

import json
import sys
from contextlib import closing
from pathlib import Path

import numpy as np

from regil_sb3.evaluation import EVALUATION_SEED, evaluate, policy_act
from regil_sb3.recording import record_expert
from regil_sb3.settings import make_settings
from regil_sb3.td3bc import TD3BC
from regil_sb3.training import make_env, train


def main(task: str, seed: int, reward: str, run: Path, steps: int) -> None:
    """Record, train, evaluate; the run folder is left for a closer look."""
    env_id = f"regil/metaworld-{task}-v0"
    overrides = [
        "eval_episodes=10",
        f"reward={reward}",
        f"register={'true' if reward == 'progress' else 'false'}",
    ]
    settings = make_settings(env_id, "plain", seed, steps, overrides)
    train(settings, record_expert(env_id, seed), run)
    with closing(make_env(settings, run / "demo.hdf5", n_envs=1)) as unseen:
        model = TD3BC.load(run / "model.zip", buffer_size=1)
        result = evaluate(policy_act(model), unseen, 40, EVALUATION_SEED)
    success = float(np.mean(result.successes))
    print(json.dumps({"task": task, "seed": seed, "reward": reward, "success": success}))


if __name__ == "__main__":
    steps = int(sys.argv[5]) if len(sys.argv) > 5 else 15_000
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3], Path(sys.argv[4]), steps)
