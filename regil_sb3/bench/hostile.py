"""Files that a stranger may have made or a disk spoilt, read in a process that may not grow.

* ``KINDS`` - checkpoints, pickles, yaml, archives: each makes a numbered case and reads it
* ``pickles``, ``with_pickle`` - what a model may hold that must not run

    python -m regil_sb3.bench.hostile --worker KIND FIRST COUNT FOLDER

is what `regil_wrappers.formats.fuzz.run` starts.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import os
import pickle
import shutil
import sys
import warnings
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cloudpickle  # type: ignore[import-untyped]
import gymnasium as gym
import numpy as np
from regil_wrappers import formats
from regil_wrappers.formats.fuzz import damaged, damaged_json, example, limited, outcome

from regil_sb3.bc_schedule import BySuccess
from regil_sb3.bench import disk_faults
from regil_sb3.bench.toy import new_model, stacked
from regil_sb3.checkpoint.generations import Generations
from regil_sb3.settings import Settings
from regil_sb3.td3bc import TD3BC

__all__ = ["KEYS", "KINDS", "Call", "pickles", "with_pickle"]

KEYS = ("lr_schedule", "_by_success", "observation_space")
"""Of a model, which SB3 pickles."""


class Call:
    """Pickles as a call."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.called = (function, arguments)

    def __reduce__(self) -> Any:
        return self.called


def pickles(marker: Path) -> Iterator[tuple[str, bytes]]:
    """Pickles that make the file ``marker``, or ask for much, and their names."""
    command = f"touch {marker}"
    line = f"open({str(marker)!r}, 'w').close()"
    yield "os.system", pickle.dumps(Call(os.system, command))
    yield "exec", pickle.dumps(Call(exec, line))
    yield "eval", pickle.dumps(Call(eval, line))
    yield "getattr", pickle.dumps(Call(getattr, dict, "fromkeys"))
    yield "import", pickle.dumps(Call(__import__, "antigravity"))
    yield "cloudpickle", cloudpickle.dumps(lambda _: os.system(command))
    yield "a class of its own", cloudpickle.dumps(type("Net", (), {"__call__": lambda self: 1}))
    yield "in a known one", pickle.dumps({"state": [Call(os.system, command)]})
    for protocol in range(3):
        yield f"protocol {protocol}", pickle.dumps(Call(os.system, command), protocol)
    yield "INST", b"(S'" + command.encode() + b"'\nios\nsystem\n."
    yield "OBJ", b"(cos\nsystem\nS'" + command.encode() + b"'\no."
    yield "dotted", b"\x80\x04\x8c\x0bcollections\x8c\x0edeque.__init__\x93."
    yield "EXT", b"\x80\x02\x82\x01."
    yield "persistent", b"Pos.system\n."
    yield "a class changed", pickle.dumps(BySuccess)[:-1] + b"}\x8c\x05shareK\x01sb."
    yield "huge", pickle.dumps(Call(gym.spaces.Box, 0, 1, (10**7, 10**7)))
    yield "huge array", pickle.dumps(Call(np.zeros, 10**13))
    wide = Call(np.float64(0).__reduce__()[0], np.dtype("V100000000"))
    yield "huge number", pickle.dumps(wide)
    yield "endless", b"\x80\x04" + b"(" * 10**6 + b"."
    yield "truncated", pickle.dumps(BySuccess(0.5))[:-9]
    yield "nothing", b""
    yield "text", b"hello"


def with_pickle(saved: Path, path: Path, pickled: bytes, key: str = KEYS[0]) -> Path:
    """The same model, with this in place of one of the things that SB3 pickles."""
    with zipfile.ZipFile(saved) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if name == "data":
                data = json.loads(content)
                assert key in data
                data[key] = {":type:": "x", ":serialized:": base64.b64encode(pickled).decode()}
                content = json.dumps(data).encode()
            new.writestr(name, content)
    return path


def _read(read: Callable[[], Any], marker: Path, must_refuse: bool = True) -> str:
    """What became of a file: "read", "refused", or what went wrong."""
    try:
        read()
        found = "it was read" if must_refuse else "read"
    except Exception as error:
        found = outcome(error)
    return "it was executed" if marker.exists() else found


# -- checkpoints -----------------------------------------------------------------------------------


def _checkpoints(folder: Path) -> Callable[[int], str]:
    source = folder / "whole"
    learner, saver = disk_faults.Learner(), Generations(source)
    trees = []
    for _ in range(2):
        learner.learn(20)
        trees.append({**learner.tree(), "ring": learner.tree()["ring"].rows.copy()})
        with disk_faults.small_blocks():
            saver.save(learner.tree())

    def case(number: int) -> str:
        rng = np.random.default_rng(number)
        target = folder / "case"
        shutil.copytree(source, target)
        try:
            signed = rng.random() < 0.5
            for _ in range(int(rng.integers(1, 4))):
                (_sign if signed else _spoil)(target, rng)
            loaded: Any = Generations(target).load()
            if signed:  # it says what it holds itself
                return "read"
            whole = any(disk_faults.same(loaded, tree) for tree in trees)
            return "read" if whole else "what was loaded had never been saved"
        except Exception as error:
            return "refused" if isinstance(error, MemoryError) else outcome(error)
        finally:
            shutil.rmtree(target)

    return case


