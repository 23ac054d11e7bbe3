"""What a run is made of: a preset of the zoo's YAML, with a user's own values on top."""

from __future__ import annotations

import copy
import difflib
import inspect
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib import import_module, resources
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from regil_wrappers import RetrievalGuideWrapper, RetrievalRewardWrapper, make_encoder
from regil_wrappers.encoders import runs_code
from regil_wrappers.encoders.options import absolute

from regil_sb3.background import BackgroundTD3BC
from regil_sb3.baselines import BAKU, BC, ROT, ReverseForwardCurriculum
from regil_sb3.files import replacing
from regil_sb3.td3bc import TD3BC

OURS: dict[str, type[TD3BC]] = {"td3bc": TD3BC, "td3bc-background": BackgroundTD3BC}
ALGOS: dict[str, type[TD3BC] | type[BAKU]] = {**OURS, "bc": BC, "rot": ROT, "baku": BAKU}

_GUIDE = "regil_wrappers.RetrievalGuideWrapper"
RETRIEVAL = {
    _GUIDE: RetrievalGuideWrapper,
    "regil_wrappers.RetrievalRewardWrapper": RetrievalRewardWrapper,
}
_TAKE_DEMO = {
    **RETRIEVAL,
    "regil_sb3.baselines.ReverseForwardCurriculum": ReverseForwardCurriculum,
}
_WRAPPER_HOMES = ("regil_wrappers.", "gymnasium.wrappers.", "stable_baselines3.common.")
_NOT_SETTABLE = {
    *("env", "policy", "demo", "seed", "action_noise", "replay_buffer_class", "tensorboard_log"),
    "_init_setup_model",
}
_OWN = (
    *("n_timesteps", "n_envs", "frame_stack", "policy", "eval_episodes", "eval_freq"),
    *("env_kwargs", "env_wrapper"),
)


# PyYAML lets numbers' and dates' own errors through
_UNREADABLE = (
    OSError,
    yaml.YAMLError,
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    ArithmeticError,
    RecursionError,
)


