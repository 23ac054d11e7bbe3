"""`regil doctor`: can this demonstration work in this environment? Said before any training.

* ``examine`` - findings, from a demonstration, an environment and a run's settings
* ``main`` - the same as a table, a page and an exit status
"""

from __future__ import annotations

import inspect
import shutil
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from regil_wrappers import Demonstration, RetrievalGuideWrapper, RetrievalRewardWrapper
from regil_wrappers.encoders import embed
from regil_wrappers.frames import FrameSource, stated
from regil_wrappers.retrieval_wrapper import make_retriever, settings_of
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

import regil_sb3  # registers the environments  # noqa: F401
from regil_sb3.as_seen import as_seen
from regil_sb3.doctor.cost import check_cost
from regil_sb3.doctor.episodes import (
    Act,
    Played,
    check_guide,
    check_replay,
    check_success,
    play,
)
from regil_sb3.doctor.findings import Finding, listed, status, table
from regil_sb3.doctor.page import write_page
from regil_sb3.doctor.pictures import (
    check_actions,
    check_motion,
    check_pictures,
    check_recorded,
    check_scene,
)
from regil_sb3.doctor.rewards import Reward, check_reward, judged, played_demonstration, signals
from regil_sb3.doctor.search import Filmed, candidates, search
from regil_sb3.envs import exists_once
from regil_sb3.evaluation import SELECTION_SEED
from regil_sb3.process import keep_freed_memory
from regil_sb3.settings import RETRIEVAL, Settings, make_settings
from regil_sb3.td3bc import TD3BC

__all__ = ["examine", "main"]

Env = gym.Env[Any, Any]
Embeddings = npt.NDArray[np.float32]
Say = Callable[[str], None]

_RESETS = 10  # fresh first pictures
_CALIBRATIONS = 10  # episodes that calibration may take
_OTHERS = 3  # disturbed episodes, and as many of standing still
_PUSHED = 0.5  # of the steps of a disturbed episode have a random action


def examine(
    settings: Settings | str,
    demo: Demonstration | str | Path,
    episodes: int = 5,
    progress: Say | None = None,
    encoders: Sequence[str] | None = None,
) -> list[Finding]:
    """Examine a demonstration for an environment.

    First what pictures and actions say; then, where the retrieval wrappers would take the
    demonstration, episodes: its actions replayed, the guide plain and corrected, a disturbed guide,
    standing still. Their seeds are those that training selects its best model on, not those of its
    evaluation. Last a learner learns for a moment, as training lets it, for memory and time.

    Example:
        >>> from regil_sb3 import doctor
        >>> found = doctor.examine("regil/metaworld-button-press-v0", "mine.hdf5")  # doctest: +SKIP
        >>> [f.line for f in found if f.verdict == "wrong"]  # doctest: +SKIP
        []

    Args:
        settings: of a run, as `make_settings` makes them; or an environment's id, for the default.
        demo: the demonstration, or its file.
        episodes: of the guide, plain and corrected each; at least 1.
        progress: called with what is done next.
        encoders: to try, each with several k and horizon; none: those that need no download. None
            tries nothing.

    Returns:
        a finding for each check that could be made.

    Raises:
        ValueError: if there are no such settings, no demonstration in the file, or no episodes.
        gymnasium.error.Error: if there is no such environment.
    """
    if episodes < 1:
        raise ValueError(f"--episodes is {episodes}: at least 1 is needed")
    settings = make_settings(settings) if isinstance(settings, str) else settings
    demo = demo if isinstance(demo, Demonstration) else Demonstration.load(demo)
    say = progress or (lambda line: None)
    env = _bare(settings)
    if exists_once(env):
        settings = replace(settings, eval_episodes=0)  # as training does
    try:
        say("comparing pictures and actions")
        found, embedded = _seen(env, demo, settings)
        if embedded is None or any(f.verdict == "wrong" and f.check != "scene" for f in found):
            line = "none were played: first put right what is wrong"
            return [*found, Finding("episodes", "warning", line)]
        if not isinstance(env.action_space, gym.spaces.Box):
            line = f"none were played: actions are {env.action_space}, not continuous (a Box)"
            return [*found, Finding("episodes", "warning", line)]
        found += _Episodes(env, demo, settings, episodes, say, encoders).examined(embedded)
        # Where something is wrong, settings are no cure
        return [f for f in found if f.check != "recommended" or not status(found)]
    finally:
        env.close()


