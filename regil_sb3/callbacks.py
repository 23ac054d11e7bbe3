"""What algorithms do for callbacks beyond Stable-Baselines3."""

from __future__ import annotations

from stable_baselines3.common.type_aliases import MaybeCallback


def close_callbacks(callback: MaybeCallback) -> None:
    """Close a callback, and those in it, that can be: SB3 tells none of an end by an error."""
    for inner in callback if isinstance(callback, list) else getattr(callback, "callbacks", []):
        close_callbacks(inner)
    close = getattr(callback, "close", None)
    if close is not None:
        close()