def _spoil(folder: Path, rng: np.random.Generator) -> None:
    files = sorted(f for f in folder.rglob("*") if f.is_file())
    path = files[int(rng.integers(len(files)))]
    if rng.random() < 0.1:
        path.unlink()
    else:
        other = files[int(rng.integers(len(files)))].read_bytes()
        path.write_bytes(damaged(path.read_bytes(), rng, other))


def _sign(folder: Path, rng: np.random.Generator) -> None:
    """Another value in a ``state.json`` that is signed all the same."""
    states = sorted(folder.glob("*/state.json"))
    path = states[int(rng.integers(len(states)))]
    body = damaged_json(path.read_bytes().partition(b"\n")[2].decode(), rng).encode()
    path.write_bytes(hashlib.sha256(body).hexdigest().encode() + b"\n" + body)


# -- models ----------------------------------------------------------------------------------------


def _model(folder: Path) -> Path:
    path = folder / "model.zip"
    new_model(stacked(), buffer_size=100).save(path)
    return path


def _pickles(folder: Path) -> Callable[[int], str]:
    saved, marker = _model(folder), folder / "executed"
    hostile = list(pickles(marker))
    TD3BC.load(saved)

    def case(number: int) -> str:
        _, content = hostile[number // len(KEYS) % len(hostile)]
        path = with_pickle(saved, folder / "case.zip", content, KEYS[number % len(KEYS)])
        return _read(lambda: TD3BC.load(path), marker)

    return case


def _archives(folder: Path) -> Callable[[int], str]:
    saved, marker = _model(folder), folder / "executed"
    whole, other = saved.read_bytes(), os.urandom(1_000)
    example().save(folder / "demo.hdf5")
    with zipfile.ZipFile(saved) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    TD3BC.load(saved)

    def case(number: int) -> str:
        rng = np.random.default_rng(number)
        path = folder / "case.zip"
        size = int(rng.integers(50, 400)) << 20
        kind = number % 5
        if kind == 0:  # grows a thousand times
            with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
                archive.writestr(("data", "policy.pth")[number // 5 % 2], bytes(size))
        elif kind == 1:
            path.write_bytes(damaged(whole, rng, other)[: int(rng.integers(len(whole)))])
        elif kind == 2:  # names that lead out, parts that come twice
            with warnings.catch_warnings(), zipfile.ZipFile(path, "w") as archive:
                warnings.simplefilter("ignore")
                archive.writestr(f"../../{marker.name}", b"x")
                for name in [*list(parts)[: int(rng.integers(len(parts)))], "data", "data"]:
                    archive.writestr(name, parts["policy.pth"])
        elif kind == 3:  # an array that claims more than there is
            stream = io.BytesIO()
            shape = (int(rng.integers(1, 2**40)), 8, 8, 3)
            header = {"descr": "|u1", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(stream, header)
            path = folder / "case.npz"
            with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
                archive.writestr("frames.npy", stream.getvalue() + bytes(size // 8))
        else:  # a part's own claim of its size
            content = bytearray(whole)
            directory = content.rindex(b"PK\x01\x02")
            content[directory + 20 : directory + 28] = rng.bytes(8)
            path.write_bytes(content)
        read = formats.read if kind == 3 else TD3BC.load
        return _read(lambda: read(path), marker)

    return case


# -- settings --------------------------------------------------------------------------------------


def _yaml(folder: Path) -> Callable[[int], str]:
    path, marker = folder / "config.yaml", folder / "executed"
    Settings(env="toy").save(path)
    whole = path.read_bytes()
    command = f"touch {marker}"
    laughs = "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12))
    hostile = [
        f"!!python/object/apply:os.system ['{command}']",
        f"env: !!python/object/new:os.system ['{command}']",
        f"env: !!python/object/apply:subprocess.check_output [[touch, '{marker}']]",
        f"env: !!python/object/apply:eval ['open({str(marker)!r}, \"w\")']",
        "env: !!python/name:os.system",
        "env: !!python/module:antigravity",
        "a0: &a0 [x]\n" + laughs,
        "a: &a [*a]",
        "env: " + "[" * 100_000,
        "env: " + "{a: " * 20_000,
        "env: 2020-99-99",
        "env: !!timestamp never",
        "env: !!int x",
        "env: " + "9" * 100_000,
        "? [a]\n: b",
        "- 1",
        "",
        "env: \x00",
        "%YAML 9.9\n---\n",
        "<<: 3",
        "env_wrapper: [{regil_wrappers.formats.fuzz.run: {module: this}}]",
    ]

    def case(number: int) -> str:
        rng = np.random.default_rng(number)
        if number % 2:
            content = damaged(whole, rng, whole)
        else:
            content = hostile[number // 2 % len(hostile)].encode()
            if rng.random() < 0.5:
                content = whole + content
        path.write_bytes(content)
        return _read(lambda: Settings.load(path), marker, must_refuse=False)

    return case


KINDS: dict[str, Callable[[Path], Callable[[int], str]]] = {
    "checkpoints": _checkpoints,
    "pickles": _pickles,
    "yaml": _yaml,
    "archives": _archives,
}
"""By kind: given an empty folder, what reads a numbered case there."""


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # damaged generations are warned of
    limited(int(sys.argv[3]), int(sys.argv[4]), KINDS[sys.argv[2]](Path(sys.argv[5])))
