"""Training steps a second beside SB3's own algorithms: first half of `regil bench throughput`.

TD3BC with its BC term on, SB3's TD3 and SB3's SAC learn with the same encoder, heads, batch and
updates a step, each on an environment of its own, all with the default preset's wrappers. They take
turns in blocks of steps.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack
from tqdm import tqdm

from regil_sb3.bench import costs
from regil_sb3.bench.timing import Timed
from regil_sb3.policies import ConvEncoder
from regil_sb3.recording import record_expert
from regil_sb3.settings import Settings, make_settings
from regil_sb3.td3bc import TD3BC

__all__ = ["Row", "main", "throughput"]

BUFFER = 5_000  # transitions


@dataclass(frozen=True)
class Row:
    """One algorithm.

    Attributes:
        what: its name.
        steps_per_second: while it learns, episodes' beginnings included; median over blocks.
        ratio: of that to the first row's.
        environment_ms: simulator and rendering, a step.
        retrieval_ms: both retrieval wrappers, a step.
        update_ms: gradient steps, a step of the environment.
        rest_ms: everything else: acting, storing, logging.
    """

    what: str
    steps_per_second: float
    ratio: float
    environment_ms: float
    retrieval_ms: float
    update_ms: float
    rest_ms: float


class _Side:
    """An algorithm on its own environment, and where its time goes: [inside, outside, update]."""

    def __init__(
        self,
        make: Callable[[VecEnv], OffPolicyAlgorithm],
        settings: Settings,
        demo: Path,
    ) -> None:
        self.inside = Timed(gym.make(settings.env, **settings.env_kwargs))
        wrapped: gym.Env[Any, Any] = self.inside
        for wrapper, arguments in settings.wrappers(str(demo)):
            wrapped = wrapper(wrapped, **arguments)
        self.outside = Timed(wrapped)
        self.env = VecFrameStack(DummyVecEnv([lambda: self.outside]), settings.frame_stack)
        self.model: Any = make(self.env)
        self.model.set_logger(Logger(None, []))
        self._update = 0.0
        train = self.model.train

        def timed(*args: Any, **kwargs: Any) -> None:
            begun = time.perf_counter()
            train(*args, **kwargs)
            self._update += time.perf_counter() - begun

        self.model.train = timed  # type: ignore[method-assign]

    def close(self) -> None:
        self.env.close()

    def learn(self, steps: int) -> list[float]:
        """Seconds of so many steps: all, environment, environment and wrappers, updates."""
        before = np.array([self.inside.seconds, self.outside.seconds, self._update])
        begun = time.perf_counter()
        self.model.learn(steps, log_interval=1_000, reset_num_timesteps=False)
        total = time.perf_counter() - begun
        parts = np.array([self.inside.seconds, self.outside.seconds, self._update]) - before
        return [total, *parts.tolist()]


def throughput(
    task: str = "button-press", blocks: int = 8, steps: int = 125, seed: int = 0, starts: int = 100
) -> list[Row]:
    """Let TD3BC, SB3's TD3 and SB3's SAC learn in turns.

    Args:
        task: of Meta-World.
        blocks: how often they take turns.
        steps: environment steps in a turn.
        seed: of environments and networks.
        starts: steps before the first update; twice as many are not timed.

    Raises:
        ValueError: no such task.
    """
    settings = make_settings(f"regil/metaworld-{task}-v0", "default", seed)
    encoder: dict[str, Any] = {"features_extractor_class": ConvEncoder, "net_arch": [256, 256]}
    shared: dict[str, Any] = {
        "buffer_size": BUFFER,
        "learning_starts": starts,
        "batch_size": 64,
        "learning_rate": 3e-4,
        "n_steps": 3,
        "seed": seed,
    }
    own = {n: v for n, v in settings.hyperparams.items() if n not in shared}
    own |= {"warmup_steps": starts, "bc_pretrain_steps": 0, "bc_schedule": "time"}
    own |= {"bc_steps": 10 * blocks * steps}  # so that neither Q nor BC is off

    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        demo = Path(folder) / "demo.hdf5"
        record_expert(settings.env, seed).save(demo)
        makers: dict[str, Callable[[VecEnv], OffPolicyAlgorithm]] = {
            "SB3 TD3": lambda env: TD3(
                "CnnPolicy", env, train_freq=2, policy_kwargs=encoder, **shared
            ),
            "SB3 SAC": lambda env: SAC(
                "CnnPolicy", env, train_freq=2, policy_kwargs=encoder, **shared
            ),
            "TD3BC": lambda env: TD3BC(
                "CnnPolicy", env, demo=str(demo), gradient_steps=0.5, **shared, **own
            ),
        }
        sides = [
            stack.enter_context(closing(_Side(make, settings, demo))) for make in makers.values()
        ]
        for side in sides:
            side.learn(2 * starts)  # and the guide's calibration
        seconds = np.empty((len(sides), blocks, 4))
        turns = [(block, i) for block in range(blocks) for i in range(len(sides))]
        for block, i in tqdm(turns, desc="throughput", unit="turn", dynamic_ncols=True):
            seconds[i, block] = sides[i].learn(steps)

    rows = []
    rates = steps / np.median(seconds[:, :, 0], axis=1)
    for name, rate, mean in zip(makers, rates, seconds.mean(axis=1), strict=True):
        total, environment, wrapped, update = 1e3 * mean / steps
        rows.append(
            Row(
                name,
                float(rate),
                float(rate / rates[0]),
                environment,
                wrapped - environment,
                update,
                total - wrapped - update,
            )
        )
    return rows


def main(task: str = "button-press", **options: Any) -> None:
    """Measure both tables, and print them as markdown."""
    rows = throughput(task, **options)
    print("| algorithm | steps/s | ratio | environment | retrieval | update | rest (ms a step) |")
    print("|---|---|---|---|---|---|---|")
    for r in rows:
        parts = (r.environment_ms, r.retrieval_ms, r.update_ms, r.rest_ms)
        print(
            f"| {r.what} | {r.steps_per_second:.1f} | {r.ratio:.2f} | "
            + " | ".join(f"{part:.2f}" for part in parts)
            + " |"
        )
    print()
    costs.main(task)
