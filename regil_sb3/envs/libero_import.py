"""LIBERO, imported without its questions and downloads, and what it keeps in files.

* ``import_libero`` - its problems by name, with the assets that the user names
* ``bddl_file`` - a task's definition
* ``initial_states`` - a task's fixed initial states
"""

from __future__ import annotations

import codecs
import functools
import importlib.util
import os
import pickle
import tempfile
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from regil_sb3.envs.robosuite_import import import_robosuite

__all__ = ["ASSETS", "bddl_file", "import_libero", "initial_states"]

ASSETS = "REGIL_LIBERO_ASSETS"
"""The environment variable that says where LIBERO's assets are."""

_INSTALL = (
    "pip install 'regil-sb3[libero]', "
    "then pip install --no-deps robosuite==1.4.0 hf-libero==0.1.4 bddl==1.0.1"
)
_GET_ASSETS = (
    "take the folder libero/libero/assets of github.com/Lifelong-Robot-Learning/LIBERO "
    f"and name it in the environment variable {ASSETS}"
)


def import_libero() -> Any:
    """Import LIBERO's environments.

    Its import asks on the terminal where data is to lie, and downloads assets, where it does not
    know; it also changes what Python does with warnings.

    Returns:
        `libero.libero.envs`, with `TASK_MAPPING`.

    Raises:
        ImportError: where LIBERO, robosuite or BDDL is not installed.
        ValueError: where the assets are not there.
    """
    assets = _assets()
    import_robosuite(_INSTALL)
    try:
        libero = _configured()
        libero._assets_path_cache = str(assets)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import libero.libero.envs as envs  # type: ignore[import-untyped]
    except ModuleNotFoundError as error:
        raise ImportError(f"LIBERO is not installed ({error}): {_INSTALL}") from None
    return envs


def _package() -> Path:
    spec = importlib.util.find_spec("libero")
    if spec is None or spec.origin is None:
        raise ImportError(f"LIBERO is not installed: {_INSTALL}")
    return Path(spec.origin).parent / "libero"


def _assets() -> Path:
    """The folder that holds `scenes`: what the user names, or what lies in the package."""
    named = os.environ.get(ASSETS)
    own = _package() / "assets"
    if not named and not own.is_dir():
        raise ValueError(f"LIBERO's assets are not there: {_GET_ASSETS}")
    folder = Path(named).expanduser().absolute() if named else own
    for holds in (folder, folder / "assets"):
        if (holds / "scenes").is_dir():
            return holds
    raise ValueError(f"{ASSETS}={folder} holds no folder 'scenes': {_GET_ASSETS}")


@functools.cache
def _configured() -> Any:
    """`libero.libero`, with a configuration of ours where the user has none."""
    home = Path(os.environ.get("LIBERO_CONFIG_PATH", Path.home() / ".libero"))
    if (home / "config.yaml").exists():
        import libero.libero as libero

        return libero
    root = _package()
    paths = {
        "benchmark_root": root,
        "bddl_files": root / "bddl_files",
        "init_states": root / "init_files",
        "datasets": root.parent / "datasets",
        "assets": root / "assets",
    }
    before = os.environ.get("LIBERO_CONFIG_PATH")
    with tempfile.TemporaryDirectory() as folder:
        lines = [f"{name}: {str(path)!r}\n" for name, path in paths.items()]
        (Path(folder) / "config.yaml").write_text("".join(lines), encoding="utf-8")
        os.environ["LIBERO_CONFIG_PATH"] = folder
        try:
            import libero.libero as libero
        finally:
            if before is None:
                del os.environ["LIBERO_CONFIG_PATH"]
            else:
                os.environ["LIBERO_CONFIG_PATH"] = before
    return libero


def bddl_file(suite: str, task: str) -> Path:
    """The definition of a task, which comes with the package."""
    return _package() / "bddl_files" / suite / f"{task}.bddl"


class _Restricted(pickle.Unpickler):
    """Makes arrays and nothing else: a pickle can run any code."""

    def find_class(self, module: str, name: str) -> Any:
        allowed = {
            ("numpy.core.multiarray", "_reconstruct"): np.array(0).__reduce__()[0],
            ("numpy._core.multiarray", "_reconstruct"): np.array(0).__reduce__()[0],
            ("numpy", "ndarray"): np.ndarray,
            ("numpy", "dtype"): np.dtype,
            ("_codecs", "encode"): codecs.encode,
        }
        if (module, name) not in allowed:
            raise pickle.UnpicklingError(f"{module}.{name} does not belong there")
        return allowed[module, name]


def initial_states(suite: str, task: str) -> npt.NDArray[np.float64]:
    """The fixed initial states of a task, (50, n): time, positions and velocities of MuJoCo's.

    Raises:
        ValueError: where the file is missing, damaged, or holds anything but numbers.
    """
    path = _package() / "init_files" / suite / f"{task}.pruned_init"
    try:
        with zipfile.ZipFile(path) as archive, archive.open("archive/data.pkl") as file:
            states = _Restricted(file).load()
    except (OSError, KeyError, ValueError, zipfile.BadZipFile, pickle.UnpicklingError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    if not isinstance(states, np.ndarray) or states.ndim != 2 or states.dtype.kind != "f":
        raise ValueError(f"{path} must hold a table of numbers")
    return states.astype(np.float64)