def _bare(settings: Settings) -> Env:
    """The environment as the retrieval wrappers get it."""
    kwargs = dict(settings.env_kwargs)
    if settings.retrieval("image") == "render":
        kwargs.setdefault("render_mode", "rgb_array")
    try:
        env = gym.make(settings.env, **kwargs)
        for wrapper, arguments in settings.wrappers(""):
            if wrapper in RETRIEVAL.values():
                break
            env = wrapper(env, **arguments)
    except TypeError as error:
        raise ValueError(f"{settings.env} cannot be made with these settings: {error}") from error
    return env


def _seen(
    env: Env, demo: Demonstration, settings: Settings
) -> tuple[list[Finding], Embeddings | None]:
    """What can be said without a step, and the demonstration's embeddings if pictures compare."""
    found = check_recorded(env, demo)
    found += check_actions(demo, env.action_space)
    found += _observations(env, demo, settings.frame_stack)
    names = inspect.signature(settings_of).parameters
    own = {name: settings.retrieval(name) for name in names if name != "demo"}
    try:
        source = FrameSource(env, demo, "the demonstration", own["image"])
    except ValueError as error:
        return [*found, Finding("pictures", "wrong", str(error))], None
    try:
        retriever = make_retriever([demo], own, source)
    except ValueError as error:
        return [*found, Finding("retrieval", "wrong", str(error))], None
    embedded = retriever.embeddings
    gripper = _gripper(env)
    found += check_motion(demo, embedded, own["horizon"], env.action_space, gripper)
    finding, firsts = check_pictures(env, source, [SELECTION_SEED + i for i in range(_RESETS)])
    found.append(finding)
    if not firsts:
        return found, None
    fresh = embed(retriever.encoder, np.stack(firsts))
    found += check_scene(demo, source.recorded_first, firsts, embedded, fresh, settings.env)
    # Frames that are all the same reward nothing
    return found, embedded if np.ptp(embedded, axis=0).any() else None


def _observations(env: Env, demo: Demonstration, n_stack: int) -> list[Finding]:
    """Whether a policy that sees no picture finds its observations in the demonstration."""
    space, box = env.observation_space, env.action_space
    if is_image_space(space) or demo.actions is None or not isinstance(box, gym.spaces.Box):
        return []
    if n_stack > 1 and isinstance(space, gym.spaces.Box | gym.spaces.Dict):
        space = StackedObservations(1, n_stack, space).stacked_observation_space
    try:
        as_seen(demo, space, box, n_stack)
    except ValueError as error:
        return [Finding("observations", "warning", f"TD3BC cannot clone it: {error}")]
    return [Finding("observations", "ok", "those of a policy without camera are in it")]


def _gripper(env: Env) -> int | None:
    """Which dimension of an action moves the gripper, as far as the environment says."""
    dim = stated(env.unwrapped.metadata).get("gripper_dim")
    return dim if isinstance(dim, int) else None


