"""Logs of a run that a fault does not end.

* ``AppendingCSV`` - SB3's CSV log, which goes on where an earlier part of the run stopped
* ``Forgiving`` - a log that cannot be written costs its lines, not the training
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import CSVOutputFormat, KVWriter
from tqdm import tqdm

__all__ = ["AppendingCSV", "Forgiving"]


class AppendingCSV(CSVOutputFormat):
    """SB3's CSV log, which goes on where an earlier part of the run stopped."""

    def __init__(self, path: Path) -> None:
        old = path.read_text(encoding="utf-8") if path.exists() else ""
        super().__init__(str(path))
        if old:
            self.keys = old.splitlines()[0].split(",")
            self.file.write(old)
            self.file.flush()


class Forgiving(KVWriter):
    """Writes to another log, and says once where that fails: a full disk, a broken library.

    Args:
        name: of the log, for the line that says so.
        make: opens it.
    """

    def __init__(self, name: str, make: Callable[[], KVWriter]) -> None:
        self.name, self._said = name, ""
        self._log: KVWriter | None = None
        self._do(lambda: setattr(self, "_log", make()))

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        """Write what SB3's logger has gathered."""
        log = self._log
        if log is not None:
            self._do(lambda: log.write(key_values, key_excluded, step))

    def close(self) -> None:
        """Close the log."""
        if self._log is not None:
            self._do(self._log.close)

    def _do(self, what: Callable[[], None]) -> None:
        try:
            what()
        except Exception as error:  # whatever a library of somebody else's raises
            reason = " ".join(str(error).split()) or type(error).__name__
            if reason != self._said:
                self._said = reason
                tqdm.write(
                    f"{self.name} cannot be written ({reason}): training goes on, and what was "
                    "to be logged now is not kept",
                    file=sys.stderr,
                )
        else:
            self._said = ""
