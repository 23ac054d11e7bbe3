"""What a person steers with: keyboard, gamepad, SpaceMouse.

* ``Device`` - what each says: how the hand shall move, and commands
* ``Keyboard``, ``Gamepad``, ``SpaceMouse``
* ``make_device`` - one by name
* ``Axes`` - which dimensions of an action that moves
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

__all__ = [
    "DEVICES",
    "Axes",
    "Command",
    "Device",
    "Gamepad",
    "Keyboard",
    "SpaceMouse",
    "import_pygame",
    "make_device",
]

Floats = npt.NDArray[np.float64]
Command = Literal["gripper", "wait", "success", "undo", "again", "turn", "quit"]
DEVICES = ("keyboard", "gamepad", "spacemouse")

_FINE = 0.25  # of a full action
_DEAD = 0.12  # of a stick's or a SpaceMouse's way is no wish to move


def import_pygame() -> Any:
    """The pygame package.

    Raises:
        ImportError: of one line, if it is not installed.
    """
    try:
        return import_module("pygame")
    except ImportError as error:
        raise ImportError(
            f"steering by hand needs pygame ({error}): pip install 'regil-sb3[teleop]'"
        ) from error


class Device(Protocol):
    """What a person steers with."""

    @property
    def help(self) -> tuple[tuple[str, str], ...]:
        """(what to press, what it does)."""
        ...

    def handle(self, event: Any) -> Iterator[Command]:
        """Take a pygame event; the commands that it gives."""
        ...

    def poll(self) -> Iterator[Command]:
        """Commands that come as no event, asked once a step."""
        ...

    def motion(self) -> Floats:
        """(6,) in [-1, 1]: right, away, up, and turns about these."""
        ...

    def close(self) -> None:
        """Free it."""
        ...


class Keyboard:
    """Keys: each moves by a whole action while it is down, with Shift by a quarter."""

    help = (
        ("arrow keys", "left, right, away, towards you"),
        ("W S", "up, down"),
        ("I K, J L, U O", "turn the hand, where it can be turned"),
        ("Shift", "slowly"),
    )

    def __init__(self) -> None:
        pg = import_pygame()
        self._pg = pg
        self._keys = {
            pg.K_RIGHT: (0, 1),
            pg.K_LEFT: (0, -1),
            pg.K_UP: (1, 1),
            pg.K_DOWN: (1, -1),
            pg.K_w: (2, 1),
            pg.K_s: (2, -1),
            pg.K_i: (3, 1),
            pg.K_k: (3, -1),
            pg.K_j: (4, 1),
            pg.K_l: (4, -1),
            pg.K_u: (5, 1),
            pg.K_o: (5, -1),
        }
        self._down: set[int] = set()

    def handle(self, event: Any) -> Iterator[Command]:
        """Remember which keys are down; commands are the window's."""
        if event.type == self._pg.KEYDOWN:
            self._down.add(event.key)
        elif event.type == self._pg.KEYUP:
            self._down.discard(event.key)
        elif event.type == self._pg.WINDOWFOCUSLOST:  # their release goes to another window
            self._down.clear()
        yield from ()

    def poll(self) -> Iterator[Command]:
        """Nothing."""
        yield from ()

    def motion(self) -> Floats:
        """The sum of what is down."""
        moved = np.zeros(6)
        for key in self._down & self._keys.keys():
            axis, sign = self._keys[key]
            moved[axis] += sign
        slow = self._down & {self._pg.K_LSHIFT, self._pg.K_RSHIFT}
        return moved * (_FINE if slow else 1.0)

    def close(self) -> None:
        """Nothing is held."""


class Gamepad:
    """The first gamepad, by SDL's own names of sticks and buttons.

    Raises:
        ValueError: if there is none.
    """

    help = (
        ("left stick", "left, right, away, towards you"),
        ("right stick", "up, down; turn, where the hand can be turned"),
        ("A, B", "gripper; undo"),
        ("X", "let time pass"),
        ("Start", "success"),
    )

    def __init__(self) -> None:
        pg = import_pygame()
        self._pg = pg
        controllers = import_module("pygame._sdl2.controller")
        controllers.init()
        pads = [i for i in range(controllers.get_count()) if controllers.is_controller(i)]
        if not pads:
            raise ValueError("no gamepad is connected: plug one in, or take --teleop keyboard")
        self._pad = controllers.Controller(pads[0])
        self._sticks = np.zeros(4)
        self._buttons: dict[int, Command] = {
            pg.CONTROLLER_BUTTON_A: "gripper",
            pg.CONTROLLER_BUTTON_B: "undo",
            pg.CONTROLLER_BUTTON_X: "wait",
            pg.CONTROLLER_BUTTON_START: "success",
        }
        self._axes = (
            pg.CONTROLLER_AXIS_LEFTX,
            pg.CONTROLLER_AXIS_LEFTY,
            pg.CONTROLLER_AXIS_RIGHTY,
            pg.CONTROLLER_AXIS_RIGHTX,
        )

    def handle(self, event: Any) -> Iterator[Command]:
        """Sticks and buttons."""
        if event.type == self._pg.CONTROLLERAXISMOTION and event.axis in self._axes:
            self._sticks[self._axes.index(event.axis)] = event.value / 32767
        elif event.type == self._pg.CONTROLLERBUTTONDOWN and event.button in self._buttons:
            yield self._buttons[event.button]

    def poll(self) -> Iterator[Command]:
        """Nothing."""
        yield from ()

    def motion(self) -> Floats:
        """Both sticks; theirs point down, ours away and up."""
        x, y, up, turn = _beyond(self._sticks)
        return np.array([x, -y, -up, 0.0, 0.0, -turn])

    def close(self) -> None:
        """Let the gamepad go."""
        self._pad.quit()


