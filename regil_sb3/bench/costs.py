"""What a step of training is made of, and how that grows: second half of `regil bench throughput`.

* ``Clock`` - seconds of calls within calls, each counted once
* ``costs`` - TD3BC on a task, with the default preset but for what is varied

The sides of the first half take turns; these learn one after the other: on a busy machine look at
how the parts of a row compare, and less at rows.
"""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from regil_wrappers import Demonstration
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.logger import CSVOutputFormat, Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack
from tqdm import tqdm

from regil_sb3.checkpoint import CheckpointCallback, ReplayableEpisode
from regil_sb3.recording import record_expert
from regil_sb3.replay_buffer import FrameReplayBuffer
from regil_sb3.settings import make_settings
from regil_sb3.td3bc import TD3BC

__all__ = ["PARTS", "VARIED", "Clock", "Costs", "costs", "main"]

PARTS = (
    "simulator",
    "rendering",
    "encoding",
    "retrieval",
    "policy",
    "storing",
    "update",
    "logging",
    "rest",
)
VARIED: tuple[Mapping[str, int], ...] = (
    {},
    {"environments": 2},
    {"environments": 4},
    {"environments": 8},
    {"size": 64},
    {"size": 128},
    {"stack": 1},
    {"stack": 3},
    {"buffer": 50_000},
    {"frames": 500},
)
"""Instead of one environment, pictures of 84x84, 2 of them stacked, a replay buffer of 5,000
transitions, and the demonstration as long as it is."""

_BUFFER = 5_000


class Clock:
    """Seconds by name. A call within a call counts for its own name alone."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._open: list[str] = []
        self._since = 0.0

    @contextmanager
    def of(self, name: str) -> Iterator[None]:
        """Count what is done inside for this name."""
        self._turn()
        self._open.append(name)
        try:
            yield
        finally:
            self._turn()
            self._open.pop()

    def watch(self, owner: Any, method: str, name: str) -> None:
        """Count an object's calls of one of its methods for this name."""
        original = getattr(owner, method)

        def watched(*args: Any, **kwargs: Any) -> Any:
            with self.of(name):
                return original(*args, **kwargs)

        setattr(owner, method, watched)

    def _turn(self) -> None:
        now = time.perf_counter()
        if self._open:
            self.seconds[self._open[-1]] += now - self._since
        self._since = now


@dataclass(frozen=True)
class Costs:
    """Of one setting.

    Attributes:
        varied: what was, of `VARIED`.
        frames: of the demonstration.
        steps_per_second: of all environments together.
        parts_ms: ms of each of `PARTS`, a step of one environment.
        transition_bytes: that a transition takes in the replay buffer.
        sb3_bytes: that it takes in SB3's.
        checkpoint_s: seconds that the first checkpoint takes, which writes everything.
    """

    varied: Mapping[str, int]
    frames: int
    steps_per_second: float
    parts_ms: Mapping[str, float]
    transition_bytes: float
    sb3_bytes: float
    checkpoint_s: float


