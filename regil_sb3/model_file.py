"""Models as SB3 writes them, opened without running what strangers may have put in.

* ``checked_model`` - a file's bytes, once everything pickled in it is found to be of known kinds
* ``SafeLoad`` - an algorithm whose ``load`` reads files so

SB3 pickles what JSON cannot hold: spaces, schedules, the policy's class. Unpickling calls what a
file names: here it may name what a model of this package needs, and call what puts numbers
together.
"""

from __future__ import annotations

import base64
import binascii
import io
import json
import pickle
import zipfile
from functools import partial
from os import PathLike
from pathlib import Path
from types import BuiltinFunctionType, FunctionType
from typing import Any, BinaryIO, ClassVar, TypeVar

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import GymEnv

__all__ = ["SafeLoad", "checked_model"]

SelfSafeLoad = TypeVar("SelfSafeLoad", bound="SafeLoad")

_INFLATED = 4  # times a file's own size: SB3 does not compress
_SLACK = 1 << 20  # bytes

_CALLED = {
    "collections": {"OrderedDict", "deque"},
    "numpy": {"dtype"},
    **{  # the first as NumPy 1 calls it
        f"numpy.{core}.{module}": {name}
        for core in ("core", "_core")
        for module, name in (("multiarray", "scalar"), ("numeric", "_frombuffer"))
    },
    "numpy.random._pickle": {"__bit_generator_ctor", "__generator_ctor"},
    "numpy.random.bit_generator": {"__pyx_unpickle_SeedSequence"},
    "stable_baselines3.common.type_aliases": {"TrainFrequencyUnit"},
}
"""What a file may call: it puts numbers together that the file itself holds."""

_MADE = {
    "gymnasium.spaces.box": {"Box"},
    "gymnasium.spaces.dict": {"Dict"},
    "gymnasium.spaces.discrete": {"Discrete"},
    "gymnasium.spaces.multi_binary": {"MultiBinary"},
    "gymnasium.spaces.multi_discrete": {"MultiDiscrete"},
    "regil_sb3.bc_schedule": {"BySuccess"},
    "stable_baselines3.common.noise": {
        "NormalActionNoise",
        "OrnsteinUhlenbeckActionNoise",
        "VectorizedActionNoise",
    },
    "stable_baselines3.common.type_aliases": {"TrainFreq"},
    "stable_baselines3.common.utils": {"ConstantSchedule", "FloatSchedule", "LinearSchedule"},
}
"""What it may make an empty one of, and then fill."""

_NAMED = {
    "numpy": {"float32"},  # the dtype of action noise
    "numpy.random._mt19937": {"MT19937"},
    "numpy.random._pcg64": {"PCG64"},
    "numpy.random.bit_generator": {"SeedSequence"},
    "regil_sb3.baselines.baku": {"BAKUPolicy"},
    "regil_sb3.policies": {"ConvEncoder", "ImagePolicy", "ResNet18Encoder"},
    "regil_sb3.relabelling": {
        "EpisodeRewardDictReplayBuffer",
        "EpisodeRewardFrameReplayBuffer",
        "EpisodeRewardNStepReplayBuffer",
        "EpisodeRewardReplayBuffer",
    },
    "regil_sb3.replay_buffer": {"FrameReplayBuffer"},
    "stable_baselines3.common.buffers": {"DictReplayBuffer", "NStepReplayBuffer", "ReplayBuffer"},
    "stable_baselines3.common.torch_layers": {"CombinedExtractor", "FlattenExtractor", "NatureCNN"},
    "stable_baselines3.td3.policies": {"CnnPolicy", "MultiInputPolicy", "TD3Policy"},
    "torch.nn.modules.activation": {"ELU", "GELU", "LeakyReLU", "ReLU", "SiLU", "Tanh"},
    "torch.optim.adam": {"Adam"},
    "torch.optim.adamw": {"AdamW"},
    "torch.optim.sgd": {"SGD"},
}
"""What it may name, and no more."""