class SpaceMouse:
    """A 3Dconnexion SpaceMouse.

    Args:
        mouse: an opened device of pyspacemouse; None opens the first.

    Raises:
        ValueError: if there is none.
        ImportError: of one line, if pyspacemouse is not installed.
    """

    help = (
        ("push, pull, twist", "moves and turns the hand alike"),
        ("left button", "gripper"),
        ("right button", "undo"),
    )
    _commands: tuple[Command, ...] = ("gripper", "undo")

    def __init__(self, mouse: Any = None) -> None:
        if mouse is None:
            try:
                mouse = import_module("pyspacemouse").open()
            except ImportError as error:
                raise ImportError(
                    f"a SpaceMouse needs pyspacemouse ({error}): "
                    "pip install 'regil-sb3[spacemouse]'"
                ) from error
            except (RuntimeError, OSError) as error:
                raise ValueError(f"no SpaceMouse can be opened ({error})") from error
        self._mouse = mouse
        self._held = [False] * len(self._commands)
        self._motion = np.zeros(6)

    def handle(self, event: Any) -> Iterator[Command]:
        """Nothing: it is no device of pygame's."""
        yield from ()

    def poll(self) -> Iterator[Command]:
        """Read it: a button counts when it goes down."""
        state = self._mouse.read()
        turned = (state.pitch, state.roll, state.yaw)
        self._motion = _beyond(np.array([state.x, state.y, state.z, *turned], float))
        buttons = [bool(b) for b in state.buttons]
        buttons = (buttons + [False] * len(self._held))[: len(self._held)]
        for command, down, before in zip(self._commands, buttons, self._held, strict=True):
            if down and not before:
                yield command
        self._held = buttons

    def motion(self) -> Floats:
        """What `poll` read."""
        return self._motion

    def close(self) -> None:
        """Let it go."""
        self._mouse.close()


def _beyond(values: Floats) -> Floats:
    """What a stick says beyond its dead zone, again up to 1."""
    beyond: Floats = np.sign(values) * np.clip((np.abs(values) - _DEAD) / (1 - _DEAD), 0, 1)
    return beyond


def make_device(name: str) -> Device:
    """One by name.

    Raises:
        ValueError: if there is no such device, or none is connected.
        ImportError: of one line, if a package is not installed.
    """
    devices: dict[str, Callable[[], Device]] = {
        "keyboard": Keyboard,
        "gamepad": Gamepad,
        "spacemouse": SpaceMouse,
    }
    if name not in devices:
        raise ValueError(f"--teleop {name!r}: choose one of {', '.join(DEVICES)}")
    return devices[name]()


@dataclass
class Axes:
    """Which dimensions of an action a motion moves.

    Attributes:
        low: (A,) least actions.
        high: (A,) largest actions.
        translation: dimensions of right, away and up; fewer where there are fewer.
        rotation: dimensions of turns, likewise.
        gripper: the gripper's dimension, positive to close; None without one.
        quarters: how many quarters the view is turned about the vertical.
    """

    low: npt.NDArray[np.float32]
    high: npt.NDArray[np.float32]
    translation: list[int]
    rotation: list[int]
    gripper: int | None
    quarters: int = 0

    @classmethod
    def of(cls, space: Any, said: dict[str, Any]) -> Axes:
        """Those that an environment declares (``metadata["regil"]``), else the usual ones.

        Usual are three translations, three rotations where there are six dimensions or more, and
        the gripper last where one is left over.
        """
        n = int(space.shape[0])
        translation = list(said.get("translation_dims", range(min(3, n))))
        spare = [d for d in range(n) if d not in translation]
        gripper = said.get("gripper_dim", spare[-1] if len(spare) in (1, 4) else None)
        if gripper == "none":  # a tool without one
            gripper = None
        left = [d for d in spare if d != gripper]
        return cls(space.low, space.high, translation, left[:3] if len(left) >= 3 else [], gripper)

    def action(self, motion: Floats, closed: bool) -> npt.NDArray[np.float32]:
        """(A,) float32: the action of a motion (6,) in [-1, 1], the gripper open or closed.

        No motion is 0, or what is nearest to it within the limits; a whole one is a limit.
        """
        wish = np.zeros(len(self.low))
        moved = motion[:3].copy()
        for _ in range(self.quarters):
            moved[:2] = -moved[1], moved[0]
        for dims, values in ((self.translation, moved), (self.rotation, motion[3:])):
            for d, value in zip(dims, values, strict=False):
                wish[d] = np.clip(value, -1, 1)
        if self.gripper is not None:
            wish[self.gripper] = 1.0 if closed else -1.0
        bounded = np.isfinite(self.low) & np.isfinite(self.high)
        low, high = np.where(bounded, self.low, -1), np.where(bounded, self.high, 1)
        rest = np.clip(0, low, high)
        action: npt.NDArray[np.float32] = (
            rest + wish * np.where(wish > 0, high - rest, rest - low)
        ).astype(np.float32)
        return action
