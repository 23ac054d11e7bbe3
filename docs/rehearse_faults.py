"""Faults injected into the rehearsal robot in real time: how soon its arm stands still.

    python docs/rehearse_faults.py [ROUNDS]

prints a line of JSON for each fault: milliseconds until the arm was held, from the fault and from
the moment that the watchdog could know of it (its limits: ``Patience``), how far the hand went, and
why the episode ended; then how many episodes were begun and how many are on disk.
"""

from __future__ import annotations

import json
import resource
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
from regil_wrappers import Demonstration

from regil_sb3.envs.rehearsal import RehearsalEnv
from regil_sb3.robots.interfaces import RobotError

PERIOD = 1 / 30
KNOWN = {  # periods until the watchdog can know it, from the fault
    "camera stalls": 3.0,
    "frame freezes": 4.0,
    "arm is silent": 2.0,
    "late step": 3.0,
}
KINDS = (
    *("camera dies", "camera stalls", "frame freezes", "arm is silent", "arm error"),
    *("operator aborts", "late step", "disk full"),
)


class Operator:
    """Aborts when told to."""

    stop = False

    def succeeded(self) -> bool:
        return False

    def aborted(self) -> bool:
        return self.stop

    def paused(self) -> bool:
        return False

    def ready(self, message: str) -> None:
        self.stop = False


def full_disk(full: bool) -> None:
    """No file may grow beyond 20 kB: what a write to a full disk does to h5py."""
    most = 20_000 if full else resource.RLIM_INFINITY
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))


def main(rounds: int) -> None:
    """Inject, and print."""
    warnings.simplefilter("ignore")
    rng = np.random.default_rng(0)
    operator = Operator()
    begun = 0
    with tempfile.TemporaryDirectory() as folder:
        env = RehearsalEnv("reach", real_time=True, record_to=folder, operator=operator)
        for n in range(rounds):
            for kind in KINDS:
                env.reset(seed=n)
                begun += 1
                for _ in range(int(rng.integers(5, 20))):
                    env.step(to_and_fro(rng))
                where, at = env.robot.arm.state().position, time.monotonic()
                if kind == "disk full":
                    full_disk(True)
                    for _ in range(200):  # the episode's end is when it is written
                        if env.step(to_and_fro(rng))[3]:
                            break
                elif kind == "operator aborts":
                    operator.stop = True
                elif kind != "late step":
                    env.robot.inject(kind)
                info: dict[str, object] = {}
                if kind == "late step":
                    time.sleep(6 * PERIOD)
                if kind == "disk full":
                    where, at = env.robot.arm.state().position, time.monotonic()
                    try:
                        env.reset(seed=n)
                    except RobotError as error:
                        info["fault"] = str(error).replace(folder, "FOLDER")
                    full_disk(False)
                while "fault" not in info:
                    *_, info = env.step(to_and_fro(rng))
                time.sleep(2 * PERIOD)
                where_now, held = env.robot.arm.state().position, env.robot.truth["held"]
                if kind == "arm is silent":  # what it did by itself, it says when it answers again
                    env.robot.arm.recover()
                    time.sleep(PERIOD)
                    where_now, held = env.robot.arm.state().position, env.robot.truth["alone"]
                after = None if held is None else held - at
                print(
                    json.dumps(
                        {
                            "fault": kind,
                            "stopped_ms": after and round(1000 * after, 1),
                            "since_known_ms": after
                            and round(1000 * (after - KNOWN.get(kind, 0) * PERIOD), 1),
                            "why": info["fault"],
                            "hand_cm": round(
                                100 * float(np.linalg.norm(where_now - where)),
                                1,
                            ),
                        }
                    ),
                    flush=True,
                )
        env.close()
        files = sorted(Path(folder).glob("*.hdf5"))
        lengths = [len(Demonstration.load(file)) for file in files]
        print(json.dumps({"begun": begun, "on_disk": len(files), "frames": sum(lengths)}))


def to_and_fro(rng: np.random.Generator) -> np.ndarray:
    """A policy that moves all the time."""
    return np.array([*rng.uniform(-1, 1, 2), rng.uniform(-0.3, 0.3), 1], np.float32)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
