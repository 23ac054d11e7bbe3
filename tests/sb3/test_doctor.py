"""`regil doctor`: the right verdict for demonstrations that fit, and for those that cannot."""

from __future__ import annotations

import dataclasses
import re

import gymnasium as gym
import numpy as np
import pytest
import toy_camera
from regil_wrappers import Demonstration, make_encoder

from regil_sb3 import doctor
from regil_sb3.cli import main
from regil_sb3.doctor.episodes import Played, check_guide
from regil_sb3.doctor.findings import Finding, status, table
from regil_sb3.doctor.pictures import check_actions, check_motion, check_recorded
from regil_sb3.doctor.rewards import Reward, Worth, check_reward, judged
from regil_sb3.settings import make_settings

ENV = "ToyCamera-v0"
SPACE = gym.spaces.Box(-1, 1, (4,), np.float32)


@pytest.fixture(scope="module")
def demo():
    return toy_camera.record()


def changed(demo, **fields):
    return dataclasses.replace(demo, **fields)


def verdicts(found):
    return {f.check: f.verdict for f in found}


def wrong(found):
    return [f.check for f in found if f.verdict == "wrong"]


def line(found, check):
    return next(f.line for f in found if f.check == check)


def half_rate(demo):
    n = len(demo.actions) // 2
    return changed(demo, frames=demo.frames[: 2 * n + 1 : 2], actions=demo.actions[: 2 * n : 2])


def with_idle_start(demo, n=40):
    still = np.zeros((n, 4), np.float32)
    still[:, 3] = demo.actions[0, 3]
    return changed(
        demo,
        frames=np.concatenate([np.repeat(demo.frames[:1], n, axis=0), demo.frames]),
        actions=np.concatenate([still, demo.actions]),
    )


@pytest.fixture(scope="module")
def right(demo):
    said = []
    return doctor.examine(ENV, demo, 3, said.append), said


def test_the_right_demonstration(right):
    found, said = right
    assert set(verdicts(found).values()) == {"ok"}, table(found)
    assert status(found) == 0
    assert "corrected 3 of 3" in line(found, "guided replay")
    assert "--set correction=servo" in line(found, "recommended")
    rewards = {f.check for f in found if f.check.startswith("reward")}
    assert rewards == {f"reward {r}" for r in ("sdtw", "progress", "cos", "orca", "pwil")}
    assert "would mislead" in line(found, "reward cos")
    assert re.match(
        r"success is worth -[\d.]+ \(-[\d.]+ a step\), (no replay failed|failure -.*), "
        r"standing still -[\d.]+ \(-[\d.]+ a step\); ",
        line(found, "reward progress"),
    )
    assert "learner" in line(found, "time")
    assert "replay buffer" in line(found, "memory")
    assert "corrected guide, episode 3 of 3" in said


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f[:, ::-1], "upside down"),
        (lambda f: f[:, :, ::-1], "mirrored"),
        (lambda f: f[:, ::-1, ::-1], "turned by 180 degrees"),
        (lambda f: f[..., ::-1], "red and blue exchanged"),
        (lambda f: f[:, ::2, ::2], "42x42"),
    ],
)
def test_pictures_that_do_not_compare(demo, change, words):
    frames = change(demo.frames)
    metadata = {**demo.metadata, "image_size": list(frames.shape[1:3])}
    found = doctor.examine(ENV, changed(demo, frames=frames, metadata=metadata), 1)
    assert wrong(found) == ["pictures"]
    assert words in line(found, "pictures")
    assert found[-1].check == "episodes"  # nothing is played that could not mean anything
    assert status(found) == 1


def test_another_camera():
    found = doctor.examine(ENV, toy_camera.record(pan=(30, -20)), 1)
    assert "scene" in wrong(found)
    assert "another task, camera or arm pose?" in line(found, "scene")


