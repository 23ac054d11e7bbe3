"""The choice between ways of replaying."""

from __future__ import annotations

import numpy as np
import pytest
from regil_wrappers.ways import Ways


def play(ways: Ways, share: dict[str, float], episodes: int, seed: int = 0) -> list[str]:
    """Kinds chosen, when each succeeds so often."""
    rng = np.random.default_rng(seed)
    kinds = []
    for _ in range(episodes):
        way = ways.choose(rng)
        kinds.append(way.kind)
        if rng.random() < share[way.kind]:
            way.won += 1
        else:
            way.lost += 1
    return kinds


@pytest.mark.parametrize(
    ("share", "best"),
    [
        ({"corrected": 0.95, "released": 0.1, "plain": 0.3}, "corrected"),
        ({"corrected": 0.1, "released": 0.9, "plain": 0.2}, "released"),
        ({"corrected": 0.05, "released": 0.05, "plain": 0.8}, "plain"),
    ],
)
def test_the_best_is_found_and_kept(share: dict[str, float], best: str) -> None:
    for seed in range(5):
        kinds = play(Ways([1], grasps=True), share, 60, seed)
        assert kinds[30:].count(best) >= 24
    # what is usually best is tried first
    first = [Ways([1], True).choose(np.random.default_rng(seed)).kind for seed in range(100)]
    assert first.count("corrected") > first.count("released") > first.count("plain") > 0


def test_pictures_of_two_things_speak_for_the_release() -> None:
    def kinds(ways: Ways, apart: bool) -> list[str]:
        return [ways.choose(np.random.default_rng(seed), apart).kind for seed in range(100)]

    ways = Ways([1], grasps=True)
    assert kinds(ways, True).count("released") >= 70 > 50 >= kinds(ways, False).count("released")
    ways.best("released").lost += 10  # but successes overrule them
    ways.best("corrected").won += 10
    assert kinds(ways, True).count("corrected") >= 70


def test_a_mirror_sign_is_chosen_by_success() -> None:
    ways, rng = Ways([-1, 1], grasps=False), np.random.default_rng(0)
    chosen = []
    for _ in range(40):
        way = ways.choose(rng)
        chosen.append((way.kind, way.mirror))
        won = way.kind == "corrected" and way.mirror == 1
        way.won, way.lost = way.won + won, way.lost + (not won)
    assert chosen[20:].count(("corrected", 1)) >= 18
    assert ways.best("corrected").mirror == 1


def test_the_verdict() -> None:
    ways = Ways([1], grasps=False)
    corrected = ways.best("corrected")
    assert ways.verdict() == ""
    corrected.lost += 6
    assert ways.verdict() == ""  # 4 of 11 expected; plain replay has shown nothing yet
    ways.plain.won += 2
    assert "succeeded in 0 of 6 episodes, plain replay in 2 of 2" in ways.verdict()
    assert Ways([], grasps=True).verdict() == ""


def test_without_cameras_there_is_plain_replay_alone() -> None:
    ways = Ways([], grasps=True)
    assert [way.kind for way in ways.all] == ["plain"]
    with pytest.raises(ValueError, match="no 'corrected' replay"):
        ways.best("corrected")


def test_as_a_list_and_back() -> None:
    ways = Ways([1, -1], grasps=True)
    play(ways, {"corrected": 0.5, "released": 0.5, "plain": 0.5}, 10)
    again = Ways.from_list(ways.as_list(), [1, -1])
    assert again.as_list() == ways.as_list()
    assert again.plain is again.all[-1]
    with pytest.raises(ValueError, match="with these cameras"):
        Ways.from_list(ways.as_list(), [1])
