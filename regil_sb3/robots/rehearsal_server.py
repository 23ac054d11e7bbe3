"""The process of the rehearsal robot: physics, camera and arm, on the wire as a real one's.

Started by ``rehearsal.Rehearsal``, with a socket to talk through. In real time it lives by the
system's clock; in lock step time passes when it is told so.
"""

from __future__ import annotations

import heapq
import itertools
import sys
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import numpy.typing as npt

from regil_sb3.robots.rehearsal_scene import RATE, TASKS, Scene

__all__ = ["FAULTS", "Disturbances"]

FAULTS = ("camera dies", "camera stalls", "frame freezes", "arm is silent", "arm error")
"""What can be injected; ``recover`` of camera or arm ends it."""

_STATES = 120.0  # Hz, of the arm's states
_SILENCE = 0.066  # s without a command after which the arm holds still by itself


@dataclass(frozen=True)
class Disturbances:
    """What a real camera does and a simulated one does not.

    Args:
        latency: seconds from taking a picture to its arrival.
        jitter: std of that, in seconds.
        dropped: share of pictures that never arrive.
        duplicated: share of pictures that come again in place of the next.
        lighting: the lamps are up to this share brighter or darker, anew in each episode.
    """

    latency: float = 0.01
    jitter: float = 0.0
    dropped: float = 0.0
    duplicated: float = 0.0
    lighting: float = 0.0

    def __post_init__(self) -> None:
        """Validate."""
        for name in ("latency", "jitter", "dropped", "duplicated", "lighting"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)!r}: it must lie in [0, 1)")


class Server:
    """The robot's side of the wire.

    Args:
        scene: the world.
        rate: pictures a second.
        disturbances: of the camera.
        start: what time it is.
    """

    def __init__(self, scene: Scene, rate: float, disturbances: Disturbances, start: float) -> None:
        self._scene, self._rate, self._disturbances = scene, rate, disturbances
        self._rng = np.random.default_rng(0)
        self._start, self._ticks = start, 0  # of the physics
        self._pictures, self._states = 0, 0
        self._mail: list[tuple[float, int, Any]] = []  # pictures under way
        self._numbers = itertools.count()
        self._frozen: npt.NDArray[np.uint8] | None = None
        self._last: npt.NDArray[np.uint8] | None = None
        self._faults: set[str] = set()
        self._held: float | None = start  # since when the arm holds still
        self._heard = start
        self._alone: float | None = None  # when it last held still by itself

    @property
    def now(self) -> float:
        """The world's time."""
        return self._start + self._ticks / RATE

    def obey(self, order: tuple[Any, ...], now: float) -> None:
        """Do what the other side asks."""
        kind, *rest = order
        if kind == "reset":
            hand, off, light, seed = rest
            self._rng = np.random.default_rng(seed)
            here = self._scene.hand if hand is None else hand
            self._scene.reset(here, off, light)
        elif kind == "inject":
            self._faults |= {rest[0]}
            if rest[0] == "arm error":
                self._hold(now)
        elif kind == "recover camera":
            self._faults -= {"camera dies", "camera stalls", "frame freezes"}
        elif "arm is silent" in self._faults and kind != "recover arm":
            return
        elif kind == "recover arm":
            self._faults -= {"arm is silent", "arm error"}
            self._held, self._heard = None, now
        elif kind == "stop":
            self._hold(now)
        elif kind == "move" and self._held is None:
            self._heard = now
            self._scene.command(rest[0], rest[1])

    def _hold(self, now: float) -> None:
        if self._held is None:
            self._held = now
            self._scene.command(self._scene.hand, self._scene.closed)

    def advance(self, until: float) -> list[tuple[Any, ...]]:
        """Let time pass; what arrives at the other side meanwhile."""
        out: list[tuple[Any, ...]] = []
        while self.now + 1 / RATE <= until + 1e-9:
            self._scene.step()
            self._ticks += 1
            now = self.now
            if self._held is None and now - self._heard > _SILENCE:
                # Nobody is there: it stays where it is, and goes on when it is told to move
                self._scene.command(self._scene.hand, self._scene.closed)
                self._heard, self._alone = np.inf, now
            if now >= self._start + self._states / _STATES:
                self._states += 1
                if "arm is silent" not in self._faults:
                    out.append(self._state(now))
            if now >= self._start + self._pictures / self._rate:
                self._pictures += 1
                self._take_picture(now)
        while self._mail and self._mail[0][0] <= until:
            out.append(heapq.heappop(self._mail)[2])
        return out

    def _state(self, now: float) -> tuple[Any, ...]:
        scene = self._scene
        error = "reflex: collision detected" if "arm error" in self._faults else None
        truth = {
            "solved": scene.solved,
            "target": scene.target,
            "lid": scene.lid,
            "speed": scene.speed,
            "held": self._held,
            "alone": self._alone,
        }
        return "state", scene.hand, scene.closed, now, error, truth

    def _take_picture(self, now: float) -> None:
        ours = self._disturbances
        arrives = now + max(ours.latency + ours.jitter * self._rng.normal(), 0.0)
        if "camera dies" in self._faults:
            self._post(now, ("camera gone", "camera: it was unplugged"))
            return
        if "camera stalls" in self._faults or self._rng.random() < ours.dropped:
            return
        again = self._rng.random() < ours.duplicated and self._last is not None
        if "frame freezes" not in self._faults and not again:
            self._last = self._scene.draw()
        assert self._last is not None
        self._post(arrives, ("picture", self._last, now))

    def _post(self, arrives: float, message: tuple[Any, ...]) -> None:
        heapq.heappush(self._mail, (arrives, next(self._numbers), message))


def serve(
    connection: Connection,
    task: str,
    size: int,
    rate: float,
    disturbances: Disturbances,
    real_time: bool,
) -> None:
    """Serve until the other side is gone."""
    scene = Scene(task, size)
    scene.draw()  # the first picture takes long
    start = time.monotonic() if real_time else 0.0
    server = Server(scene, rate, disturbances, start)
    connection.send(("ready", start))
    try:
        while True:
            if real_time:
                # A physics step's time, and so many as have passed meanwhile
                while connection.poll(1 / RATE):
                    server.obey(connection.recv(), time.monotonic())
                for message in server.advance(time.monotonic()):
                    connection.send(message)
            else:
                order = connection.recv()
                if order[0] == "advance":
                    for message in server.advance(order[1]):
                        connection.send(message)
                    connection.send(("done",))
                else:
                    server.obey(order, server.now)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the other side is gone, and with it the reason to be here
    finally:
        scene.close()


def main() -> None:
    """Serve what the command line says: see ``rehearsal.Rehearsal``."""
    descriptor, task, size, rate, real_time, *numbers = sys.argv[1:]
    assert task in TASKS
    serve(
        Connection(int(descriptor)),
        task,
        int(size),
        float(rate),
        Disturbances(*map(float, numbers)),
        real_time == "1",
    )


if __name__ == "__main__":
    main()
