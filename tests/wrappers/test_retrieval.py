from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from regil_wrappers import Alignment, Demonstration, Retriever
from regil_wrappers.alignment import accumulated_costs, best_end, warping_path
from regil_wrappers.rewards import sdtw_reward

# A frame is one grey level: idle frames, near ones and far ones are easy to draw.
levels = st.lists(st.integers(0, 8), min_size=5, max_size=24)


def pictures(grey: list[int]) -> np.ndarray:
    return np.stack([np.full((4, 4, 3), 30 * g, np.uint8) for g in grey])


def by_definition(
    memory: np.ndarray, seen: np.ndarray, k: int, horizon: int
) -> tuple[float, int, list[int]]:
    """Section 3.1 of the paper for the last frame of `seen`: cost, end, candidates."""
    window = seen[-(horizon + 1) :].astype(np.float64)
    costs = ((window[:, None] - memory.astype(np.float64)) ** 2).sum(2)
    order = sorted(range(len(memory)), key=lambda j: (costs[-1, j], -j))
    candidates = sorted(order[:k])
    c = costs[:, : candidates[-1] + 1]
    D = np.full((len(c) + 1, c.shape[1] + 1), np.inf)
    D[0] = 0
    for i in range(1, D.shape[0]):
        for j in range(1, D.shape[1]):
            D[i, j] = c[i - 1, j - 1] + min(D[i - 1, j - 1], D[i - 1, j], D[i, j - 1])
    last = D[-1, 1:]
    return last.min(), max(j for j in range(len(last)) if last[j] == last.min()), candidates


class Levels:
    """Embeds a grey picture as its level, in whole numbers."""

    def encode(self, frames: np.ndarray) -> np.ndarray:
        return (frames[:, 0, 0, :1] // 30).astype(np.float32)


@settings(max_examples=150, deadline=None)
@given(levels, levels, st.integers(1, 5), st.integers(0, 4))
def test_each_step_is_the_definition(
    demo: list[int], episode: list[int], k: int, horizon: int
) -> None:
    retriever = Retriever(Demonstration(pictures(demo)), Levels(), k=k, horizon=horizon)
    seen = Levels().encode(pictures(episode))
    for t, frame in enumerate(pictures(episode)):
        got = retriever.step(frame)
        cost, end, candidates = by_definition(retriever.embeddings, seen[: t + 1], k, horizon)
        assert (got.cost, got.end, list(got.candidates)) == (cost, end, candidates)
        assert got.q_star == candidates[-1]
        assert got.window == min(t + 1, horizon + 1)
        assert 0 <= got.start <= got.end <= got.q_star
        assert retriever.path()[0] == (0, got.start)
        assert retriever.path()[-1] == (got.window - 1, got.end)


@settings(max_examples=80, deadline=None)
@given(levels, st.integers(1, 5), st.integers(0, 4), st.sampled_from(["pixels", "noise"]))
def test_an_exact_replay_costs_nothing(demo: list[int], k: int, horizon: int, kind: str) -> None:
    frames = pictures(demo)
    if kind == "noise":
        rng = np.random.default_rng(demo)
        frames = rng.integers(0, 256, (9, 33, 33, 3), dtype=np.uint8)[np.array(demo)]
    retriever = Retriever(Demonstration(frames), k=k, horizon=horizon)
    for frame in frames:
        alignment = retriever.step(frame)
        assert alignment.cost == 0
        assert sdtw_reward(alignment) == 0


@settings(max_examples=60, deadline=None)
@given(levels, levels, levels)
def test_reward_is_not_positive_and_does_not_know_the_future(
    demo: list[int], before: list[int], after: list[int]
) -> None:
    def rewards(episode: list[int]) -> list[float]:
        retriever = Retriever(Demonstration(pictures(demo)))
        return [sdtw_reward(retriever.step(frame)) for frame in pictures(episode)]

    alone = rewards(before)
    assert all(r <= 0 for r in alone)
    assert rewards(before + after)[: len(before)] == alone


def test_idle_frames_do_not_hold_the_match_back() -> None:
    demo = Demonstration(pictures([0, 1, 2, 2, 2, 2, 3, 4]))
    retriever = Retriever(demo, k=1)
    ends = [retriever.step(frame).end for frame in pictures([0, 1, 2, 2])]
    assert ends == [0, 1, 5, 5]


def test_equal_frames_are_equally_far_to_the_last_bit() -> None:
    """Whatever order a processor sums in: 33 numbers a row, so that rows start unaligned."""

    class Odd:
        def encode(self, frames: np.ndarray) -> np.ndarray:
            return frames[:, :3, :11, 0].reshape(len(frames), 33) / np.float32(7)

    rng = np.random.default_rng(0)
    distinct = rng.integers(0, 256, (4, 12, 12, 3), dtype=np.uint8)
    demo = Demonstration(distinct[[0, 1, 1, 1, 2, 1, 3, 1, 1, 1]])
    retriever = Retriever(demo, Odd(), k=7, horizon=0)
    for _ in range(50):
        # Nearest to frame 1, all whose seven copies tie; the last of them is the match.
        noise = rng.integers(0, 3, (12, 12, 3), dtype=np.uint8)
        alignment = retriever.step(np.minimum(distinct[1], 252) + noise)
        assert alignment.candidates == (1, 2, 3, 5, 7, 8, 9)
        assert alignment.end == 9


def test_long_episodes_keep_the_right_window() -> None:
    rng = np.random.default_rng(2)
    demo = Demonstration(rng.integers(0, 256, (30, 28, 28, 3), dtype=np.uint8))
    retriever = Retriever(demo, k=5, horizon=3)
    rows = []
    for _ in range(300):
        frame = rng.integers(0, 256, (28, 28, 3), dtype=np.uint8)
        alignment = retriever.step(frame)
        embedding = retriever.encoder.encode(frame[None])[0]
        rows.append(((retriever.embeddings - embedding) ** 2).sum(1, dtype=np.float64))
        table = accumulated_costs(np.stack(rows[-4:])[:, : alignment.q_star + 1])
        end, cost = best_end(table)
        assert alignment.end == end
        assert alignment.cost == pytest.approx(cost, rel=1e-5)
        assert alignment.start == warping_path(table, end)[0][1]


def test_reset_forgets() -> None:
    frames = pictures([0, 1, 2, 3, 4, 5])
    retriever = Retriever(Demonstration(frames))
    first = [retriever.step(frame) for frame in frames]
    retriever.reset()
    with pytest.raises(ValueError, match="before the first frame"):
        _ = retriever.alignment
    with pytest.raises(ValueError, match="before the first frame"):
        retriever.path()
    assert [retriever.step(frame) for frame in frames] == first
    assert retriever.alignment == first[-1] == Alignment(1, 5, 0.0, (1, 2, 3, 4, 5), 5, 5)


def test_strap_always_has_a_path() -> None:
    retriever = Retriever(
        Demonstration(pictures([0, 1, 2, 3, 4, 5])), k=3, horizon=4, step_pattern="strap"
    )
    for frame in pictures([0] * 12):
        assert np.isfinite(retriever.step(frame).cost)
    with pytest.raises(ValueError, match=r"k=2.*'strap'.*at least k=3"):
        Retriever(Demonstration(pictures([0] * 9)), k=2, horizon=4, step_pattern="strap")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"k": 0}, "k=0: it must be a whole number, at least 1"),
        ({"k": 2.5}, "k=2.5"),
        ({"k": True}, "k=True"),
        ({"k": 7}, "k=7: the demonstration has only 6 frames"),
        ({"horizon": -1}, "horizon=-1"),
        ({"horizon": 6}, r"6 frames, fewer than horizon \+ 1 = 7: choose horizon=5"),
        ({"step_pattern": "odd"}, "step_pattern='odd': choose one of"),
        ({"encoder": "nothing"}, r"encoder 'nothing': unknown: choose one of \['clip-"),
        ({"use_encoder_frames": True}, "no encoder_frames"),
    ],
)
def test_bad_settings(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Retriever(Demonstration(pictures([0, 1, 2, 3, 4, 5])), **settings)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("demo", "named"),
    [
        ("demos/reach.hdf5", "'demos/reach.hdf5'"),
        (Path("demos"), "PosixPath"),
        ([Demonstration(pictures([0, 1, 2, 3, 4])), "reach.hdf5"], "'reach.hdf5'"),
        (None, "None"),
    ],
)
def test_only_demonstrations(demo: object, named: str) -> None:
    with pytest.raises(ValueError, match=f"^demo={named}.*Demonstration.load opens a file$"):
        Retriever(demo)  # type: ignore[arg-type]