def costs(
    task: str = "button-press", varied: Mapping[str, int] | None = None, steps: int = 250
) -> Costs:
    """Let TD3BC learn, and see where its time goes.

    Args:
        task: of Meta-World.
        varied: of `VARIED`.
        steps: of all environments together that are timed, at least, after the warm-up.
    """
    varied = varied or {}
    n_envs, stack = varied.get("environments", 1), varied.get("stack", 2)
    settings = make_settings(f"regil/metaworld-{task}-v0", "default", 0)
    env_kwargs = {**settings.env_kwargs, **({"size": varied["size"]} if "size" in varied else {})}
    clock = Clock()
    with tempfile.TemporaryDirectory() as folder:
        demo = record_expert(settings.env, 0, env_kwargs)
        if "frames" in varied:
            demo = _slower(demo, varied["frames"])
        demo.save(Path(folder) / "demo.hdf5")

        def make() -> gym.Env[Any, Any]:
            env: gym.Env[Any, Any] = gym.make(settings.env, **env_kwargs)
            for method, name in (
                ("step", "simulator"),
                ("reset", "simulator"),
                ("encoder_frame", "rendering"),
            ):
                clock.watch(env.unwrapped, method, name)
            for wrapper, arguments in settings.wrappers(f"{folder}/demo.hdf5"):
                env = wrapper(env, **arguments)
                clock.watch(env, "step", "retrieval")
                clock.watch(env, "reset", "retrieval")
                clock.watch(env.retriever.encoder, "encode", "encoding")  # type: ignore[attr-defined]
            return ReplayableEpisode(env)

        env: VecEnv = DummyVecEnv([make] * n_envs)
        env = VecFrameStack(env, stack) if stack > 1 else env
        with ExitStack() as closed:
            closed.callback(env.close)
            model = _learner(env, f"{folder}/demo.hdf5", settings.hyperparams, varied, steps)
            log = CSVOutputFormat(f"{folder}/progress.csv")
            closed.callback(log.close)
            model.set_logger(Logger(folder, [log]))
            for owner, method, name in (
                (model, "_sample_action", "policy"),
                (model, "_store_transition", "storing"),
                (model, "train", "update"),
                (model, "dump_logs", "logging"),
            ):
                clock.watch(owner, method, name)
            model.learn(steps)
            while model.in_warmup:  # episodes that the guide has begun are its own to their end
                model.learn(steps, reset_num_timesteps=False)
            clock.seconds.clear()
            before, begun = model.num_timesteps, time.perf_counter()
            with clock.of("rest"):
                model.learn(steps, log_interval=1, reset_num_timesteps=False)
            seconds = time.perf_counter() - begun
            made = model.num_timesteps - before
            buffer = model.replay_buffer
            assert isinstance(buffer, FrameReplayBuffer)
            begun = time.perf_counter()
            checkpoint = CheckpointCallback(f"{folder}/checkpoints", steps=1)
            checkpoint.init_callback(model)
            checkpoint.save()
            saved = time.perf_counter() - begun
            theirs = NStepReplayBuffer(
                16, env.observation_space, env.action_space, "cpu", n_steps=3
            )
            arrays = [v for v in vars(theirs).values() if isinstance(v, np.ndarray)]
            return Costs(
                varied,
                len(demo),
                made / seconds,
                {part: 1e3 * clock.seconds[part] / made for part in PARTS},
                buffer.nbytes / (buffer.buffer_size * n_envs),
                sum(array.nbytes for array in arrays) / 16,
                saved,
            )


def _learner(
    env: VecEnv, demo: str, own: Mapping[str, Any], varied: Mapping[str, int], steps: int
) -> TD3BC:
    """With Q and the BC term on from the end of a warm-up that is as short as can be."""
    settings = {
        **own,
        "warmup_steps": steps // 2,
        "learning_starts": steps // 2,
        "bc_pretrain_steps": 0,
        "bc_schedule": "time",
        "bc_steps": 100 * steps,
        "buffer_size": varied.get("buffer", _BUFFER),
        "seed": 0,
    }
    return TD3BC("CnnPolicy", env, demo=demo, **settings)


def _slower(demo: Demonstration, frames: int) -> Demonstration:
    """The same, shown in so many frames; without its actions' sizes, which nobody replays here."""
    shown = np.linspace(0, len(demo) - 1, frames).round().astype(int)
    assert demo.actions is not None
    return Demonstration(
        demo.frames[shown], demo.actions[shown[:-1].clip(max=len(demo) - 2)], metadata=demo.metadata
    )


def main(task: str = "button-press", steps: int = 250) -> None:
    """Measure all of `VARIED` and print them as markdown."""
    rows = [
        costs(task, varied, steps)
        for varied in tqdm(VARIED, desc="costs", unit="row", dynamic_ncols=True)
    ]
    print(f"| what | steps/s | {' | '.join(PARTS)} (ms a step) | bytes a transition | of SB3's |")
    print("|" + "---|" * (len(PARTS) + 4))
    for row in rows:
        what = ", ".join(f"{value:,} {name}" for name, value in row.varied.items()) or "default"
        parts = " | ".join(f"{row.parts_ms[part]:.2f}" for part in PARTS)
        print(
            f"| {what} | {row.steps_per_second:.1f} | {parts} | {row.transition_bytes:,.0f} "
            f"| {row.transition_bytes / row.sb3_bytes:.3f} |"
        )
    plain = rows[0]
    watched = plain.parts_ms["encoding"] + plain.parts_ms["retrieval"] + plain.parts_ms["logging"]
    share = watched / sum(plain.parts_ms.values())
    print(f"\nencoding, retrieval and logging: {share:.1%} of a step of the default")
    print(f"a first checkpoint: {plain.checkpoint_s:.2f} s")