class _Episodes:
    """Plays what has to be played. The environment serves one wrapper after the other."""

    def __init__(
        self,
        env: Env,
        demo: Demonstration,
        settings: Settings,
        episodes: int,
        say: Say,
        encoders: Sequence[str] | None,
    ) -> None:
        self._encoders = None if encoders is None else candidates(encoders, settings)
        if encoders is not None:
            env = Filmed(env, demo, settings.retrieval("image"))
        self._env, self._demo, self._settings, self._say = env, demo, settings, say
        self._seeds = [SELECTION_SEED + i for i in range(episodes)]
        self._longest = max(200, 5 * len(demo))
        self._steps, self._seconds, self._says = 0, 0.0, False

    def examined(self, embedded: Embeddings) -> list[Finding]:
        """Findings, from the demonstration's embeddings on."""
        found, plain, corrected = [], None, None
        env: Any
        if self._demo.actions is None:
            own = self._arguments(self._settings, RetrievalRewardWrapper)
            env = RetrievalRewardWrapper(self._env, self._demo, **own)
            guided = []
        else:
            self._say("replaying the demonstration's actions")
            own = self._arguments(self._settings.plain(), RetrievalGuideWrapper)
            env = RetrievalGuideWrapper(self._env, self._demo, **own)
            seed = self._demo.metadata["seed"]
            seed = self._seeds[0] if seed is None else seed
            found.append(check_replay(env, self._demo, embedded, seed))
            plain = [p.success for p in self._guided("plain guide", env)]
            env, said = self._correcting()
            if not said:
                self._calibrate(env)
            state = env.calibration() or {}
            what = "guide as set up" if said else "corrected guide"
            guided = self._guided(what, env, watched=True)
            said = said or state.get("why", "")
            if state.get("cameras"):
                corrected = [p.success for p in guided]
            elif not said:
                said = f"calibration did not end in {_CALIBRATIONS} episodes"
            found.append(check_guide(plain, corrected, said))
        rewards = self._rewards(env, guided)
        found += check_success(self._says)
        none = "nothing was replayed" if plain is None else "no replay failed"
        found += check_reward(rewards, self._settings.retrieval("reward"), none)
        words = ""
        if self._encoders is not None:
            more, words = search(
                self._demo,
                self._settings,
                self._encoders,
                self._groups,
                self._gamma,
                self._guided_by,
                self._say,
            )
            found += more
        found.append(_recommended(rewards, plain, corrected, words))
        self._say("a learner, for a moment")
        found += check_cost(
            self._env, self._demo, self._settings, self._seconds / self._steps, self._limit
        )
        return found

    def _arguments(self, settings: Settings, wrapper: Any) -> dict[str, Any]:
        """Those that the settings have for a retrieval wrapper; what they share is the same."""
        given: dict[str, Any] = {}
        for other, arguments in settings.wrappers(""):
            if other in RETRIEVAL.values():
                given |= arguments
        known = inspect.signature(wrapper).parameters
        own = {name: value for name, value in given.items() if name in known and name != "demo"}
        return {**own, "search": "exact"}  # some rewards look at all frames

    def _correcting(self) -> tuple[RetrievalGuideWrapper[Any, Any], str]:
        """The guide of the settings, corrected if that can be, and why it cannot."""
        own = self._arguments(self._settings, RetrievalGuideWrapper)
        own |= {"correction": "servo", "disturbance": 0.0}
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", UserWarning)
            try:
                env = RetrievalGuideWrapper(self._env, self._demo, **own)
            except ValueError as error:  # what the settings declare cannot be
                plain = RetrievalGuideWrapper(
                    self._env, self._demo, **{**own, "correction": "none"}
                )
                return plain, str(error)
        return env, "; ".join(str(w.message) for w in said)

    def _calibrate(self, env: RetrievalGuideWrapper[Any, Any]) -> None:
        self._say("calibrating the corrected guide")
        for i in range(_CALIBRATIONS):
            if env.calibration() is not None:
                return
            self._play(env, self._seeds[-1] + 1 + i, lambda _: env.guide_action())
        env.reset(seed=self._seeds[-1])  # an episode that was cut short counts when the next begins

    def _guided(self, what: str, env: Any, watched: bool = False) -> list[Played]:
        played = []
        for i, seed in enumerate(self._seeds):
            self._say(f"{what}, episode {i + 1} of {len(self._seeds)}")
            played.append(self._play(env, seed, lambda _: env.guide_action(), watched))
        return played

    def _play(self, env: Any, seed: int, act: Act, watched: bool = False) -> Played:
        rewards = signals(env.retriever) if watched else None
        with warnings.catch_warnings():
            # What the guide says of itself is in its state, and a moved camera a finding already
            warnings.simplefilter("ignore", UserWarning)
            played = play(env, seed, act, rewards, self._longest)
        self._steps, self._seconds = self._steps + played.steps, self._seconds + played.seconds
        self._says |= played.says
        return played

    def _rewards(self, env: Any, guided: Sequence[Played]) -> list[Reward]:
        """Judge each reward on guided successes, disturbed failures and standing still."""
        space = self._env.action_space
        assert isinstance(space, gym.spaces.Box)
        rng = np.random.default_rng(0)
        space.seed(0)
        idle = np.clip(np.zeros(space.shape, np.float32), space.low, space.high)
        gripper = _gripper(self._env)
        if gripper is not None and self._demo.actions is not None:
            idle[gripper] = self._demo.actions[0, gripper]

        def pushed(_: int) -> npt.NDArray[np.float32]:
            if rng.random() < _PUSHED:
                return np.asarray(space.sample(), np.float32)
            action: npt.NDArray[np.float32] = env.guide_action()
            return action

        self._say("a disturbed guide, and standing still")
        others = self._seeds[:_OTHERS]
        still = [self._play(env, seed, lambda _: idle, watched=True) for seed in others]
        disturbed = [self._play(env, s, pushed, watched=True) for s in others if guided]
        successes = [p for p in guided if p.success]
        successes = successes or [played_demonstration(env.retriever)]
        failures = [p for p in (*guided, *disturbed) if not p.success]
        self._limit = max(p.steps for p in (*still, *failures))
        self._groups = successes, failures, still
        return [
            judged(name, successes, failures, still, self._gamma, self._limit)
            for name in successes[0].rewards
        ]

    @property
    def _gamma(self) -> float:
        return float(self._settings.hyperparams.get("gamma", _default("gamma")))

    def _guided_by(self, settings: Settings) -> list[bool]:
        """Successes of plain guided replay with other settings."""
        own = self._arguments(settings.plain(), RetrievalGuideWrapper)
        env: Any = RetrievalGuideWrapper(self._env, self._demo, **own)
        return [played.success for played in self._guided("plain guide", env)]


