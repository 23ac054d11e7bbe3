"""The window in which a person plays: the camera's picture, what can be pressed, what happened.

* ``Window`` - pygame's, with the commands that every device shares as keys and as buttons
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from regil_sb3.recording import Recorder
from regil_sb3.teleoperation.devices import Command, import_pygame

__all__ = ["Window"]

_INVISIBLE = ("dummy", "offscreen")  # what SDL falls back to
_PICTURE = 480  # px, drawn so large where the environment can
_SIZE = (880, 560)  # px, at first
_LEFT, _MARGIN, _LINE = 300, 14, 24  # px: room for words, between things, of a line
_PAGE, _INK, _SOFT = (24, 29, 35), (230, 233, 238), (154, 165, 177)
_GREEN, _BLUE = (60, 130, 70), (45, 70, 110)

# Command, its key, what it says while playing, and while the film is reviewed; None: not then
_BUTTONS: tuple[tuple[Command, str, str | None, str | None], ...] = (
    ("success", "Enter", "success", "keep it"),
    ("undo", "Backspace", "undo a second", "undo a second and go on"),
    ("again", "R", "begin again, next seed", "begin again, next seed"),
    ("gripper", "Space", "gripper", None),
    ("wait", ".", "let time pass", None),
    ("turn", "T", "turn the directions", None),
    ("quit", "Esc", "give up", "give up"),
)


class Window:
    """One window.

    Args:
        title: of it.

    Raises:
        ValueError: if there is no screen.
        ImportError: if pygame is not installed.
    """

    def __init__(self, title: str) -> None:
        self._pg = pg = import_pygame()
        try:
            pg.display.init()
            self._screen = pg.display.set_mode(_SIZE, pg.RESIZABLE)
        except pg.error as error:
            raise ValueError(f"no window can be opened here ({error})") from error
        driver = pg.display.get_driver()
        if driver in _INVISIBLE and not os.environ.get("SDL_VIDEODRIVER"):
            pg.display.quit()
            raise ValueError("no window can be opened here: there is no screen")
        pg.font.init()
        pg.display.set_caption(title)
        self._font = pg.font.Font(None, 22)
        self._keys: dict[int, Command] = {
            pg.K_RETURN: "success",
            pg.K_KP_ENTER: "success",
            pg.K_BACKSPACE: "undo",
            pg.K_r: "again",
            pg.K_SPACE: "gripper",
            pg.K_PERIOD: "wait",
            pg.K_t: "turn",
            pg.K_ESCAPE: "quit",
        }
        self._places: list[tuple[Any, Command]] = []

    def clock(self) -> Any:
        """What paces a loop."""
        return self._pg.time.Clock()

    def events(self) -> list[Any]:
        """Those since it was last asked."""
        return list(self._pg.event.get())

    def handle(self, event: Any) -> Iterator[Command]:
        """Keys and buttons of the window."""
        pg = self._pg
        if event.type == pg.QUIT:
            yield "quit"
        elif event.type == pg.KEYDOWN and event.key in self._keys:
            yield self._keys[event.key]
        elif event.type == pg.MOUSEBUTTONDOWN and event.button == 1:
            yield from (command for place, command in self._places if place.collidepoint(event.pos))

    def sees(self, recorder: Recorder) -> npt.NDArray[np.uint8]:
        """The scene as it is now, larger where the environment draws it so."""
        try:
            return recorder.drawn(_PICTURE)
        except ValueError:  # a camera whose pictures are smaller
            return recorder.frames[-1]

    def wait(self, words: str) -> None:
        """Say what takes a while."""
        self._write(words, (_MARGIN, self._screen.get_height() - _MARGIN - _LINE), _INK)
        self._pg.display.flip()

    def draw(
        self,
        picture: npt.NDArray[np.uint8],
        keys: tuple[tuple[str, str], ...],
        state: str,
        said: str,
        review: str,
    ) -> None:
        """Draw everything.

        Args:
            picture: (H, W, 3) uint8.
            keys: of the device: what to press, what it does.
            state: of the episode.
            said: what just happened.
            review: "" while playing; "keep" or "over" while the film is shown.
        """
        pg, screen = self._pg, self._screen
        screen.fill(_PAGE)
        width, height = screen.get_size()
        side = max(min(width - _LEFT - 3 * _MARGIN, height - 2 * _MARGIN - 3 * _LINE), 1)
        scale = side / max(picture.shape[:2])
        size = (round(picture.shape[1] * scale), round(picture.shape[0] * scale))
        surface = pg.surfarray.make_surface(np.ascontiguousarray(picture.swapaxes(0, 1)))
        screen.blit(pg.transform.smoothscale(surface, size), (_LEFT + 2 * _MARGIN, _MARGIN))

        y = _MARGIN
        self._places = []
        for command, key, playing, reviewing in _BUTTONS:
            words = reviewing if review else playing
            if words is None or (review == "over" and command == "success"):
                continue
            place = pg.Rect(_MARGIN, y, _LEFT, _LINE + 6)
            colour = _GREEN if command == "success" else _BLUE
            pg.draw.rect(screen, colour, place, border_radius=6)
            self._write(f"{words}  [{key}]", (place.x + 10, place.y + 7), _INK)
            self._places.append((place, command))
            y += _LINE + 12
        y += _MARGIN
        for press, does in () if review else keys:
            self._write(press, (_MARGIN, y), _INK)
            self._write(does, (_MARGIN, y + 18), _SOFT)
            y += 18 + _LINE
        bottom = height - _MARGIN - 2 * _LINE
        where = (_LEFT + 2 * _MARGIN, bottom)
        self._write(f"film of {state}" if review else state, where, _SOFT)
        self._write(said, (_MARGIN, bottom + _LINE), _INK)
        pg.display.flip()

    def _write(self, words: str, place: tuple[int, int], colour: tuple[int, int, int]) -> None:
        self._screen.blit(self._font.render(words, True, colour), place)

    def close(self) -> None:
        """Close it."""
        self._pg.quit()
