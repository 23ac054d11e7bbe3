"""The rehearsal robot in real time, learning at 30 Hz: how regular its control is.

    python docs/rehearse_control.py TASK MINUTES [SEED]

prints steps, missed deadlines, the times of the control step (an observation to its action) and of
the period, as ``docs/robot.md`` shows them, and the learner's memory, minute by minute. The
demonstration is recorded first.
"""

from __future__ import annotations

import json
import sys
import tempfile
import warnings

import gymnasium as gym
import psutil
from regil_wrappers import RetrievalGuideWrapper, RetrievalRewardWrapper
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from regil_sb3 import process
from regil_sb3.background import BackgroundTD3BC
from regil_sb3.recording import record_expert


class Memory(BaseCallback):
    """MB of this process, once a minute of control, and how far the run is."""

    def _on_training_start(self):
        self.megabytes, self.robot = [], self.training_env.unwrapped.envs[0].unwrapped

    def _on_step(self):
        if self.n_calls % (60 * 30) == 0:
            self.megabytes.append(round(psutil.Process().memory_info().rss / 1e6))
            now = {"minute": len(self.megabytes), "updates": self.model._n_updates}
            print(json.dumps({**now, **self.robot.times.summary()}), file=sys.stderr, flush=True)
        return True


def main(task: str, minutes: float, seed: int = 0) -> None:
    """Learn in real time, and print how it went."""
    process.keep_freed_memory()
    process.set_threads()
    name = f"regil/rehearsal-{task}-v0"
    demo = record_expert(name, env_kwargs={"random_object": False})
    with tempfile.TemporaryDirectory() as folder:
        env = gym.make(name, real_time=True, jitter=0.003, dropped=0.01, record_to=folder)
        robot = env.unwrapped
        env = RetrievalGuideWrapper(
            env, demo=demo, register=True, correction="servo", disturbance=0.4
        )
        env = RetrievalRewardWrapper(env, demo=demo, register=True, reward="progress")
        envs = VecFrameStack(DummyVecEnv([lambda: Monitor(env)]), 2)
        steps = int(minutes * 60 * 30)
        model = BackgroundTD3BC(
            "CnnPolicy",
            envs,
            demo=demo,
            warmup_steps=1_000,
            actor_in_warmup=False,
            bc_pretrain_steps=2_000,
            bc_schedule="success",
            bc_floor=0.5,
            keep_own_successes=True,
            policy_kwargs={"shared_encoder": False, "q_trains_encoder": False},
            seed=seed,
        )
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model.learn(steps, memory := Memory())
        faults = sorted({str(w.message) for w in caught if "stopped" in str(w.message)})
        out = {
            **robot.times.summary(),
            "updates": model._n_updates,
            "success_buffer": model.success_buffer.steps,
            "recent_success": model.ep_success_buffer and sum(model.ep_success_buffer),
            "episodes": len(model.ep_success_buffer),
            "faults": faults,
            "megabytes": memory.megabytes,
        }
        envs.close()
        print(json.dumps(out))


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), *map(int, sys.argv[3:]))
