"""TD3BC whose updates run beside the robot: the control loop never waits for a gradient.

* ``BackgroundTD3BC`` - collects in the calling thread, learns in another
* ``paused`` - an environment that holds still meanwhile
* ``at_rest`` - a model that does not change meanwhile
"""

from __future__ import annotations

import contextlib
import copy
import os
import queue
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import VecEnv

from regil_sb3.policies import copy_tensors
from regil_sb3.td3bc import TD3BC

__all__ = ["BackgroundTD3BC", "at_rest", "paused"]

SelfBackground = TypeVar("SelfBackground", bound="BackgroundTD3BC")

_HAND_OVER = 5  # updates between two copies of the policy that acts
_POLITE = 10  # nice value of the learner's thread: control goes first
_SWITCH = 0.0005  # s that a thread waits for Python's lock before it asks for it


@contextmanager
def paused(env: VecEnv) -> Iterator[None]:
    """Robots among these environments hold still, and no step of theirs is late, meanwhile."""
    can = env.has_attr("pause")
    if can:
        env.env_method("pause")
    try:
        yield
    finally:
        if can:
            env.env_method("resume")


class BackgroundTD3BC(TD3BC):
    """TD3BC that learns in a thread of its own while `learn`'s thread controls a robot.

    Each environment step owes the updates that ``gradient_steps`` says; the learner pays when it
    can, between and during episodes, and `learn` returns when nothing is owed. A copy of the policy
    acts, renewed every few updates. The replay buffer is the learner's alone: transitions reach it
    by a queue. Torch computes without Python's lock, and the learner's thread has a lower priority,
    so that control hardly notices it (``docs/robot.md`` has the figures).

    The robot is paused while the updates by behaviour cloning run at the end of the warm-up. Runs
    are not reproducible: how far the learner is when an action is chosen depends on the machine.

    Arguments, and what is saved, are those of `TD3BC`. A checkpoint is saved between two updates,
    the robot paused, and holds what is still owed, too.

    Example:
        >>> from regil_sb3.background import BackgroundTD3BC
        >>> model = BackgroundTD3BC("CnnPolicy", env, demo=demo, warmup_steps=1_000)
        >>> model.learn(8_000)
    """

    _acting: Any = None
    _learner: threading.Thread | None = None
    _own_logger: Logger | None = None
    _owed = 0  # updates
    _left = False  # by an error

    @property
    def logger(self) -> Logger:
        """The log; the learner's thread has its own, which `dump_logs` takes over."""
        if threading.current_thread() is self._learner and self._own_logger is not None:
            return self._own_logger
        return super().logger

    def learn(
        self: SelfBackground,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "TD3BC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfBackground:
        """Learn for ``total_timesteps`` transitions; returns when all their updates are done.

        Raises:
            Exception: whatever the learner's thread died of.
        """
        self._inbox: queue.SimpleQueue[tuple[Any, ...]] = queue.SimpleQueue()
        self._failure: BaseException | None = None
        self._turn = threading.Condition()
        self._ends = self._busy = self._left = False
        self._held = True  # until learn is set up: a checkpoint may have left updates owed
        self._own_logger = Logger(None, [])
        self._copies = [copy.deepcopy(self.policy) for _ in range(2)]
        self._acting = self._copies[0]
        self._learner = threading.Thread(target=self._learn_on, name="learner", daemon=True)
        interval = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH)
        self._learner.start()
        try:
            super().learn(
                total_timesteps,
                callback,
                log_interval,
                tb_log_name,
                reset_num_timesteps,
                progress_bar,
            )
        except BaseException:
            self._owed, self._left = 0, True  # who interrupts does not want to wait
            raise
        finally:
            assert self.env is not None
            with paused(self.env):
                with self._turn:
                    self._ends = True
                    self._turn.notify_all()
                self._learner.join()
            self._owed = 0  # a learner that failed left some
            sys.setswitchinterval(interval)
            self._learner = self._acting = None
            self._copies = []
        self._raise_failure()
        return self

    def predict(self, *args: Any, **kwargs: Any) -> Any:
        """The policy's action; while it learns, that of the copy that acts."""
        acting = self._acting
        return (
            super().predict(*args, **kwargs) if acting is None else acting.predict(*args, **kwargs)
        )

    def train(self, gradient_steps: int | float, batch_size: int = 64) -> None:
        """Owe so many updates; wait, the robot paused, for those at the end of the warm-up."""
        if threading.current_thread() is self._learner or self._learner is None:
            super().train(gradient_steps, batch_size)
            return
        due = self._number_of_updates(gradient_steps)
        with self._turn:
            self._owed += due
            self._held = False
            self._turn.notify_all()
        self._raise_failure()
        if not self.pretrained and not self.in_warmup and self.num_timesteps >= self.warmup_steps:
            assert self.env is not None
            with paused(self.env), self._turn:
                self._owed = max(self._owed, 1)
                self._turn.notify_all()
                self._turn.wait_for(lambda: self.pretrained or self._failure is not None)
            self._raise_failure()

    def pretrain_bc(
        self, steps: int, progress: Callable[[int], None] | None = None, before: int = 0
    ) -> float:
        """As `TD3BC.pretrain_bc`; in the learner's thread it ends where `learn` is left."""

        def go_on(done: int) -> None:
            if self._left:
                raise RuntimeError(f"learn was left after {done} of {steps} updates by cloning")
            if progress is not None:
                progress(done)

        its_own = threading.current_thread() is self._learner
        return super().pretrain_bc(steps, go_on if its_own else progress, before)

    @contextmanager
    def held(self) -> Iterator[None]:
        """The learner rests between two updates and all transitions are in the replay buffer.

        Robots are paused meanwhile. For the thread that called `learn`; elsewhen nothing is to do.

        Raises:
            Exception: whatever the learner's thread died of.
        """
        if self._learner is None:
            yield
            return
        assert self.env is not None
        with paused(self.env), self._turn:
            self._held = True
            try:
                self._turn.wait_for(lambda: not self._busy)
                self._raise_failure()
                self._empty_inbox()
                yield
            finally:
                self._held = False
                self._turn.notify_all()

    def dump_logs(self) -> None:
        """Write log data, the learner's too."""
        if self._own_logger is not None:
            for name, value in self._own_logger.name_to_value.copy().items():
                self.logger.record(name, value)
            self.logger.record("train/updates_owed", self._owed)
        super().dump_logs()

    def _store_transition(
        self,
        replay_buffer: Any,
        buffer_action: npt.NDArray[Any],
        new_obs: Any,
        reward: npt.NDArray[Any],
        dones: npt.NDArray[np.bool_],
        infos: list[dict[str, Any]],
    ) -> None:
        to: Any = _Inbox(self._inbox)
        super()._store_transition(to, buffer_action, new_obs, reward, dones, infos)

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure

    # -- the learner's thread --------------------------------------------------------------------

    def _learn_on(self) -> None:
        # Linux gives threads priorities of their own; elsewhere they all have the process's
        with contextlib.suppress(OSError, AttributeError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _POLITE)
        try:
            while self._wait_for_work():
                self._empty_inbox()
                self.train(1, self.batch_size)
                with self._turn:
                    self._owed = max(self._owed - 1, 0)
                    self._turn.notify_all()
                if self._n_updates % _HAND_OVER == 0 or not self._owed:
                    self._hand_over()
        except BaseException as error:  # handed to the thread that called learn
            with self._turn:
                self._failure = error
                self._turn.notify_all()
        finally:
            self._empty_inbox()
            with self._turn:
                self._busy = False
                self._turn.notify_all()

    def _wait_for_work(self) -> bool:
        """Whether there is an update to do; False when `learn` is over and all are done."""
        with self._turn:
            self._busy = False
            self._turn.notify_all()
            self._turn.wait_for(lambda: (self._owed > 0 and not self._held) or self._ends)
            self._busy = self._owed > 0
            return self._busy

    def _empty_inbox(self) -> None:
        assert self.replay_buffer is not None
        while not self._inbox.empty():
            self.replay_buffer.add(*self._inbox.get())

    def _hand_over(self) -> None:
        """Let a copy of the policy act that is as new as can be."""
        spare = self._copies[self._copies[0] is self._acting]
        copy_tensors(self.policy.parameters(), spare.parameters())
        copy_tensors(self.policy.buffers(), spare.buffers())
        self._acting = spare

    def _excluded_save_params(self) -> list[str]:
        ours = ("_acting", "_learner", "_own_logger", "_inbox", "_turn", "_copies", "_failure")
        return [*super()._excluded_save_params(), *ours, "_owed", "_left"]


def at_rest(model: Any) -> AbstractContextManager[None]:
    """A model does not learn meanwhile, whichever it is: `BackgroundTD3BC.held`."""
    return model.held() if isinstance(model, BackgroundTD3BC) else contextlib.nullcontext()


class _Inbox:
    """What the collecting thread takes for the replay buffer."""

    def __init__(self, inbox: queue.SimpleQueue[tuple[Any, ...]]) -> None:
        self._inbox = inbox

    def add(self, *transition: Any) -> None:
        self._inbox.put(transition)
