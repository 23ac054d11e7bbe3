"""An encoder's name as one string, so that YAML and an environment's spec can carry it.

``NAME[@FILE][?option=value[&option=value ...]]``, for example
``"dinov2-small?features=patches&whiten=32"`` or ``"r3m-resnet18@weights/r3m.pt?batch=8"``.

* ``parse`` - takes it apart
* ``absolute`` - the same name wherever it is read
* ``one_of``, ``whole_number``, ``fraction`` - what an option may be
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

__all__ = ["absolute", "fraction", "one_of", "parse", "whole_number"]

_OPTION = re.compile(r"([A-Za-z_]\w*)=(.+)")
_WORDS: dict[str, Any] = {"true": True, "false": False, "none": None}


def parse(text: str) -> tuple[str, str | None, dict[str, Any]]:
    """Take an encoder's name apart.

    A value is a whole number, a number, ``true``, ``false``, ``none``, a list of these with commas
    between them (a tuple), or text.

    Args:
        text: ``NAME[@FILE][?option=value[&option=value ...]]``.

    Returns:
        name, file or None, options.

    Raises:
        ValueError: if what follows the last "?" is no list of options.
    """
    whole = text
    options: dict[str, Any] = {}
    if "?" in text:
        text, _, tail = text.rpartition("?")
        for part in tail.split("&"):
            option = _OPTION.fullmatch(part)
            if option is None or option[1] in options:
                raise ValueError(
                    f"encoder {whole!r}: {part!r} is no option: write "
                    f"name?option=value&option=value, each option once"
                )
            options[option[1]] = _value(option[2])
    if text.startswith("torchscript:"):  # its file stands after the colon
        return text, None, options
    name, _, file = text.partition("@")
    return name, file or None, options


def absolute(text: str) -> str:
    """The same name with the path of its file, where it has one, from the root.

    Raises:
        ValueError: as of `parse`.
    """
    name, file, _ = parse(text)
    mark = "torchscript:" if name.startswith("torchscript:") else "@"
    file = name.removeprefix(mark) if mark != "@" else file
    if not file:
        return text
    head, _, rest = text.partition(mark)
    return f"{head}{mark}{Path(file).absolute()}{rest.removeprefix(file)}"


def _value(text: str) -> Any:
    if "," in text:
        return tuple(_value(part) for part in text.split(","))
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def one_of(name: str, value: Any, choices: Sequence[Any]) -> None:
    """Refuse a value that is not one of the choices.

    Raises:
        ValueError: naming the option, its value and the choices.
    """
    if not any(value is choice or (value == choice and type(value) is str) for choice in choices):
        raise ValueError(f"{name}={value!r}: choose one of {list(choices)}")


def whole_number(name: str, value: Any) -> None:
    """Refuse anything but a whole number of at least 1.

    Raises:
        ValueError: naming the option and its value.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"{name}={value!r}: it must be a whole number, at least 1")


def fraction(name: str, value: Any) -> None:
    """Refuse anything but a number above 0 and up to 1.

    Raises:
        ValueError: naming the option and its value.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value <= 1:
        raise ValueError(f"{name}={value!r}: it must be a number above 0 and up to 1")