def test_frames_of_another_shape() -> None:
    retriever = Retriever(Demonstration(pictures([0, 1, 2, 3, 4])))
    with pytest.raises(ValueError, match=r"frame 0 of the episode is uint8 \(5, 4, 3\)"):
        retriever.step(np.zeros((5, 4, 3), np.uint8))
    with pytest.raises(ValueError, match="float32"):
        retriever.step(np.zeros((4, 4, 3), np.float32))


class Breaks:
    """Gives one bad embedding, for the n-th frame it sees."""

    def __init__(self, n: int, value: float = np.nan) -> None:
        self.left, self.value = n, value

    def encode(self, frames: np.ndarray) -> np.ndarray:
        self.left -= 1
        value = self.value if self.left < 0 else 0.0
        return np.full((len(frames), 2), value, np.float32)


def test_a_nan_embedding_names_its_frame() -> None:
    demo = Demonstration(pictures([0, 1, 2, 3, 4]))
    with pytest.raises(ValueError, match="NaN or infinity for frame 3 of the demonstration"):
        Retriever(demo, Breaks(3))
    retriever = Retriever(demo, Breaks(7))
    retriever.step(demo.frames[0])
    retriever.step(demo.frames[1])
    with pytest.raises(ValueError, match="NaN or infinity for frame 2 of the episode"):
        retriever.step(demo.frames[2])


def test_an_infinite_distance_names_its_frame() -> None:
    retriever = Retriever(Demonstration(pictures([0, 1, 2, 3, 4])), Breaks(5, value=3e38))
    with (
        np.errstate(over="ignore"),
        pytest.raises(ValueError, match="frame 0 of the episode has no finite distance"),
    ):
        retriever.step(np.zeros((4, 4, 3), np.uint8))


class OneBuffer:
    """Gives the same array each time."""

    def __init__(self) -> None:
        self.row = np.empty((1, 1), np.float32)

    def encode(self, frames: np.ndarray) -> np.ndarray:
        self.row[:] = frames[0, 0, 0, 0] // 30
        return self.row


def test_an_encoder_that_uses_its_array_again() -> None:
    demo = [1, 2, 3, 4, 5, 6]
    retriever = Retriever(Demonstration(pictures(demo)), OneBuffer(), k=2, horizon=2)
    np.testing.assert_array_equal(retriever.embeddings[:, 0], demo)
    for i, picture in enumerate(pictures(demo)):
        assert retriever.step(picture).end == i
    seen = retriever.embedding
    retriever.encoder.encode(pictures([8]))
    np.testing.assert_array_equal(seen, [6])
