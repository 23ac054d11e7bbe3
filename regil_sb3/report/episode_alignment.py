"""An evaluation episode as a run's retriever saw it.

* ``AlignedEpisode`` - distances, warping paths and rewards
* ``align`` - from the two films and the run's settings
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from regil_wrappers import Demonstration, Retriever
from regil_wrappers.alignment import squared_distances
from regil_wrappers.encoders import embed, runs_code
from regil_wrappers.registration import moved_back, register
from regil_wrappers.reward_signals import make_signal

__all__ = ["AlignedEpisode", "align"]

_WRAPPERS = ("RetrievalGuideWrapper", "RetrievalRewardWrapper")


class AlignedEpisode(NamedTuple):
    """The evaluation episode seen by the retriever, frame by frame.

    Attributes:
        distances: (episode frames, demonstration frames) float64, >= 0.
        ends: the demonstration frame that each episode frame is aligned with.
        paths: of each episode frame the warping path of the window that ends with it: (episode
            frame, demonstration frame).
        reward: the reward's name.
        rewards: (episode frames - 1,) of the step that led to each frame after the first.
    """

    distances: npt.NDArray[np.float64]
    ends: list[int]
    paths: list[list[tuple[int, int]]]
    reward: str
    rewards: list[float]


def align(demo: Demonstration, episode: Demonstration, config: dict[str, Any]) -> AlignedEpisode:
    """Walk the retriever through the episode's frames, with the run's own settings.

    Args:
        demo: the run's demonstration.
        episode: frames of the same camera.
        config: ``config.yaml``: ``encoder``, ``k``, ``horizon``, and the retrieval wrappers'
            arguments in ``env_wrapper``.

    Raises:
        ValueError: if they do not fit, or the encoder would run code.
        ImportError: if the encoder needs a package that is not installed.
    """
    own = _arguments(config)
    settings = {key: own[key] for key in ("encoder", "k", "horizon", "step_pattern") if key in own}
    if runs_code(str(settings.get("encoder", "pixels"))):
        # The folder may be someone else's, and a report promises to run nothing of it.
        raise ValueError(
            f"encoder {settings['encoder']!r} names code to run, and a report runs none"
        )
    retriever = Retriever(demo, **settings, search="exact")
    recorded, frames = demo.frames, episode.frames
    if getattr(retriever.encoder, "frame_size", None) and demo.encoder_frames is not None:
        if episode.encoder_frames is None:
            raise ValueError("episode.hdf5 has no encoder_frames, which this encoder reads")
        retriever = Retriever(demo, **settings, search="exact", use_encoder_frames=True)
        recorded, frames = demo.encoder_frames, episode.encoder_frames
    if own.get("register") is True:
        found = register(recorded[0], frames[0])
        frames = np.stack([moved_back(frame, found) for frame in frames])
    name = str(own.get("reward", "sdtw"))
    signal = make_signal(name, retriever, retriever.horizon if _by_horizon(own) else None)
    embeddings = embed(retriever.encoder, frames)
    ends: list[int] = []
    paths: list[list[tuple[int, int]]] = []
    rewards: list[float] = []
    for t, embedding in enumerate(embeddings):
        alignment = retriever.step_embedding(embedding)
        first = t - alignment.window + 1
        ends.append(alignment.end)
        paths.append([(first + row, j) for row, j in retriever.path()])
        if t == 0:
            signal.begin()
        else:
            rewards.append(signal.step())
    late = signal.end()
    distances = np.stack([squared_distances(row, retriever.embeddings) for row in embeddings])
    return AlignedEpisode(
        distances, ends, paths, name, rewards if late is None else late.astype(float).tolist()
    )


def _by_horizon(own: dict[str, Any]) -> bool:
    return own.get("divisor") == "horizon"


def _arguments(config: dict[str, Any]) -> dict[str, Any]:
    """The retrieval wrappers' own, the settings' common ones last."""
    own: dict[str, Any] = {}
    entries = config.get("env_wrapper")
    for entry in entries if isinstance(entries, list) else []:
        for name, arguments in entry.items() if isinstance(entry, dict) else []:
            if str(name).rpartition(".")[2] in _WRAPPERS and isinstance(arguments, dict):
                own |= arguments
    return own | {key: config[key] for key in ("encoder", "k", "horizon") if key in config}
