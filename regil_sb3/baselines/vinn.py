"""VINN-style replay: the actions of the nearest frames, weighted by distance; nothing is learned.

* ``locally_weighted`` - the equation on arrays
* ``vinn_act`` - plays it in an environment that `RetrievalGuideWrapper` wraps
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from regil_wrappers import Demonstration
from stable_baselines3.common.vec_env import VecEnv

from regil_sb3.evaluation import Act


def locally_weighted(
    distances: npt.NDArray[np.floating[Any]], actions: npt.NDArray[np.float32], k: int
) -> npt.NDArray[np.float32]:
    """Locally weighted regression: a = sum_i exp(-d_i) a_i / sum_i exp(-d_i) over the k nearest.

    Paper: Pari et al., The Surprising Effectiveness of Representation Learning for Visual
    Imitation, RSS 2022, https://arxiv.org/abs/2112.01511

    Args:
        distances: (N,) Euclidean, of the current frame's embedding to each of the demonstration's.
        actions: (N, A) or (N - 1, A): of each frame; the frame after the last action has its.
        k: how many frames count.

    Returns:
        (A,) float32.
    """
    near = np.argsort(distances, kind="stable")[:k]
    weights = np.exp(distances[near[0]] - distances[near])  # the nearest has 1: none underflow
    taken = actions[np.minimum(near, len(actions) - 1)]
    return np.asarray(weights @ taken / weights.sum(), np.float32)


def vinn_act(demo: Demonstration, k: int) -> Act:
    """How `regil_sb3.evaluation.evaluate` plays it, with the guide's own embeddings.

    Args:
        demo: the guide's one demonstration, with actions.
        k: how many frames count.
    """
    assert demo.actions is not None
    actions = demo.actions

    def act(obs: Any, env: VecEnv, first: bool) -> npt.NDArray[Any]:
        retrievers = env.get_attr("retriever")
        return np.stack([locally_weighted(np.sqrt(r.distances), actions, k) for r in retrievers])

    return act