def test_a_camera_that_turned_a_little():
    found = doctor.examine(ENV, toy_camera.record(pan=(3, -2)), 1)
    assert verdicts(found)["scene"] == "warning"
    assert re.search(r"shifted by \(-[23]\.\d, [12]\.\d\) pixels", line(found, "scene"))


def test_a_camera_that_is_said_to_be_another(demo):
    env = gym.make(ENV)
    env.unwrapped.metadata = {"regil": {"camera": "front", "action_repeat": 2, "control_rate": 20}}
    recorded = {"camera": "side", "action_repeat": 1, "control_rate": 40}
    found = check_recorded(env, changed(demo, metadata={**demo.metadata, **recorded}))
    assert wrong(found) == ["camera", "action repeat", "frame rate"]  # all of them, not the first
    assert check_recorded(env, demo) == []  # what is not stated is not asked


def test_another_task(demo, monkeypatch):
    table_there = toy_camera._textured(96, 21)[:12, :12]
    monkeypatch.setattr(toy_camera, "_SQUARE", toy_camera._textured(16, 13))
    monkeypatch.setattr(toy_camera, "_FIXED", toy_camera._textured(24, 17)[::-1])
    monkeypatch.setattr(toy_camera, "_TABLE", np.kron(table_there, np.ones((11, 11, 1))) * 0.4 + 90)
    other = toy_camera.record()
    monkeypatch.undo()
    other = changed(other, metadata={**other.metadata, "env_id": "AnotherTask-v0"})
    found = doctor.examine(ENV, other, 1)
    assert verdicts(found)["task"] == "warning"
    assert "AnotherTask-v0" in line(found, "task")
    assert "scene" in wrong(found)


def test_half_the_frame_rate(demo):
    found = doctor.examine(ENV, half_rate(demo), 1)
    assert wrong(found)[:1] == ["frame rate"]
    assert "recommended" not in verdicts(found)
    assert "half the environment's rate" in line(found, "frame rate")


def test_twice_the_frame_rate(demo):
    frames = np.repeat(demo.frames, 2, axis=0)[:-1]
    found = doctor.examine(
        ENV, changed(demo, frames=frames, actions=np.repeat(demo.actions, 2, axis=0)), 1
    )
    assert "frame rate" in wrong(found)
    assert "twice the environment's rate" in line(found, "frame rate")


def test_actions_of_another_unit(demo):
    found = doctor.examine(ENV, changed(demo, actions=demo.actions * np.float32(0.02)), 1)
    assert verdicts(found)["actions"] == verdicts(found)["frame rate"] == "warning"
    assert "another unit" in line(found, "actions")


def test_idle_frames_at_the_start(demo):
    found = doctor.examine(ENV, with_idle_start(demo), 1)
    assert verdicts(found)["idle frames"] == "warning"
    assert "40 at the start, 0 inside" in line(found, "idle frames")
    assert "frames[40:]" in line(found, "idle frames")
    assert wrong(found) == []
    assert status(found) == 0


def test_a_time_limit_that_ends_the_replay(demo):
    found = doctor.examine(make_settings(ENV, overrides=["env_kwargs.max_steps=9"]), demo, 1)
    assert verdicts(found)["frame rate"] == "warning"
    assert "time limit too short" in line(found, "frame rate")


def embedded(demo):
    return make_encoder("pixels").encode(demo.frames)


def test_idle_frames_inside_and_none(demo):
    middle = len(demo.frames) // 2
    order = [*range(middle), *[middle] * 12, *range(middle, len(demo.frames))]
    waits = Demonstration(demo.frames[order])
    motion, _ = check_motion(waits, embedded(waits), 4, SPACE)
    assert motion.verdict == "warning"
    assert motion.line.startswith("0 at the start, 12 inside, 0 at the end")
    still = Demonstration(demo.frames[:1].repeat(9, axis=0))
    (finding,) = check_motion(still, embedded(still), 4, SPACE)
    assert finding.verdict == "wrong"


