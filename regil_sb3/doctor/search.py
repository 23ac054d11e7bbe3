"""Which encoder, k and horizon suit a demonstration: tried on episodes that were played already.

* ``Filmed`` - keeps the pictures of an episode
* ``search`` - aligns and rewards them anew with each setting, then lets the best guide
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from regil_wrappers import Demonstration, Retriever, make_encoder
from regil_wrappers.encoders import encoders_at_hand
from regil_wrappers.frames import FrameSource
from regil_wrappers.registration import moved_back, register
from regil_wrappers.reward_signals import make_signal

from regil_sb3.doctor.episodes import Played
from regil_sb3.doctor.findings import Finding, listed
from regil_sb3.doctor.rewards import Reward, judged
from regil_sb3.settings import Settings

__all__ = ["Filmed", "Setting", "candidates", "search"]

Picture = npt.NDArray[np.uint8]

_KS = (1, 5, 10)
_HORIZONS = (0, 2, 4, 9)
_GUIDES = 3  # settings that guide episodes
# By so much another setting must be better to be recommended: of the shares that rank a reward, and
# of the correlation of reward and time
_CLEARLY, _IN_ORDER = 0.05, 0.2


class Filmed(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps the pictures of the current episode, in every size that an encoder may want.

    Args:
        env: without retrieval wrappers.
        demo: whose sizes they have.
        image: where they come from.
    """

    def __init__(self, env: gym.Env[Any, Any], demo: Demonstration, image: str) -> None:
        super().__init__(env)
        small, large = (FrameSource(env, demo, "the demonstration", image) for _ in range(2))
        self._sources = [small, large] if large.use_encoder_frames() else [small]
        self.film: list[list[Picture]] = []

    def _keep(self, observation: Any) -> None:
        for source, film in zip(self._sources, self.film, strict=True):
            film.append(np.array(source.picture(source.raw(observation))))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin a film."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.film = [[] for _ in self._sources]
        self._keep(observation)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Go on with it."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._keep(observation)
        return observation, reward, terminated, truncated, info


@dataclass(frozen=True)
class Setting:
    """One choice, and what came of it.

    Attributes:
        encoder: its name.
        k: candidates.
        horizon: H.
        reward: how the settings' reward ranks what was played.
        milliseconds: of encoding one picture.
        guided: successes of plain guided replay; None where it was not tried.
    """

    encoder: str
    k: int
    horizon: int
    reward: Reward
    milliseconds: float
    guided: tuple[bool, ...] | None = None

    @property
    def words(self) -> str:
        """For `--set`."""
        return f"--set encoder={self.encoder} --set k={self.k} --set horizon={self.horizon}"

    @property
    def rank(self) -> tuple[float, ...]:
        """The larger, the better: guided successes, then the reward, then what is usual."""
        return (sum(self.guided or ()), *self.reward.rank)


def candidates(given: Sequence[str], settings: Settings) -> list[str]:
    """Encoders to try: those given, else those that need no download; the settings' own first."""
    own = str(settings.retrieval("encoder"))
    return list(dict.fromkeys([own, *(given or encoders_at_hand())]))


def search(
    demo: Demonstration,
    settings: Settings,
    encoders: Sequence[str],
    groups: Sequence[Sequence[Played]],
    gamma: float,
    guide: Callable[[Settings], list[bool]],
    say: Callable[[str], None],
) -> tuple[list[Finding], str]:
    """Try encoders, k and horizon; cheap first.

    Every setting aligns and rewards the same pictures anew; then the best of them, and what the
    settings have now, guide episodes plainly (a correction looks at pictures, not at embeddings).

    Args:
        demo: the demonstration.
        settings: those of now; their reward is judged.
        encoders: names.
        groups: successes, failures and standing still, with their films.
        gamma: discount factor.
        guide: settings -> successes of plain guided replay.
        say: called with what is done next.

    Returns:
        a finding for each encoder, and what to set: "" where nothing is clearly better.
    """
    found: list[Finding] = []
    tried: list[Setting] = []
    for name in encoders:
        say(f"trying encoder {name}")
        try:
            tried += _of_encoder(name, demo, settings, groups, gamma)
        except (ImportError, ValueError) as error:
            why = str(error).partition(": choose")[0]
            found.append(Finding(f"encoder {name}", "ok", f"not tried: {why}"))
    if not tried:
        return found, ""
    own = (settings.retrieval("encoder"), settings.retrieval("k"), settings.retrieval("horizon"))
    best_first = sorted(tried, key=lambda s: (s.reward.rank, _usual(s, own)), reverse=True)
    # Of each encoder one, and what is set now
    chosen = {s.encoder: s for s in reversed(best_first)}
    guides = sorted(chosen.values(), key=lambda s: s.reward.rank, reverse=True)[:_GUIDES]
    guides += [s for s in tried if (s.encoder, s.k, s.horizon) == own and s not in guides]
    if demo.actions is not None:
        for i, setting in enumerate(guides):
            say(f"guided by {setting.words.replace('--set ', '')}")
            guides[i] = replace(setting, guided=tuple(guide(_with(settings, setting))))
    for setting in sorted(chosen.values(), key=lambda s: encoders.index(s.encoder)):
        here = [s for s in guides if s.encoder == setting.encoder] or [setting]
        found += [Finding(f"encoder {s.encoder}", "ok", _line(s)) for s in here]
    now = next((s for s in guides if (s.encoder, s.k, s.horizon) == own), None)
    best = max(guides, key=lambda s: (s.rank, _usual(s, own)))
    return found, best.words if now is None or _clearly(best, now) else ""