def _default(name: str) -> Any:
    return inspect.signature(TD3BC).parameters[name].default


def _recommended(
    rewards: Sequence[Reward],
    plain: list[bool] | None,
    corrected: list[bool] | None,
    searched: str,
) -> Finding:
    """What to set."""
    words = [f"--set reward={max(rewards, key=lambda reward: reward.rank).name}"]
    if plain is not None:
        without, with_it = sum(plain), sum(corrected or [])
        if with_it > without:
            words.append("--set correction=servo")
        elif without > with_it:
            words.append("--set correction=none --set disturbance=0")
    return Finding("recommended", "ok", " ".join([*words, *([searched] if searched else [])]))


def main(
    env: str,
    demo: Path,
    episodes: int = 5,
    overrides: Iterable[str] = (),
    preset: str | None = None,
    html: Path | None = None,
    encoders: Sequence[str] | None = None,
) -> int:
    """Examine, print a table, write a page.

    Args:
        env: id of the environment.
        demo: the demonstration's file.
        episodes: of the guide, plain and corrected each.
        overrides: "KEY=VALUE", as of `make_settings`.
        preset: a section of ``zoo_configs/td3bc.yml`` or ``baselines.yml``.
        html: file of the page; None writes none.
        encoders: as of `examine`.

    Returns:
        0 where nothing is wrong, 1 where something is.

    Raises:
        ValueError: as for `examine`.
    """
    settings = make_settings(env, preset, overrides=list(overrides))
    read = Demonstration.load(demo)
    keep_freed_memory()  # as training does

    def say(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    found = examine(settings, read, episodes, say, encoders)
    print(table(found, shutil.get_terminal_size((100, 24)).columns))
    counts = {v: [f.verdict == v for f in found] for v in ("wrong", "warning", "ok")}
    print("\n" + ", ".join(f"{listed(c)} {v}" for v, c in counts.items()))
    if html is not None:
        write_page(html, f"{env}: {demo.name}", found, read)
        print(f"page: {html}")
    return status(found)
