"""Other people's subsequence DTW, each called as its own documentation advises.

All solve the problem of Eq. 1 and 2: squared Euclidean distances, steps (1, 1), (1, 0) and (0, 1)
without a penalty, a match that may start and end anywhere in memory. So all find the same segment
and cost, which `tests/sb3/test_bench_latency.py` checks.

* ``Peer``, ``PEERS`` - from a window and a memory to the segment
* ``LIBROSA_ON_COSTS`` - the same from distances: the only one that takes them
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["LIBROSA_ON_COSTS", "PEERS", "Peer", "Segment"]

Segment = tuple[int, int, float]
"""(first frame, last frame, cost)."""
Array = NDArray[Any]


@dataclass(frozen=True)
class Peer:
    """A function of another package.

    Attributes:
        name: package and function.
        module: what is imported.
        prepare: once for a memory (N, D) float32: the form that the function is fastest on.
        align: (module, window in that form, memory in that form) -> segment.
    """

    name: str
    module: str
    prepare: Callable[[Array], Array]
    align: Callable[[Any, Array, Array], Segment]

    def load(self) -> Callable[[Array, Array], Segment]:
        """`align` with its module imported.

        Raises:
            ImportError: of one line, where it is not installed.
        """
        try:
            module = import_module(self.module)
        except ModuleNotFoundError as error:
            raise ImportError(
                f"{self.name}: not installed ({error}): pip install 'regil-sb3[bench]'"
            ) from error
        return lambda window, memory: self.align(module, window, memory)


def _tslearn(metrics: Any, window: Array, memory: Array) -> Segment:
    path, root = metrics.dtw_subsequence_path(window, memory)
    return path[0][1], path[-1][1], root**2


def _dtaidistance(subsequence: Any, window: Array, memory: Array) -> Segment:
    # use_c: "use the C-based DTW function"; its default is a penalty of 0.1, another problem.
    found = subsequence.subsequence_alignment(window, memory, penalty=0, use_c=True)
    match = found.best_match(minlength=1)
    first, last = match.segment
    return first, last, match.distance**2


def _librosa(sequence: Any, window: Array, memory: Array) -> Segment:
    table, path = sequence.dtw(X=window, Y=memory, metric="sqeuclidean", subseq=True)
    return _of_table(table, path)


def _librosa_on_costs(sequence: Any, costs: Array, _: Array) -> Segment:
    table, path = sequence.dtw(C=costs, subseq=True)
    return _of_table(table, path)


def _of_table(table: Array, path: Array) -> Segment:
    end = int(path[0, 1])
    return int(path[-1, 1]), end, float(table[-1, end])


def _as_given(rows: Array) -> Array:
    return rows


def _double(rows: Array) -> Array:
    double: Array = rows.astype(np.float64)
    return double


def _double_columns(rows: Array) -> Array:
    """(D, N), frames lying as rows in memory: librosa turns it back without a copy."""
    columns: Array = _double(rows).T
    return columns


PEERS = (
    Peer("tslearn dtw_subsequence_path", "tslearn.metrics", _as_given, _tslearn),
    Peer(
        "dtaidistance subsequence_alignment",
        "dtaidistance.subsequence.dtw",
        _double,
        _dtaidistance,
    ),
    Peer("librosa sequence.dtw", "librosa.sequence", _double_columns, _librosa),
)
LIBROSA_ON_COSTS = Peer(
    "librosa sequence.dtw, given the distances", "librosa.sequence", _as_given, _librosa_on_costs
)