@dataclass
class Settings:
    """Everything needed to make a run again; ``config.yaml`` of a run folder.

    Attributes:
        env: id of the environment.
        env_kwargs: for ``gymnasium.make``.
        env_wrapper: rl-zoo's list, inner first: names, or a name with its arguments.
        algo: a name of ``ALGOS``.
        preset: section of the YAML this came from.
        seed: of environments, networks and sampling.
        steps: agent steps, all environments together.
        n_envs: environments that step together.
        frame_stack: frames in an observation.
        policy: name of the policy.
        eval_episodes: unseen episodes each time that the policy is evaluated during training; 0:
            it is not, and there is no second environment to do so.
        eval_freq: agent steps between two evaluations; None: 2,500, or a sixth of a shorter run.
        hyperparams: arguments of the algorithm.
    """

    env: str
    algo: str = "td3bc"
    preset: str = "default"
    seed: int = 0
    steps: int = 15_000
    n_envs: int = 1
    frame_stack: int = 2
    policy: str = "CnnPolicy"
    eval_episodes: int = 10
    eval_freq: int | None = None
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    env_wrapper: list[Any] = field(default_factory=list)
    hyperparams: dict[str, Any] = field(default_factory=dict)

    def save(self, path: Path, **facts: Any) -> None:
        """Write ``config.yaml``; ``facts`` (encoder, versions, ...) go beside the settings."""
        versions = {name: version(name) for name in ("regil-sb3", "stable-baselines3", "torch")}
        text = yaml.safe_dump({**asdict(self), **facts, "versions": versions}, sort_keys=False)
        with replacing(path) as file:
            file.write(text.encode())

    @classmethod
    def load(cls, path: Path, trust: bool = False) -> Settings:
        """Read what ``save`` wrote.

        Args:
            path: of ``config.yaml``.
            trust: whether it may name code to run, as one's own may: an encoder, or an environment
                that would be imported out of its folder.

        Raises:
            ValueError: the file is missing or not such a file, or it names code.
        """
        try:
            read = yaml.safe_load(path.read_text(encoding="utf-8"))
            read = {"algo": "td3bc", "eval_freq": None, **read}  # which older runs do not say
            settings = cls(**{name: read[name] for name in cls.__dataclass_fields__})
            settings._check(str(read.get("versions")))
            code = [] if trust else settings._code(path.parent)
        except _UNREADABLE as error:
            raise ValueError(
                f"{path.parent} is not a run folder of `regil train` ({path.name}: {error!r})"
            ) from error
        if code:
            raise ValueError(
                f"{path} names code to run, {code[0]}: if you trust whoever made the run, "
                "trust=True (--trust)"
            )
        return settings

    def _check(self, versions: str) -> None:
        """Refuse what no version writes, or another one."""
        if self.algo not in ALGOS:
            raise ValueError(f"algo {self.algo!r} is not known here; it was made by {versions}")
        for name, kind in (("env_kwargs", dict), ("env_wrapper", list), ("hyperparams", dict)):
            if not isinstance(getattr(self, name), kind):
                raise ValueError(f"{name} is {getattr(self, name)!r:.60}")
        _check_counts(self)
        for entry in self.env_wrapper:
            _named(entry)

    def _code(self, run: Path) -> list[str]:
        """What of the config of a run's folder names a program, in whichever wrapper."""
        named = list(map(_named, self.env_wrapper))
        encoders = [str(given["encoder"]) for _, given in named if "encoder" in given]
        code = [f"encoder {name!r}" for name in encoders if runs_code(name)]
        code += [f"wrapper {name!r}" for name, _ in named if name not in _TAKE_DEMO]
        module, separator, _ = self.env.partition(":")
        if separator and _is_in(module, run):
            code.append(f"environment {self.env!r}")
        return code

    @property
    def warmup_steps(self) -> int:
        """Agent steps in which the guide acts; 0 where there are none."""
        known = inspect.signature(ALGOS[self.algo]).parameters
        default = known["warmup_steps"].default if "warmup_steps" in known else 0
        return int(self.hyperparams.get("warmup_steps", default))

    @property
    def eval_every(self) -> int:
        """Agent steps between two evaluations as it learns."""
        return self.eval_freq or max(min(self.steps // 6, 2_500), 1)

    @property
    def guide(self) -> dict[str, Any] | None:
        """Arguments of the guide's wrapper; None: there is no guide."""
        return dict(map(_named, self.env_wrapper)).get(_GUIDE)

    def retrieval(self, name: str) -> Any:
        """An argument that the retrieval wrappers share, such as ``encoder``."""
        for wrapper, arguments in map(_named, self.env_wrapper):
            if wrapper in RETRIEVAL and name in arguments:
                return arguments[name]
        return inspect.signature(RetrievalRewardWrapper).parameters[name].default

    def overridden(self, words: list[str]) -> Settings:
        """The same with "KEY=VALUE" on top, as of `make_settings`."""
        settings = copy.deepcopy(self)
        for key, value in pairs(words).items():
            _override(settings, key, value)
        return settings

    def plain(self) -> Settings:
        """The same with the demonstrator's actions and pictures as they are: the plain guide."""
        settings = copy.deepcopy(self)
        for key, value in (("correction", "none"), ("disturbance", 0.0), ("register", False)):
            _override(settings, key, value)
        return settings

    def without_guide(self) -> Settings:
        """The same for a demonstration without actions: the reward alone, as of ``ablation-rl``."""
        settings = copy.deepcopy(self)
        settings.env_wrapper = [e for e in settings.env_wrapper if _named(e)[0] != _GUIDE]
        for key, value in comparisons()["ablation-rl"].items():
            if self.policy == "CnnPolicy" or not key.startswith("policy_kwargs."):
                _override(settings, key, value)
        return settings

    def defaults(self) -> dict[str, dict[str, Any]]:
        """What algorithm and wrappers take where nothing is said, by the names of their classes.

        Another version may take other values: with the settings these are all that a run has.
        """
        algorithm = ALGOS[self.algo]
        policy = algorithm.policy_aliases.get(self.policy)
        made = [(algorithm, self.hyperparams), *self.wrappers("")]
        made += [] if policy is None else [(policy, self.hyperparams.get("policy_kwargs") or {})]
        return {
            of.__name__: {
                name: _plain(argument.default)
                for name, argument in inspect.signature(of).parameters.items()
                if name not in given and argument.default is not argument.empty and name[0] != "_"
            }
            for of, given in made
        }

    def wrappers(self, demo: str) -> list[tuple[Any, dict[str, Any]]]:
        """Wrapper classes with their arguments, inner first; ours get ``demo``.

        Raises:
            ValueError: a name that is no wrapper of the packages allowed here.
        """
        out = []
        for name, arguments in map(_named, self.env_wrapper):
            if name in _TAKE_DEMO:
                out.append((_TAKE_DEMO[name], {**arguments, "demo": demo}))
                continue
            if not str(name).startswith(_WRAPPER_HOMES):
                raise ValueError(
                    f"env_wrapper {name!r}: wrappers named in YAML come from "
                    f"{', '.join(home.rstrip('.') for home in _WRAPPER_HOMES)}; "
                    "use another one from Python"
                )
            module, _, attribute = name.rpartition(".")
            try:
                found = getattr(import_module(module), attribute)
            except (ImportError, AttributeError) as error:
                raise ValueError(f"env_wrapper {name!r} does not exist: {error}") from error
            if not (isinstance(found, type) and issubclass(found, gym.Wrapper)):
                raise ValueError(f"env_wrapper {name!r} is no gymnasium.Wrapper")
            out.append((found, arguments))
        return out


def presets() -> dict[str, Any]:
    """The sections of ``zoo_configs/td3bc.yml``."""
    return _zoo_config("td3bc.yml")


def comparisons() -> dict[str, Any]:
    """The sections of ``zoo_configs/baselines.yml``: what each changes of an environment's own."""
    return _zoo_config("baselines.yml")


def _zoo_config(name: str) -> dict[str, Any]:
    return copy.deepcopy(_read_zoo_config(name))


@cache
def _read_zoo_config(name: str) -> dict[str, Any]:
    text = (resources.files("regil_sb3.zoo_configs") / name).read_text(encoding="utf-8")
    sections: dict[str, Any] = yaml.safe_load(text)
    return sections


def make_settings(
    env: str,
    preset: str | None = None,
    seed: int = 0,
    steps: int | None = None,
    overrides: list[str] | None = None,
    algo: str | None = None,
) -> Settings:
    """Take a preset, and put ``KEY=VALUE`` overrides on top.

    Args:
        env: id of the environment.
        preset: a section of ``presets()``, or of ``comparisons()`` on top of the environment's own;
            None takes the environment's own, else "default".
        seed: see ``Settings``.
        steps: agent steps; None takes the preset's.
        overrides: "KEY=VALUE" with VALUE as YAML. KEY is an argument of the algorithm or of the
            retrieval wrappers, ``env_kwargs.NAME``, ``policy_kwargs.NAME``, or ``n_timesteps``
            (steps), ``n_envs``, ``frame_stack``, ``policy``, ``eval_episodes`` or ``eval_freq`` of
            ``Settings``. With a policy other than "CnnPolicy" no frames are stacked and none of the
            preset's ``policy_kwargs`` are taken, with "MultiInputPolicy" ``n_steps`` is 1, unless
            they are given, too. An encoder's file is kept with its path from the root.
        algo: a name of ``ALGOS``; None takes the preset's. One that is not ours takes the preset of
            its name, where none is given.

    Raises:
        ValueError: an unknown preset or key, or a preset of another algorithm.
    """
    sections, compared = presets(), comparisons()
    own = env if env in sections else "default"
    preset = preset or (own if algo is None or algo in OURS else algo)
    if preset not in sections and preset not in compared:
        names = ", ".join([*sections, *compared])
        raise ValueError(f"preset {preset!r} is unknown: use one of {names}")
    changes = dict(compared.get(preset, {}))
    section = copy.deepcopy(sections[own if preset in compared else preset])
    settings = Settings(env, changes.pop("algo", "td3bc"), preset, seed)
    if algo in OURS and settings.algo in OURS:
        settings.algo = algo
    elif algo not in (None, settings.algo):
        raise ValueError(f"--algo {algo}: preset {preset!r} is of {settings.algo}, leave one out")
    known = inspect.signature(ALGOS[settings.algo]).parameters
    settings.steps = section.pop("n_timesteps", settings.steps)
    for name in _OWN[1:]:
        if name in section:
            setattr(settings, name, section.pop(name))
    settings.hyperparams = section
    settings.hyperparams.pop("demo", None)  # the run folder's own copy is used
    if settings.algo not in OURS:  # another algorithm takes what it shares with ours
        settings.hyperparams = {k: v for k, v in settings.hyperparams.items() if k in known}
    settings.env_wrapper += changes.pop("env_wrapper", [])  # outside the others
    given = pairs(overrides or [])
    policy = given.get("policy", settings.policy)
    if policy != "CnnPolicy":  # other policies have no encoder that could be shared
        changes = {k: v for k, v in changes.items() if not k.startswith("policy_kwargs.")}
        if policy != settings.policy:  # the preset is made for pictures
            settings.frame_stack = 1
            settings.hyperparams.pop("policy_kwargs", None)
            if policy == "MultiInputPolicy" and "n_steps" in known:
                settings.hyperparams["n_steps"] = 1
    for key, value in {**changes, **given}.items():
        _override(settings, key, value)
    for entry in settings.env_wrapper:  # the run may be gone on with from another folder
        for arguments in entry.values() if isinstance(entry, dict) else ():
            if isinstance(encoder := (arguments or {}).get("encoder"), str):
                arguments["encoder"] = absolute(encoder)
    if steps is not None:
        settings.steps = steps
    _check_counts(settings)
    for name in settings.hyperparams:
        if name not in known:
            what = ALGOS[settings.algo].__name__
            raise ValueError(f"preset {preset!r}: {name!r} is no argument of {what}")
    return settings


def _check_counts(settings: Settings) -> None:
    for name in ("steps", "n_envs", "frame_stack", "eval_episodes", "eval_freq"):
        value = getattr(settings, name)
        if name == "eval_freq" and value is None:
            continue
        least = 0 if name == "eval_episodes" else 1
        if type(value) is not int or value < least:
            raise ValueError(f"{name} is {value!r}: it must be a whole number of at least {least}")


def pairs(words: list[str]) -> dict[str, Any]:
    """Read ["KEY=VALUE", ...], each VALUE as plain YAML.

    Raises:
        ValueError: a word without "=", or no YAML behind it.
    """
    out = {}
    for word in words:
        key, separator, text = word.partition("=")
        try:
            if not separator:
                raise ValueError
            out[key.strip()] = _value(text)
        except (ValueError, yaml.YAMLError):
            raise ValueError(f"{word!r}: write KEY=VALUE, with VALUE as YAML") from None
    return out


def _value(text: str) -> Any:
    value = yaml.safe_load(text)
    if isinstance(value, str):  # YAML 1.1 reads 3e-4 and 1e5 as text
        try:
            number = float(value)
        except ValueError:
            return value
        return int(number) if number.is_integer() and "." not in value else number
    return value


def _plain(value: Any) -> Any:
    """As YAML holds it; of what it does not, the name."""
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if value is None or isinstance(value, str | bool | int | float):
        return value
    return getattr(value, "__name__", str(value))


def _is_in(module: str, run: Path) -> bool:
    """Whether Python would import a module, or the package that has it, out of a run's folder."""
    try:
        spec = find_spec(module.partition(".")[0])
    except ValueError:  # no name of a module
        return False
    if spec is None:
        return False
    run = run.resolve()
    places = [Path(p).resolve() for p in spec.submodule_search_locations or [spec.origin or "."]]
    return any(run in (p, *p.parents) or p in run.parents for p in places)


def _named(entry: Any) -> tuple[str, dict[str, Any]]:
    """A wrapper of ``env_wrapper``: its name, and the arguments that it is given."""
    pairs = list(entry.items()) if isinstance(entry, dict) else [(entry, None)]
    if len(pairs) != 1 or not isinstance(pairs[0][1], dict | None):
        raise ValueError(f"env_wrapper has {entry!r}: write NAME, or NAME: {{ARGUMENT: VALUE}}")
    name, given = pairs[0]
    return name, dict(given or {})


def encoder_size(settings: Settings) -> int | None:
    """Picture size that the run's encoder wants, or None if the observation's will do."""
    size: int | None = getattr(make_encoder(settings.retrieval("encoder")), "frame_size", None)
    return size


def _override(settings: Settings, key: str, value: Any) -> None:
    model = set(inspect.signature(ALGOS[settings.algo]).parameters) - _NOT_SETTABLE
    wrappers = {n for c in RETRIEVAL.values() for n in inspect.signature(c).parameters}
    wrappers -= {"env", "demo"}
    own = set(_OWN[:6])
    if key.startswith("env_kwargs."):
        settings.env_kwargs[key.removeprefix("env_kwargs.")] = value
    elif key.startswith("policy_kwargs."):
        name = key.removeprefix("policy_kwargs.")
        settings.hyperparams.setdefault("policy_kwargs", {})[name] = value
    elif key == "policy_kwargs" and not isinstance(value, dict):
        raise ValueError(f"policy_kwargs={value!r}: write policy_kwargs.NAME=VALUE")
    elif key == "n_timesteps":
        settings.steps = value
    elif key in own:
        setattr(settings, key, value)
    elif key in model:
        settings.hyperparams[key] = value
    elif key in wrappers:
        for i, (name, given) in enumerate(map(_named, settings.env_wrapper)):
            if name in RETRIEVAL and key in inspect.signature(RETRIEVAL[name]).parameters:
                settings.env_wrapper[i] = {name: {**given, key: value}}
    else:
        near = difflib.get_close_matches(key, model | wrappers | own, n=3)
        hint = f": did you mean {' or '.join(near)}?" if near else ""
        raise ValueError(f"--set {key}: no setting has that name{hint}")
