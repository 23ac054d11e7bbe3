"""robosuite 1.4, imported without what its import does to a process.

It writes a log file that other users of the machine cannot open, warns of a file that nobody needs,
and sets MUJOCO_GL. Pictures are drawn by `regil_sb3.envs.rendering` instead.
"""

from __future__ import annotations

import importlib.util
import sys
import warnings
from pathlib import Path
from typing import Any

__all__ = ["INSTALL", "import_robosuite"]

INSTALL = "pip install 'regil-sb3[robosuite]', then pip install --no-deps robosuite==1.4.0"
"""The last one declares dependencies that are not needed, among them a second OpenCV."""


def import_robosuite(install: str = INSTALL) -> Any:
    """Import robosuite, once its settings are quiet.

    Args:
        install: what to tell a user who has it not, or in another version.

    Returns:
        the package.

    Raises:
        ImportError: where it is not installed, or in another version.
    """
    if "robosuite" not in sys.modules:
        spec = importlib.util.find_spec("robosuite")
        if spec is None or spec.origin is None:
            raise ImportError(f"robosuite is not installed: {install}")
        # Read by the package's own first lines, so that it must be there before them
        path = Path(spec.origin).with_name("macros.py")
        own = importlib.util.spec_from_file_location("robosuite.macros", path)
        if own is None or own.loader is None:
            raise ImportError(f"{path} cannot be imported: {install}")
        macros: Any = importlib.util.module_from_spec(own)
        own.loader.exec_module(macros)
        macros.MUJOCO_GPU_RENDERING = False
        macros.FILE_LOGGING_LEVEL, macros.CONSOLE_LOGGING_LEVEL = None, "ERROR"
        sys.modules["robosuite.macros"] = macros
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of its own logging, which is older than Python's
        import robosuite  # type: ignore[import-untyped]

    if not robosuite.__version__.startswith("1.4."):
        raise ImportError(f"robosuite {robosuite.__version__} is not 1.4: {install}")
    return robosuite
