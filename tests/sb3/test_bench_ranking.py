"""`regil bench ranking`."""

import numpy as np
import pytest
from regil_wrappers import Retriever
from toy import demonstration

from regil_sb3.bench import ranking, tables
from regil_sb3.bench.ranking import EPISODES, REWARDS, Return


def returns(reward, success, failure, still, goal=1):
    both = zip(EPISODES, (success, failure, still), strict=True)
    return [Return("hammer", goal, reward, e, total, mean) for e, (total, mean) in both]


def test_table_counts_the_goals_at_which_the_success_is_first():
    results = [
        *returns("sdtw", (-1, -4), (-9, -3), (-8, -2)),
        *returns("sdtw", (-3, -1), (-9, -3), (-8, -2), goal=2),
        *returns("cos", (5, 1), (9, 0), (5, 0.5)),
        *returns("cos", (5, 1), (5, 0), (4, 0), goal=2),
    ]
    lines = ranking.table(results)
    assert lines[0].startswith("Goals of 2 ")
    assert "| sdtw | 2 (1) | 2 (1) |" in lines
    assert "| cos | 0 (2) | 0 (2) |" in lines
    assert "| sdtw | -2 / -9 / -8 |" in lines


def test_episodes_and_rewards_of_one_task(tmp_path, monkeypatch, capsys):
    def short(**_):
        return real(tasks=["drawer-close"], goals=1)

    real = ranking.ranking
    monkeypatch.setattr(ranking, "ranking", short)
    monkeypatch.chdir(tmp_path)
    assert tables.main("ranking") == []
    out = capsys.readouterr().out
    assert out.count("registered") == 4
    assert out.splitlines()[-1] == "picture: ranking.png"
    assert (tmp_path / "ranking.png").stat().st_size > 10_000


@pytest.mark.parametrize("name", sorted({name for name, _ in REWARDS}))
def test_rewards_of_an_exact_replay(name):
    demo = demonstration()
    retriever = Retriever(demo)
    plain = ranking.episode_rewards(name, retriever, demo.frames)
    assert plain.shape == (len(demo) - 1,)
    # where nothing has moved, registration changes nothing
    registered = ranking.episode_rewards(name, retriever, demo.frames, demo.frames[0])
    np.testing.assert_array_equal(plain, registered)
    if name == "sdtw":
        assert (plain == 0).all()