@pytest.mark.parametrize(
    ("waits", "closes", "verdict", "excused"),
    [(12, True, "ok", 12), (12, False, "warning", 0), (40, True, "warning", 15)],
)
def test_waiting_for_the_gripper_is_not_idle(demo, waits, closes, verdict, excused):
    middle = len(demo.frames) // 2
    order = [*range(middle), *[middle] * waits, *range(middle, len(demo.frames))]
    actions = np.full((len(order) - 1, 4), -1, np.float32)
    actions[middle:, 3] = 1 if closes else -1
    grips = changed(demo, frames=demo.frames[order], actions=actions, successes=None)
    motion, _ = check_motion(grips, embedded(grips), 4, SPACE, gripper=3)
    assert motion.verdict == verdict
    assert f"{waits} inside, 0 at the end" in motion.line
    assert (f"({excused} of them while the gripper moves)" in motion.line) == closes


def test_ambiguous_frames(demo):
    # There and back and there again: the way there looks the same both times
    n = len(demo.frames)
    order = [*range(n), *range(n - 2, -1, -1), *range(1, n)]
    twice = Demonstration(demo.frames[order], actions=np.zeros((len(order), 4), np.float32))
    _, ambiguous = check_motion(twice, embedded(twice), 4, SPACE)
    assert ambiguous.verdict == "warning"
    assert "much the same action" in ambiguous.line
    (_, first), (_, second) = ambiguous.pictures
    np.testing.assert_array_equal(first, second)
    actions = np.zeros((len(order), 4), np.float32)
    actions[n:] = 1
    _, ambiguous = check_motion(changed(twice, actions=actions), embedded(twice), 4, SPACE)
    assert "different actions" in ambiguous.line
    # There and back: the last frames come in another order, which the horizon tells apart
    back = Demonstration(demo.frames[order[: 2 * n - 1]])
    _, alone = check_motion(back, embedded(back), 0, SPACE)
    _, with_horizon = check_motion(back, embedded(back), 8, SPACE)
    assert alone.verdict == "warning"
    assert with_horizon.verdict == "ok"


@pytest.mark.parametrize(
    ("actions", "metadata", "verdict", "words"),
    [
        (None, {}, "warning", "it has none"),
        (np.zeros((8, 3), np.float32), {}, "wrong", "size 3"),
        (np.full((8, 4), 1.5, np.float32), {}, "wrong", "1.5 in dimension 0"),
        (np.full((8, 4), 0.01, np.float32), {}, "warning", "1.0% of what"),
        (np.tile(np.float32([[1], [-1]]), (4, 4)), {}, "warning", "at its limit"),
        (np.full((8, 4), 0.5, np.float32), {"action_high": [9] * 4}, "warning", "same unit"),
        (np.full((8, 4), 0.5, np.float32), {}, "ok", "50%"),
    ],
)
def test_actions(demo, actions, metadata, verdict, words):
    given = Demonstration(demo.frames[:9], actions=actions, metadata=metadata)
    (finding,) = check_actions(given, SPACE)
    assert finding.verdict == verdict
    assert words in finding.line


def test_actions_without_limits(demo):
    space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)
    given = Demonstration(demo.frames[:9], actions=np.full((8, 4), 0.5, np.float32))
    assert [f.verdict for f in check_actions(given, space)] == ["ok"]


def test_without_actions_it_is_still_judged_as_a_reward(demo):
    found = doctor.examine(ENV, changed(demo, actions=None), 1)
    assert wrong(found) == []
    assert "guided replay" not in verdicts(found)
    assert verdicts(found)["reward progress"] == "ok"
    assert "a step), nothing was replayed, standing still" in line(found, "reward progress")
    assert "behaviour cloning (the demonstration has no actions" in line(found, "time")
    assert "correction" not in line(found, "recommended")