def _clearly(best: Setting, now: Setting) -> bool:
    """More guided successes, or as many and a reward that ranks better."""
    more = sum(best.guided or ()) - sum(now.guided or ())
    (ranks, order), (ranked, ordered) = best.reward.rank, now.reward.rank
    better = ranks > ranked + _CLEARLY or (ranks >= ranked and order > ordered + _IN_ORDER)
    return more > 1 or (more >= 0 and better)


def _usual(setting: Setting, own: tuple[Any, ...]) -> tuple[bool, ...]:
    """Among equals the settings of now, one after the other."""
    return tuple(
        a == b for a, b in zip((setting.encoder, setting.k, setting.horizon), own, strict=True)
    )


def _line(s: Setting) -> str:
    failure = "" if np.isnan(s.reward.above_failure) else f"failure {s.reward.above_failure:.0%}, "
    line = (
        f"k {s.k}, horizon {s.horizon}: success above {failure}standing still "
        f"{s.reward.above_still:.0%}, order {s.reward.order:+.2f}, freezing beats finishing in "
        f"{s.reward.freezing:.0%}, {s.milliseconds:.1f} ms a picture"
    )
    return line if s.guided is None else f"{line}; plain guided replay {listed(s.guided)}"


def _with(settings: Settings, setting: Setting) -> Settings:
    return settings.overridden(
        [f"encoder={setting.encoder}", f"k={setting.k}", f"horizon={setting.horizon}"]
    )


def _of_encoder(
    name: str,
    demo: Demonstration,
    settings: Settings,
    groups: Sequence[Sequence[Played]],
    gamma: float,
) -> Iterator[Setting]:
    encoder = make_encoder(name)
    larger = getattr(encoder, "frame_size", None) is not None and demo.encoder_frames is not None
    recorded = demo.encoder_frames if larger and demo.encoder_frames is not None else demo.frames
    moves_back = bool(settings.retrieval("register"))
    embedded: list[list[npt.NDArray[np.float32]]] = []
    base = Retriever(demo, encoder, 1, 0, use_encoder_frames=larger, search="exact")
    seconds, pictures = 0.0, 0
    for group in groups:
        embedded.append([])
        for played in group:
            film = recorded  # of the demonstration itself, played for want of a success
            if played.film:
                film = np.stack(played.film[1 if larger else 0])
            if moves_back:
                shift = register(recorded[0], film[0])
                film = np.stack([moved_back(frame, shift) for frame in film])
            begun = time.perf_counter()
            embedded[-1].append(np.concatenate([base.encoder.encode(f[None]) for f in film]))
            seconds, pictures = seconds + time.perf_counter() - begun, pictures + len(film)
    limit = max(len(film) - 1 for group in embedded[1:] for film in group)
    reward = settings.retrieval("reward")
    for k, horizon in itertools.product(
        _tried(_KS, "k", settings), _tried(_HORIZONS, "horizon", settings)
    ):
        if k > len(demo) or horizon >= len(demo):
            continue
        retriever = Retriever(demo, encoder, k, horizon, use_encoder_frames=larger, search="exact")
        signal = make_signal(reward, retriever)
        judged_groups = [[_rewarded(retriever, signal, reward, e) for e in g] for g in embedded]
        successes, failures, still = judged_groups
        yield Setting(
            name,
            k,
            horizon,
            judged(reward, successes, failures, still, gamma, limit),
            1000 * seconds / pictures,
        )


def _tried(values: Sequence[int], name: str, settings: Settings) -> list[int]:
    return sorted({*values, settings.retrieval(name)})


def _rewarded(
    retriever: Retriever, signal: Any, name: str, embedded: npt.NDArray[np.float32]
) -> Played:
    retriever.reset()
    rewards: list[float] = []
    for t, embedding in enumerate(embedded):
        retriever.step_embedding(embedding)
        if t == 0:
            signal.begin()
        else:
            rewards.append(signal.step())
    return Played(rewards={name: rewards}, embeddings=list(embedded))
