"""What goes wrong in silence while a policy learns, said once each, with its number.

* ``Watch`` - a callback for any algorithm of Stable-Baselines3; `regil train` always uses it
* ``require_finite_parameters`` - no model that is spoilt is saved over a good one
"""

from __future__ import annotations

import json
import sys
import threading
import time
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecFrameStack, unwrap_vec_wrapper
from tqdm import tqdm

from regil_sb3.report.run_contents import read_warnings

__all__ = ["Watch", "require_finite_parameters"]

_Q_FACTOR = 3.0  # |Q| may be so many times what rewards and gamma allow
_PARAMETERS_EVERY = 100  # steps


class Watch(BaseCallback):
    """Says in one line each, and once, what makes learning fail without an error.

    * the retrieval reward has been the same at every step of ``episodes`` episodes
    * the guide has not succeeded in its first ``guided`` episodes
    * the warm-up has ended, and the success buffer holds the demonstration alone
    * Q is far above what rewards, their scale and gamma allow: it diverges
    * an environment's observation has not changed for ``frozen`` steps, though the actions have
    * an environment has not answered for ``hung`` seconds; where it stands is named. Nothing is
      ended: it may be a person who is putting a scene in order

    What a model does not have (a guide, a success buffer) is not watched. Rewards, observations and
    parameters that are not finite end learning.

    Example:
        >>> import gymnasium as gym
        >>> from stable_baselines3 import SAC
        >>> from regil_sb3.watch import Watch
        >>> model = SAC("MlpPolicy", gym.make("Pendulum-v1"), buffer_size=100, learning_starts=10)
        >>> watch = Watch()
        >>> _ = model.learn(30, watch)
        >>> watch.said
        {}

    Args:
        file: of JSON lines, where warnings are kept; those that it holds are not said again.
        episodes: see above.
        guided: see above.
        frozen: see above.
        hung: see above.

    Attributes:
        said: the warnings by their kind.

    Raises:
        FloatingPointError: from ``learn``: a reward, an observation or a parameter is not finite.
    """

    def __init__(
        self,
        file: Path | None = None,
        episodes: int = 10,
        guided: int = 20,
        frozen: int = 100,
        hung: float = 120.0,
    ) -> None:
        super().__init__()
        if min(episodes, guided, frozen) < 1 or hung <= 0:
            raise ValueError(
                f"episodes={episodes}, guided={guided}, frozen={frozen}, hung={hung}: "
                "they must be positive"
            )
        self.file = file
        self.episodes, self.guided, self.frozen, self.hung = episodes, guided, frozen, hung
        self.said = {str(w["kind"]): str(w["text"]) for w in read_warnings(file)} if file else {}
        self._low, self._high, self._episodes = np.inf, -np.inf, 0
        self._guided = self._succeeded = 0
        self._largest = 0.0  # |reward|, scaled as it is learned from
        self._before: Any = None  # actions and observations
        # by environment: steps without change, and since the episode began
        self._same: npt.NDArray[Any] = np.zeros(0, int)
        self._age: npt.NDArray[Any] = np.zeros(0, int)
        self._stacked = 1  # frames in an observation; those before an episode are black
        self._checked_at = 0
        self._ended: threading.Event | None = None

    def _on_training_start(self) -> None:
        self._before = None
        self._same, self._age = np.zeros((2, self.training_env.num_envs), int)
        stacking = unwrap_vec_wrapper(self.training_env, VecFrameStack)
        self._stacked = stacking.stacked_obs.n_stack if isinstance(stacking, VecFrameStack) else 1
        self._checked_at = self.num_timesteps
        self._ended = threading.Event()
        learner = threading.get_ident()
        threading.Thread(
            target=self._watch_environments, args=(learner, self._ended), daemon=True
        ).start()

    def close(self) -> None:
        """Stop watching; done at the end of ``learn``."""
        if self._ended is not None:
            self._ended.set()

    def _on_training_end(self) -> None:
        self.close()

    def _on_rollout_start(self) -> None:
        if self.num_timesteps - self._checked_at >= _PARAMETERS_EVERY:
            self._checked_at = self.num_timesteps
            require_finite_parameters(self.model)
            self._watch_q()
        model: Any = self.model
        if (
            "success_buffer" not in self.said
            and getattr(model, "warmup_steps", 0) > 0
            and self.num_timesteps >= model.warmup_steps
            and not model.in_warmup
            and model.success_buffer.episodes <= (model.demo is not None)
        ):
            self._say(
                "success_buffer",
                f"no episode of the warm-up's {model.warmup_steps} steps was a success: the "
                "success buffer holds the demonstration alone; `regil doctor` says why a guide "
                "fails, and a longer warm-up may help",
                model.success_buffer.episodes,
            )

    def _on_step(self) -> bool:
        seen = self.locals.get("new_obs")
        rewards, dones, infos = (self.locals.get(n) for n in ("rewards", "dones", "infos"))
        if seen is None or rewards is None or dones is None or infos is None:
            return True  # what learns from a demonstration alone
        self._require_finite(rewards, seen)
        self._watch_rewards(rewards, dones, infos)
        if hasattr(self.model, "_collection"):
            self._watch_guide(dones, infos)
        if "frozen" not in self.said and "actions" in self.locals:
            self._watch_observations(np.asarray(self.locals["actions"]), seen, dones)
        return True

    # -- what is watched -------------------------------------------------------------------------

    def _require_finite(self, rewards: Any, seen: Any) -> None:
        values = seen if isinstance(seen, dict) else {"observation": seen}
        for name, value in {**values, "reward": rewards}.items():
            bad = ~np.isfinite(value).reshape(len(rewards), -1).all(axis=1)
            if bad.any():
                raise FloatingPointError(
                    f"{name} of environment {int(bad.argmax())} is not finite at step "
                    f"{self.num_timesteps}: training stopped, the model saved last is untouched; "
                    "mend the environment or its reward"
                )

    def _watch_rewards(self, rewards: Any, dones: Any, infos: Any) -> None:
        buffer: Any = getattr(self.model, "replay_buffer", None)
        factor = getattr(self.model, "used_reward_scale", 1.0)
        for reward, done, info in zip(rewards, dones, infos, strict=True):
            if "retrieval" not in info:
                continue
            late = info["retrieval"].get("episode_rewards")
            if late is None and hasattr(buffer, "scale"):
                continue  # what is known at the episode's end alone
            scale = factor
            values = np.asarray(reward if late is None else late, float)
            if late is not None and getattr(buffer, "scale", None):
                scale = factor * buffer.scale
            self._largest = max(self._largest, float(np.abs(values).max()) * scale)
            self._low = min(self._low, float(values.min()))
            self._high = max(self._high, float(values.max()))
            self._episodes += bool(done)
        if self._episodes >= self.episodes and self._high - self._low <= 1e-9 * abs(self._high):
            self._say(
                "reward",
                f"the retrieval reward was {self._high:g} at every step of {self._episodes} "
                "episodes, so nothing can be learned from it: look at demonstration and encoder "
                "with `regil doctor`",
                self._high,
            )

    def _watch_guide(self, dones: Any, infos: Any) -> None:
        episodes: Any = self.model._collection  # type: ignore[attr-defined]
        for i in np.flatnonzero(dones):
            if not episodes.guided[i] or episodes.calibrating(i):
                continue
            self._guided += 1
            self._succeeded += bool(episodes.succeeded[i] or infos[i].get("is_success", False))
        if self._guided >= self.guided and not self._succeeded:
            self._say(
                "guide",
                f"the guide has not succeeded in its first {self._guided} episodes: "
                "`regil doctor` says why a guide fails",
                self._guided,
            )

    def _watch_q(self) -> None:
        gamma = float(getattr(self.model, "gamma", 1.0))
        q = self.logger.name_to_value.get("train/q")
        if q is None or gamma >= 1 or not self._largest:
            return
        allowed = self._largest / (1.0 - gamma)
        if abs(q) > _Q_FACTOR * allowed + 1.0:
            self._say(
                "q",
                f"Q is {q:.3g}, and rewards of at most {self._largest:.3g} (scaled) with gamma "
                f"{gamma:g} allow {allowed:.3g}: it diverges; a lower learning_rate or more "
                "n_steps may help",
                float(q),
            )

    def _watch_observations(self, actions: npt.NDArray[Any], seen: Any, dones: Any) -> None:
        now = seen if isinstance(seen, dict) else {"": seen}
        before, self._before = self._before, (actions.copy(), {k: v.copy() for k, v in now.items()})
        if before is None:
            return
        self._age = np.where(dones, 0, self._age + 1)
        for i in np.flatnonzero(self._age >= self._stacked):
            acted = not np.array_equal(actions[i], before[0][i])
            changed = any(not np.array_equal(now[k][i], before[1][k][i]) for k in now)
            self._same[i] = 0 if changed else self._same[i] + acted
            if self._same[i] >= self.frozen:
                self._say(
                    "frozen",
                    f"the observation of environment {i} has not changed for {self._same[i]} "
                    "steps, though the actions have: its camera or simulator stands still",
                    int(self._same[i]),
                )

    def _watch_environments(self, learner: int, ended: threading.Event) -> None:
        """From a thread: how long one call of an environment has been under way."""
        held: FrameType | None = None  # kept, so that no other call can be taken for it
        since = time.monotonic()
        while not ended.wait(min(1.0, self.hung / 4)):
            innermost = sys._current_frames().get(learner)
            call = _environments_call(innermost)
            if call is not held:
                held, since = call, time.monotonic()
            seconds = time.monotonic() - since
            if call is not None and innermost is not None and seconds >= self.hung:
                code = innermost.f_code
                self._say(
                    "hung",
                    f"an environment has not answered for {seconds:.0f} s: it stands in "
                    f"{code.co_name}, {code.co_filename}:{innermost.f_lineno}; Ctrl-C ends "
                    "training, and --resume goes on from the last checkpoint",
                    round(seconds, 1),
                )
            del innermost, call

    # -- what is said ----------------------------------------------------------------------------

    def _say(self, kind: str, text: str, value: float) -> None:
        if kind in self.said:
            return
        self.said[kind] = text
        line = {"step": self.num_timesteps, "kind": kind, "value": value, "text": text}
        kept = ""
        if self.file is not None:
            try:
                with self.file.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(line) + "\n")
            except OSError as error:
                kept = f" (not kept: {error})"
        tqdm.write(f"warning at step {self.num_timesteps}: {text}{kept}", file=sys.stderr)


def require_finite_parameters(model: BaseAlgorithm) -> None:
    """Refuse a model that is spoilt.

    Raises:
        FloatingPointError: a parameter is not finite.
    """
    for name, values in model.policy.named_parameters():
        if not bool(th.isfinite(values).all()):
            raise FloatingPointError(
                f"parameter {name} is not finite at step {model.num_timesteps}: training stopped, "
                "the model saved last is untouched; a lower learning_rate may help"
            )


def _environments_call(frame: FrameType | None) -> FrameType | None:
    """The outermost call of a vector environment that a thread is in."""
    found = None
    while frame is not None:
        code = frame.f_code
        if code.co_name in ("step_wait", "reset", "env_method") and "vec_env" in code.co_filename:
            found = frame
        frame = frame.f_back
    return found