def checked_model(path: str | PathLike[str] | BinaryIO) -> BinaryIO:
    """Read a model's file, and refuse one that holds more than a model needs.

    Args:
        path: the file (".zip" is added where it is missing, as SB3 does), or an open one.

    Returns:
        its bytes, which may be loaded.

    Raises:
        ValueError: it is no such file, is damaged, would grow far beyond its size, or names a class
            or a function that is not known to be harmless.
        OSError: it cannot be read.
    """
    if isinstance(path, (str, PathLike)):
        file = Path(path)
        if not file.exists() and file.suffix != ".zip":
            file = file.with_name(f"{file.name}.zip")
        name, content = str(file), file.read_bytes()
    else:
        name, content = str(getattr(path, "name", "the model")), path.read()
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            inflated = sum(member.file_size for member in archive.infolist())
            if inflated > _INFLATED * len(content) + _SLACK:
                raise ValueError(f"its parts claim {inflated} bytes, the file has {len(content)}")
            if (damaged := archive.testzip()) is not None:
                raise ValueError(f"its part {damaged!r} is damaged")
            for part in archive.namelist():
                if part.endswith(".pth"):
                    _check_size(part, archive.read(part))
            data = json.loads(archive.read("data"))
        if not isinstance(data, dict):
            raise ValueError("its settings are no dictionary")
        for key, value in data.items():
            if isinstance(value, dict) and ":serialized:" in value:
                _check_pickle(key, value[":serialized:"])
    except (zipfile.BadZipFile, KeyError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{name} is no model of Stable-Baselines3, or damaged: {error}") from None
    except (ValueError, RecursionError, NotImplementedError) as error:
        raise ValueError(f"{name} is not loaded: {error}") from None
    return io.BytesIO(content)


class SafeLoad(BaseAlgorithm):
    """What an algorithm inherits from, before SB3's own class, so that ``load`` runs no code."""

    @classmethod
    def load(  # type: ignore[override]
        cls: type[SelfSafeLoad],
        path: str | PathLike[str] | BinaryIO,
        env: GymEnv | None = None,
        *args: Any,
        trust: bool = False,
        **kwargs: Any,
    ) -> SelfSafeLoad:
        """Load a model, as SB3 does; nothing that the file holds is run.

        Args:
            path: of the file, or the file itself.
            env: to go on in; None where the model is only to act.
            *args: SB3's own, in its order: device, custom_objects, print_system_info, force_reset.
            trust: whether the file may name anything, and so run code: for policies, encoders and
                schedules of one's own.
            **kwargs: SB3's own, or attributes to replace, such as ``buffer_size=1`` and ``demo=``.

        Raises:
            ValueError: the file is no model, is damaged, or names what is not known to be harmless.
            OSError: it cannot be read.
        """
        if trust:
            return super().load(path, env, *args, **kwargs)  # type: ignore[arg-type]
        content: Any = checked_model(path)
        try:
            return super().load(content, env, *args, **kwargs)
        except (pickle.UnpicklingError, RuntimeError) as error:
            raise ValueError(f"{path} does not load: {str(error).splitlines()[0]}") from error


def _check_size(part: str, content: bytes) -> None:
    """Refuse a file of torch's, a zip in the zip, that would grow far beyond its size."""
    with zipfile.ZipFile(io.BytesIO(content)) as inside:
        inflated = sum(member.file_size for member in inside.infolist())
    if inflated > _INFLATED * len(content) + _SLACK:
        raise ValueError(f"{part} claims {inflated} bytes, and has {len(content)}")


def _check_pickle(key: str, text: Any) -> None:
    try:
        pickled = base64.b64decode(text)
    except (TypeError, binascii.Error) as error:
        raise ValueError(f"{key!r} is damaged ({error})") from None
    try:
        _Checked(pickled).load()
    except _RefusedError as refused:
        raise ValueError(
            f"{key!r} names {refused}, which a model does not need and which could run code; if "
            "you trust whoever made the file, load it with trust=True (--trust)"
        ) from None
    except Exception as error:  # whatever a damaged pickle may lead to
        raise ValueError(f"{key!r} is damaged ({type(error).__name__}: {error})") from None


class _RefusedError(Exception):
    pass


def _is_of_numbers(dtype: Any, state: Any) -> bool:
    """Whether this is what NumPy writes of a plain type of numbers."""
    plain = isinstance(state, tuple) and len(state) == 8 and state[0] == 3
    return bool(plain and dtype.kind in "biuf" and state[2:] == (None, None, None, -1, -1, 0))


_SCALAR = np.float64(0).__reduce__()[0]
_Unpickler: Any = pickle._Unpickler  # the one in Python, whose steps can be looked at


class _Checked(_Unpickler):  # type: ignore[misc]
    """Does what a pickle says, as far as `_CALLED`, `_MADE` and `_NAMED` go."""

    dispatch: ClassVar[dict[int, Any]] = dict(_Unpickler.dispatch)

    def __init__(self, pickled: bytes) -> None:
        super().__init__(io.BytesIO(pickled))
        self._size = len(pickled)
        self._left = 4 * self._size + 1_000  # items that calls may take over

    def find_class(self, module: str, name: str) -> Any:
        if not any(name in known.get(module, ()) for known in (_CALLED, _MADE, _NAMED)):
            raise _RefusedError(f"{module}.{name}")
        return super().find_class(module, name)

    def _check(self, known: dict[str, set[str]]) -> None:
        """The object below the arguments must be one of those; not one that says it is."""
        it = self.stack[-2]
        if not any(
            it is super(_Checked, self).find_class(module, name)
            for module, names in known.items()
            if module == getattr(it, "__module__", None)
            for name in names
        ):
            raise _RefusedError(f"a call of {it!r}")

    def load_reduce(self) -> None:
        self._check(_CALLED)
        arguments = self.stack[-1]
        for one in arguments:
            self._take_over(one)
        if self.stack[-2] is _SCALAR and len(arguments[1]) != arguments[0].itemsize:
            raise _RefusedError(f"a number of {arguments[0].itemsize} bytes")
        super().load_reduce()

    def load_newobj(self) -> None:
        self._check(_MADE)
        super().load_newobj()

    def load_build(self) -> None:
        it, state = self.stack[-2:]
        if isinstance(it, (type, FunctionType, BuiltinFunctionType, np.ndarray, np.generic)):
            raise _RefusedError(f"a change of {it!r}")
        if isinstance(it, np.dtype) and not _is_of_numbers(it, state):
            raise _RefusedError(f"a type of numbers that is none ({state!r:.60})")
        for part in state if isinstance(state, tuple) else (state,):
            self._take_over(part)
        super().load_build()

    def _take_over(self, one: Any) -> None:
        """Count the items of which a copy is made."""
        self._left -= len(one) if hasattr(one, "__len__") else 0
        if self._left < 0:
            raise _RefusedError("many more items than it holds")

    def _refuse(self) -> None:
        raise _RefusedError("another way to call")

    def _bytearray(self) -> None:
        """It would be made as long as it says, before it is read."""
        length = int.from_bytes(self.read(8), "little")
        if length > self._size:
            raise _RefusedError("more bytes than it holds")
        content = bytearray(length)
        self.readinto(content)
        self.append(content)

    def _put(self, opcode: int) -> None:
        """A place in the memo far beyond the last would be made with all before it."""
        _Unpickler.dispatch[opcode](self)
        if next(reversed(self.memo)) > len(self.memo):
            raise _RefusedError("a place far beyond what it holds")

    dispatch[pickle.REDUCE[0]] = load_reduce
    dispatch[pickle.NEWOBJ[0]] = load_newobj
    dispatch[pickle.BUILD[0]] = load_build
    for _opcode in (
        pickle.NEWOBJ_EX,
        pickle.OBJ,
        pickle.INST,
        pickle.EXT1,
        pickle.EXT2,
        pickle.EXT4,
    ):
        dispatch[_opcode[0]] = _refuse
    dispatch[pickle.BYTEARRAY8[0]] = _bytearray
    for _opcode in (pickle.PUT, pickle.BINPUT, pickle.LONG_BINPUT):
        dispatch[_opcode[0]] = partial(_put, opcode=_opcode[0])