class Silent(toy_camera.ToyCamera):
    """Ends at success, and does not say that it was one."""

    def step(self, action):
        *rest, _ = super().step(action)
        return (*rest, {})


def test_an_environment_that_says_no_success(demo):
    gym.register("ToySilent-v0", entry_point=Silent)
    found = doctor.examine("ToySilent-v0", demo, 1)
    gym.registry.pop("ToySilent-v0")
    assert wrong(found) == ["guided replay", "success"]  # as training would count them
    assert 'info["is_success"]' in line(found, "success")


class Discrete(toy_camera.ToyCamera):
    """Buttons in place of numbers."""

    def __init__(self, **settings):
        super().__init__(**settings)
        self.action_space = gym.spaces.Discrete(3)


def test_discrete_actions(demo):
    gym.register("ToyButtons-v0", entry_point=Discrete)
    found = doctor.examine("ToyButtons-v0", demo, 1)
    assert wrong(found) == ["actions"]
    found = doctor.examine("ToyButtons-v0", changed(demo, actions=None), 1)
    assert "not continuous" in line(found, "episodes")
    gym.registry.pop("ToyButtons-v0")


def test_guide_verdicts():
    assert check_guide([True, False], None, "no deltas").verdict == "ok"
    assert check_guide([True, False, False], None, "").verdict == "warning"
    assert check_guide([False, False], [True, True], "").verdict == "ok"
    assert check_guide([False], [False], "why").verdict == "wrong"
    assert "does not apply (no deltas)" in check_guide([True], None, "no deltas").line


def played(*rewards):
    return Played(rewards={"r": list(rewards)})


def test_a_reward_is_judged_by_discounted_returns():
    good, bad, still = played(-0.9, -0.5, -0.1), played(-1, -0.2), played(-1, -1, -1, -1)
    r = judged("r", [good], [bad], [still], gamma=0.5, time_limit=4)
    # -0.9 - 0.25 - 0.025 = -1.175; -1.1; -1.875
    assert (r.above_still, r.above_failure, r.order, r.freezing) == (1, 0, 1, 0)
    assert (r.success.value, r.success.step) == pytest.approx((-1.175, -0.5))
    assert (r.failure.value, r.failure.step) == pytest.approx((-1.1, -0.6))
    assert (r.still.value, r.still.step) == pytest.approx((-1.875, -1))
    # Paid for each step: 1 + .5 a step more if it stays than if it finishes
    survival = judged("r", [played(1, 1)], [], [played(1, 1, 1, 1)], gamma=0.5, time_limit=4)
    assert survival.above_still == 0
    assert np.isnan(survival.above_failure)
    assert survival.failure is None
    assert survival.order == 0
    assert survival.freezing == 1
    assert max([r, survival], key=lambda x: x.rank) is r


def test_returns_and_steps_are_means_over_episodes_and_over_steps():
    r = judged("r", [played(1), played(0, 0, 0)], [], [played(0)], gamma=0.5, time_limit=4)
    assert (r.success.value, r.success.step) == (0.5, 0.25)


WORTH = {"success": Worth(-3.2, -0.1), "failure": Worth(-12345.6, -1), "still": Worth(-1e-9, 0)}


def test_what_success_failure_and_standing_still_are_worth():
    shares = {"above_still": 1, "above_failure": 0.5, "order": 0.5, "freezing": 0}
    (found,) = check_reward([Reward("r", **WORTH, **shares)], "r")
    assert found.line.startswith(
        "success is worth -3.2 (-0.1 a step), failure -12346 (-1 a step), standing still -1e-09 "
        "(0 a step); success above standing still 100%, above failure 50%, order"
    )
    shares["above_failure"] = float("nan")
    (found,) = check_reward([Reward("r", **{**WORTH, "failure": None}, **shares)], "r")
    assert "(-0.1 a step), no replay failed, standing still" in found.line
    assert "above failure" not in found.line


