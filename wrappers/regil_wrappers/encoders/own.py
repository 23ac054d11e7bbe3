"""``own_factory`` - ``"module:function"``: an encoder that the user has written."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

from regil_wrappers.encoders.protocol import Encoder

__all__ = ["own_factory"]


def own_factory(name: str) -> Callable[..., Encoder]:
    """What ``"module:function"`` names. Importing the module runs it.

    Raises:
        ImportError: if there is no such module.
        ValueError: if it has nothing of that name that can be called.
    """
    module, _, attribute = name.partition(":")
    try:
        found = import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise
        raise ImportError(
            f"there is no module {error.name!r}: install it, or put its folder on PYTHONPATH"
        ) from error
    factory = getattr(found, attribute, None)
    if not callable(factory):
        raise ValueError(f"module {module!r} has no function {attribute!r}")
    return factory  # type: ignore[no-any-return]
