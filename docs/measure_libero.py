"""The paper's six LIBERO tasks: what a step costs, and how often the scripted expert succeeds.

    python docs/measure_libero.py [EPISODES]

Prints the table of docs/libero.md: processor time on one core, and the expert's successes at the
first of LIBERO's initial states.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from regil_sb3.envs import EVALUATION_SEEDS
from regil_sb3.envs.libero import LiberoEnv
from regil_sb3.envs.libero_tasks import SHORT_LIBERO_TASKS


def milliseconds(call: Callable[[], object], n: int = 10) -> float:
    """Processor time of one call."""
    start = time.process_time()
    for _ in range(n):
        call()
    return 1000 * (time.process_time() - start) / n


def main(episodes: int) -> None:
    """Measure and print, task by task."""
    print("| task | expert solved | its steps, median | reset (ms) | step (ms) | frame (ms) |")
    print("|---|---|---|---|---|---|", flush=True)
    still = np.zeros(7, np.float32)
    for task in SHORT_LIBERO_TASKS:
        env = LiberoEnv(task, obs="state")
        steps = []
        for seed in range(EVALUATION_SEEDS, EVALUATION_SEEDS + episodes):
            env.reset(seed=seed)
            n, terminated, truncated = 0, False, False
            while not (terminated or truncated):
                _, _, terminated, truncated, _ = env.step(env.expert_action())
                n += 1
            steps += [n] * terminated
        env.encoder_frame(128)  # the first one makes a context
        costs = (
            milliseconds(env.reset, 3),
            milliseconds(partial(env.step, still)),
            milliseconds(partial(env.encoder_frame, 128)),
        )
        length = f"{np.median(steps):.0f}" if steps else "-"
        cells = " | ".join(f"{cost:.0f}" for cost in costs)
        print(f"| {task} | {len(steps)} of {episodes} | {length} | {cells} |", flush=True)
        env.close()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