def test_only_the_reward_that_is_trained_on_is_warned_of():
    both = [
        Reward("good", **WORTH, above_still=1, above_failure=1, order=0.5, freezing=0),
        Reward("poor", **WORTH, above_still=0, above_failure=1, order=0.9, freezing=0.8),
    ]
    assert verdicts(check_reward(both, "good")) == {"reward good": "ok", "reward poor": "ok"}
    found = check_reward(both, "poor")
    assert verdicts(found) == {"reward good": "ok", "reward poor": "warning"}
    assert "set reward=good" in line(found, "reward poor")


def test_table_and_status():
    found = [Finding("a", "ok", "word " * 30), Finding("longer", "warning", "line")]
    lines = table(found, 60).splitlines()
    assert lines[0].startswith("ok       a       word")
    assert all(x.startswith(" " * 17 + "word") for x in lines[1:-1])
    assert max(map(len, lines)) <= 60
    assert status(found) == 0
    assert status([*found, Finding("b", "wrong", "")]) == 1


@pytest.fixture(scope="module")
def files(demo, tmp_path_factory):
    folder = tmp_path_factory.mktemp("demos")
    demo.save(folder / "right.hdf5")
    changed(demo, frames=demo.frames[:, ::-1]).save(folder / "down.hdf5")
    return folder


def test_command_line(files, tmp_path, capsys):
    page = tmp_path / "page.html"
    words = ["doctor", ENV, str(files / "down.hdf5"), "--html", str(page)]
    assert main(words) == 1
    assert "1 of 5 wrong, 1 of 5 warning, 3 of 5 ok" in capsys.readouterr().out
    text = page.read_text("utf-8")
    assert "It cannot work like this." in text
    assert "upside down" in text
    assert text.count("<figure") >= 3  # both first pictures, and the film
    assert not re.search(r"""(src|href)=["']?(https?:)?//""", text)
    assert "<script>alert" not in text


def test_state_observations_and_rendered_pictures(files, capsys):
    words = ["doctor", ENV, str(files / "right.hdf5"), "--image", "render", "--episodes", "1"]
    assert main([*words, "--set", "env_kwargs.obs=state", "--set", "reward=sdtw"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"warning +observations +TD3BC cannot clone it", out)  # it holds no state
    assert re.search(r"ok +pictures +84x84", out)
    assert re.search(r"ok +guided replay", out)


def test_state_observations_as_the_settings_stack_them(demo):
    states = changed(demo, observations=np.zeros((len(demo), 6), np.float32))
    seen = ["image=render", "env_kwargs.obs=state"]
    for more, verdict in (([], "warning"), (["policy=MlpPolicy"], "ok")):
        found = doctor.examine(make_settings(ENV, overrides=[*seen, *more]), states, 1)
        assert verdicts(found)["observations"] == verdicts(found)["time"] == verdict
        assert ("2 stacked: set frame_stack=1" in line(found, "observations")) == (not more)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([ENV, "nowhere.hdf5"], "there is no demonstration"),
        ([ENV, "right.hdf5", "--episodes", "0"], "--episodes is 0"),
        ([ENV, "right.hdf5", "--set", "horizont=3"], "did you mean horizon"),
        ([ENV, "right.hdf5", "--set", "env_kwargs.colour=3"], "colour"),
        (["regil/metaworld-fly-v0", "right.hdf5"], "metaworld-fly"),
    ],
)
def test_what_cannot_be_examined_is_status_2(files, words, message, monkeypatch, capsys):
    monkeypatch.chdir(files)
    assert main(["doctor", *words]) == 2
    assert message in capsys.readouterr().err


def test_settings_that_do_not_fit_the_demonstration(demo):
    found = doctor.examine(make_settings(ENV, overrides=["horizon=99"]), demo, 1)
    assert wrong(found) == ["retrieval"]
    assert "fewer than horizon + 1 = 100" in line(found, "retrieval")
