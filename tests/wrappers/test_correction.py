"""The corrected guide, on a hand and a square seen by a camera that the tests know exactly."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import toy_camera
from regil_wrappers import Demonstration, RetrievalGuideWrapper, calibration
from regil_wrappers.correction import Servo
from regil_wrappers.pinhole import Pinhole, fit_pinhole
from regil_wrappers.registration import Displacement
from toy_camera import HOME, ToyCamera


@pytest.fixture(scope="module")
def demo() -> Demonstration:
    return toy_camera.record()


@pytest.fixture(scope="module")
def carried() -> Demonstration:
    return toy_camera.record(task="carry")


def guided(demo: Demonstration, correction: str = "servo", **settings: Any) -> Any:
    own = {k: settings.pop(k) for k in ("mirror", "plane", "translation_dims") if k in settings}
    own |= {k: settings.pop(k) for k in ("disturbance", "gripper_dim", "image") if k in settings}
    return RetrievalGuideWrapper(ToyCamera(**settings), demo, correction=correction, **own)


def play(env: Any, seed: int, ask: str = "guide_action") -> list[dict[str, Any]]:
    """An episode that follows the guide: the infos."""
    infos, over = [env.reset(seed=seed)[1]], False
    while not over:
        _, _, terminated, truncated, info = env.step(getattr(env, ask)())
        infos.append(info)
        over = terminated or truncated
    return infos


def calibrated(env: Any, seed: int = 100) -> Any:
    while not env._servo.calibrated:
        play(env, seed := seed + 1)
    return env


@pytest.fixture(scope="module")
def known(demo: Demonstration) -> dict[str, Any]:
    """A calibration, found once."""
    return json.loads(json.dumps(calibrated(guided(demo)).calibration()))


def ready(demo: Demonstration, known: dict[str, Any], **settings: Any) -> Any:
    env = guided(demo, **settings)
    env.set_calibration(known)
    return env


def successes(env: Any, seeds: range, ask: str = "guide_action") -> int:
    return sum(play(env, seed, ask)[-1]["is_success"] for seed in seeds)


def test_calibration_fits_into_the_first_episodes(demo: Demonstration) -> None:
    env = guided(demo)
    kinds, marked, moved = [], [], []
    for seed in range(5):
        infos = play(env, seed)
        guides = [info["retrieval"]["guide"] for info in infos]
        kinds.append(guides)
        marked.append(infos[-1]["retrieval"]["calibrating"])
        moved.append(np.abs(env.unwrapped.hand).max())
    # 4 steps of rest, 4 for the gripper, 24 for each axis: 70 steps hold the gripper and two
    assert marked == [True, True, False, False, False]
    assert set(kinds[0]) == {"calibration"}
    # an axis that was begun anew, and what is left of the episode
    assert kinds[1] == ["calibration"] * 28 + ["plain"] * (len(kinds[1]) - 28)
    for guides in kinds[2:]:
        assert set(guides) in ({"corrected"}, {"plain"})
    assert {"corrected"} in map(set, kinds[2:])
    assert env.calibration() is not None


def test_the_hand_is_put_back_between_calibration_moves(demo: Demonstration) -> None:
    env = guided(demo)
    env.reset(seed=0)
    places = []
    while env._servo.kind == "calibration":
        _, _, terminated, truncated, _ = env.step(env.guide_action())
        places.append(env.unwrapped.hand.copy())
        if terminated or truncated:
            env.reset(seed=0)
    places = np.stack(places)
    assert places.max() == pytest.approx(4)  # half of what the plane says
    assert places.min() == pytest.approx(-4)
    assert (np.sort(np.abs(places))[:, :2] < 1e-6).all()  # one axis at a time
    np.testing.assert_allclose(places[-1], 0, atol=1e-6)


def test_corrected_replay_reaches_where_plain_replay_fails(
    demo: Demonstration, known: dict[str, Any]
) -> None:
    seeds = range(10)
    assert successes(guided(demo, "none"), seeds) <= 1
    assert successes(ready(demo, known), seeds) >= 9  # it tries plain replay now and then


def test_the_displacement_is_that_of_the_square(demo: Demonstration, known: dict[str, Any]) -> None:
    env, found = ready(demo, known), 0
    for seed in range(10):
        env.reset(seed=seed)
        if env._servo.kind == "plain":
            continue
        found += 1
        truth = env.unwrapped.square - HOME
        assert np.linalg.norm(env._servo.target_shift - truth) < 0.6
        path = env._servo.corrected_path()
        # the demonstration itself ends up to 1.2 from the square
        np.testing.assert_allclose(path[-1], env.unwrapped.square, atol=1.8)
        assert np.linalg.norm(path[0]) < 4  # the correction grows, it does not jump
    assert found >= 8


def test_where_nothing_moved_it_is_the_demonstration(
    demo: Demonstration, known: dict[str, Any]
) -> None:
    env = ready(demo, known, frozen=True)
    assert demo.actions is not None
    env.reset(seed=0)
    for action in demo.actions:
        np.testing.assert_allclose(env.guide_action(), action, atol=1e-5)
        *_, info = env.step(env.guide_action())
    assert info["is_success"]


def test_another_light(demo: Demonstration, known: dict[str, Any]) -> None:
    assert successes(ready(demo, known, light=0.8), range(5)) == 5


@pytest.mark.parametrize("mirror", ["auto", -1])
def test_mirrored_pictures(mirror: Any) -> None:
    mirrored = toy_camera.record(look="mirrored")
    env = guided(mirrored, look="mirrored", mirror=mirror)
    calibrated(env)
    assert set(env._servo.cameras) == ({1, -1} if mirror == "auto" else {-1})
    assert successes(env, range(8)) >= 6


def test_the_release_is_learned(carried: Demonstration) -> None:
    """The goal stays where it was: with the correction kept, what is carried ends beside it."""
    env = calibrated(guided(carried, task="carry"))
    first = successes(env, range(8))
    assert successes(env, range(8, 16)) >= max(first, 6)
    ways = {way[0]: way[2:] for way in env.calibration()["ways"]}
    assert ways["released"][0] > 6
    assert ways["corrected"][1] > ways["corrected"][0] - 4


def test_two_things_that_moved_apart() -> None:
    """Square and goal go their own ways: no single displacement brings the one to the other."""
    brought = toy_camera.record(task="bring")
    env = calibrated(guided(brought, task="bring"))
    known = env.calibration()
    results: dict[str, list[bool]] = {"corrected": [], "released": [], "plain": []}
    for seed in range(10):
        infos = play(env, seed)
        results[infos[0]["retrieval"]["guide"]].append(infos[-1]["is_success"])
        if infos[0]["retrieval"]["guide"] == "released" and env._servo.place_shift.any():
            env.reset(seed=seed)
            moved = env.unwrapped.goal - toy_camera.GOAL
            env._servo.reset(env.displacement, env.apart(env._servo.grasp), kind="released")
            assert np.linalg.norm((env.target_shift - (env.unwrapped.square - HOME))[:2]) < 0.6
            assert np.linalg.norm((env.place_shift - moved)[:2]) < 1.6
    # pictures say so from the first episode on
    assert len(results["released"]) >= 6
    assert np.mean(results["released"]) >= 0.9

    env.set_calibration(known)
    blind = [_without_apart(env, seed, kind) for kind in results for seed in range(3)]
    assert not any(blind)


def _without_apart(env: Any, seed: int, kind: str) -> bool:
    env.reset(seed=seed)
    env._servo.reset(env.displacement, kind=kind)
    over = False
    while not over:
        *_, terminated, truncated, info = env.step(env.guide_action())
        over = terminated or truncated
    return bool(info["is_success"])


def test_it_gives_way_to_plain_replay_by_its_own_evidence(demo: Demonstration) -> None:
    """Only the picture of the square moves: who follows it fails."""
    env = calibrated(guided(demo, decoy=True))
    with pytest.warns(UserWarning, match="corrected replay succeeded in 0 of") as said:
        successes(env, range(14))
    assert len(said) == 1
    assert "\n" not in str(said[0].message)
    assert "mostly replays without correction" in env.calibration()["why"]
    assert successes(env, range(20, 25)) >= 4
    assert env.step(env.guide_action())[-1]["retrieval"]["guide"] == "plain"


def test_who_does_not_follow_teaches_it_nothing(demo: Demonstration, known: Any) -> None:
    env = ready(demo, known)
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    over = False
    while not over:
        action = rng.uniform(-1, 1, 4).astype(np.float32)
        _, _, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
    assert env.calibration()["ways"] == known["ways"]
    play(env, 1)
    assert env.calibration()["ways"] != known["ways"]

    fresh = guided(demo)
    for _ in range(2):  # calibration moves that somebody else makes are none
        fresh.reset(seed=0)
        for _ in range(50):
            *_, info = fresh.step(np.zeros(4, np.float32))
        assert info["retrieval"]["guide"] == "plain"
    assert not fresh._servo.calibrated
    assert fresh.calibration() is None
    calibrated(fresh)
    assert successes(fresh, range(3)) == 3


def test_an_episode_left_after_the_last_move_counts(demo: Demonstration) -> None:
    env = guided(demo)
    for seed in range(5):
        env.reset(seed=seed)
        over = False
        while env._servo.kind == "calibration" and not over:
            *_, terminated, truncated, _ = env.step(env.guide_action())
            over = terminated or truncated
    assert env.calibration() is not None
    assert successes(env, range(3)) == 3
    # the same for who has no wrapper
    servo = guided(demo)._servo
    servo.reset()
    for _ in range(2000):
        action = servo.action()
        if action is None:
            break
        servo.executed(action, action, demo.frames[0])
    assert not servo.calibrated
    with pytest.warns(UserWarning, match="does not move the hand's picture"):
        servo.reset()
    assert servo.calibrated


def test_calibration_round_trip(demo: Demonstration, known: dict[str, Any]) -> None:
    one, two = ready(demo, known), ready(demo, json.loads(json.dumps(known)))
    assert one.calibration() == two.calibration() == known
    for a, b in zip(play(one, 5), play(two, 5), strict=True):
        np.testing.assert_array_equal(
            a["retrieval"]["guide_action"], b["retrieval"]["guide_action"]
        )
        assert not a["retrieval"]["calibrating"]
    assert one.calibration() == two.calibration()
    # taken over in the middle of an episode, it is used from the next one on
    late = guided(demo)
    late.reset(seed=0)
    late.set_calibration(known)
    assert late._servo.kind == "plain"
    assert play(late, 1)[0]["retrieval"]["guide"] == "corrected"


@pytest.mark.parametrize(
    "change",
    [
        {"cameras": []},
        {"cameras": [{"focal": 3}]},
        {"ways": []},
        {"ways": [["corrected", 1, 2.0, 1.0]]},
        {"ways": [["plain", 1, 1.0]]},
        {"ways": [["plain", 1, -1.0, 2.0]]},
        {"ways": [["sideways", 1, 1.0, 1.0], ["plain", 1, 1.0, 1.0]]},
        {"ways": 3},
        {"why": None, "cameras": 1},
    ],
)
def test_a_damaged_calibration_is_refused(
    demo: Demonstration, known: dict[str, Any], change: dict[str, Any]
) -> None:
    env = guided(demo)
    with pytest.raises(ValueError, match="calibrat"):
        env.set_calibration({**known, **change})
    assert env.calibration() is None


def test_a_calibration_from_other_pictures_is_refused(demo: Demonstration, known: Any) -> None:
    small = [{**camera, "size": [64, 64]} for camera in known["cameras"]]
    with pytest.raises(ValueError, match="not from pictures of 84x84"):
        guided(demo).set_calibration({**known, "cameras": small})
    with pytest.raises(ValueError, match="without correction takes no calibration"):
        guided(demo, "none").set_calibration(known)
    assert guided(demo, "none").calibration() is None


@pytest.mark.parametrize(
    ("made_with", "message"),
    [
        (
            {"translation_dims": [1, 0, 2]},
            r"of translation_dims=\[0, 1, 2\] and this guide has \[1, 0, 2\]",
        ),
        ({"gripper_dim": "none"}, "of gripper_dim=3 and this guide has None"),
        ({"mirror": -1}, "of mirror=1 and this guide has -1"),
    ],
)
def test_a_calibration_of_other_declarations_is_refused(
    demo: Demonstration, known: dict[str, Any], made_with: dict[str, Any], message: str
) -> None:
    env = guided(demo, **made_with)
    with pytest.raises(ValueError, match=message) as caught:
        env.set_calibration(known)
    assert "\n" not in str(caught.value)
    assert env.calibration() is None
    guided(demo, mirror="auto").set_calibration(known)
    older = {name: value for name, value in known.items() if name != "gripper_dim"}
    guided(demo).set_calibration(older)


def test_disturbed_episodes_come_back(demo: Demonstration, known: dict[str, Any]) -> None:
    env = ready(demo, known, disturbance=3.0)
    differ, inside = [], []
    for seed in range(6):
        env.reset(seed=seed)
        pushed = kept = over = False
        while not over:
            clean, executed = env.guide_action(), env.disturbed_action()
            np.testing.assert_array_equal(clean, env.guide_action())  # asking changes nothing
            np.testing.assert_array_equal(executed, env.disturbed_action())
            assert np.abs(executed).max() <= 1
            assert executed[3] == clean[3]
            pushed |= bool((clean != executed).any())
            _, _, terminated, truncated, info = env.step(executed)
            over = terminated or truncated
            kept = info["is_success"]
        differ.append(pushed)
        inside.append(kept)
    assert differ[0]  # every other episode
    assert not any(differ[1::2])
    assert sum(differ) >= 2
    assert sum(inside) >= 5
    calm = ready(demo, known)
    calm.reset(seed=0)
    np.testing.assert_array_equal(calm.disturbed_action(), calm.guide_action())


def test_seeds_decide_everything(demo: Demonstration, known: dict[str, Any]) -> None:
    runs = []
    for _ in range(2):
        env = ready(demo, known, disturbance=2.0)
        runs.append([play(env, seed, "disturbed_action")[-1] for seed in range(3)])
    for a, b in zip(*runs, strict=True):
        assert a["retrieval"]["end"] == b["retrieval"]["end"]
        assert a["retrieval"]["cost"] == b["retrieval"]["cost"]


# -- what does not apply ---------------------------------------------------------------------------


def one_line(env: Any, message: str, episodes: int = 6, seed: int = 0) -> None:
    """It says so in one line, once, and goes on with plain replay."""
    with pytest.warns(UserWarning, match=message) as said:
        successes(env, range(seed, seed + episodes))
    assert len(said) == 1
    assert "\n" not in str(said[0].message)
    assert env._servo.kind == "plain"
    assert env.calibration()["why"] in str(said[0].message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.unwrapped.frozen = True
        assert play(env, 0)[-1]["is_success"]


@pytest.mark.parametrize("dead", [0, 2])
def test_a_dimension_that_does_not_move_the_hand(dead: int) -> None:
    env = guided(toy_camera.record(), frozen=False)
    env.unwrapped.dead = dead
    with pytest.warns(UserWarning, match=f"action dimension {dead} does not move the hand") as said:
        successes(env, range(5))
    assert len(said) == 1
    assert env._servo.kind == "plain"


def test_absolute_actions(demo: Demonstration) -> None:
    env = guided(demo, absolute=True)
    with pytest.warns(UserWarning, match="dimension 0 does not move .* must be a delta"):
        successes(env, range(5))
    assert env._servo.kind == "plain"


def test_episodes_too_short_to_calibrate_in(demo: Demonstration) -> None:
    env = guided(demo, max_steps=27)
    with pytest.warns(UserWarning, match="28 moves .* did not fit into any of 3 episodes") as said:
        successes(env, range(6))
    assert len(said) == 1
    assert env._servo.kind == "plain"
    assert not play(env, 7)[-1]["retrieval"]["calibrating"]


def test_a_plane_that_the_pictures_contradict(demo: Demonstration) -> None:
    env = guided(demo, plane=[0.3, 10.0, 10.0])
    calibrated(env)
    one_line(env, r"plane=\[0.3, 10.0, 10.0\]: in 3 episodes no displacement in this plane")


def test_a_mirror_sign_that_calibration_contradicts(
    demo: Demonstration, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A camera that fits either sign about as well is the rule: here the other fits far better
    def fit(*arguments: Any, **named: Any) -> Pinhole:
        camera = fit_pinhole(*arguments, **named)
        return replace(camera, cost=camera.cost + 100 * (camera.mirror == -1))

    monkeypatch.setattr(calibration, "fit_pinhole", fit)
    env = guided(demo, mirror=-1)
    one_line(env, "mirror=-1: calibration says 1 .*replays without correction")


def test_something_else_in_its_place_is_replayed_plainly(
    demo: Demonstration, known: dict[str, Any]
) -> None:
    env = ready(demo, known)
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (20, 20, 3)).astype(np.uint8)

    class Papered(ToyCamera):
        def render(self) -> np.ndarray:
            picture = super().render()
            picture[52:72, 30:50] = noise
            return picture

    env = RetrievalGuideWrapper(Papered(), demo, correction="servo")
    env.set_calibration(known)
    for seed in range(3):
        info = play(env, seed)[0]
        found = env.displacement
        assert found is None or found.ratio > 0.6
        assert info["retrieval"]["guide"] in ("plain", "corrected")


def test_a_camera_that_moved_is_taken_out(demo: Demonstration) -> None:
    env = calibrated(guided(demo, pan=(3.0, -2.0)))
    with pytest.warns(UserWarning, match=r"camera has moved .* by \((2.9|3.0|3.1), -") as said:
        reached = successes(env, range(8))
    assert len(said) == 1
    assert reached >= 7
    assert env.calibration()["why"] == ""


def test_another_scene(demo: Demonstration, known: dict[str, Any]) -> None:
    env = ready(demo, known, pan=(40.0, 30.0))
    with pytest.warns(UserWarning, match=r"% of the picture differ .* without correction") as said:
        successes(env, range(3))
    assert len(said) == 1
    assert env._servo.kind == "plain"


def test_a_hand_that_starts_elsewhere(demo: Demonstration, known: dict[str, Any]) -> None:
    env = ready(demo, known, start=1.5)
    off = []
    for seed in range(6):
        env.reset(seed=seed)
        found = env.unwrapped.hand - env._servo._hand
        off.append(np.abs(found[:2]).max() if env._servo.kind == "corrected" else 0.0)
    assert np.median(off) < 0.8
    seen = successes(env, range(10))
    env.unwrapped.metadata["regil"].pop("start_std")
    unseen = guided(demo, start=1.5)
    unseen._servo._start_std = None
    unseen.set_calibration(known)
    assert seen >= 7
    assert seen > successes(unseen, range(10))


@pytest.mark.parametrize("settings", [{}, {"light": 0.7}, {"pan": (4.0, -3.0)}])
def test_light_and_camera_do_not_move_the_hand(demo: Demonstration, settings: Any) -> None:
    """Where the hand starts is asked of environments that say it starts elsewhere."""
    home = toy_camera.project((0, 0, 0))[0]
    still = guided(demo, "none", frozen=True, **settings)
    still.reset(seed=0)
    np.testing.assert_allclose(still.shift_at(home), (0, 0), atol=0.1)
    for seed in range(4):
        env = guided(demo, "none", frozen=True, start=2.0, **settings)
        env.reset(seed=seed)
        moved = toy_camera.project(env.unwrapped.hand)[0] - home
        assert np.linalg.norm(moved) > 1
        seen_at = home + np.array(settings.get("pan", (0, 0)))
        np.testing.assert_allclose(env.shift_at(seen_at), moved, atol=0.8)


def test_a_place_that_takes_several_steps_turns_the_hand_once(known: dict[str, Any]) -> None:
    """The hand is held up by a long way to go: its turn does not go on meanwhile."""
    actions = np.zeros((20, 7), np.float32)
    actions[:, 0], actions[:10, 4], actions[:, 6] = 1.0, 0.3, -1
    ones = np.ones(7, np.float32)
    servo = Servo((84, 84), actions, -ones, ones, gripper_dim=6, rotation_dims=[3, 4, 5])
    servo.load_state({**known, "gripper_dim": 6})
    servo.reset(kind="corrected")
    servo.target_shift = np.array([0.0, 8.0, 0.0])
    turned, picture = np.zeros(3), np.zeros((84, 84, 3), np.uint8)
    for _ in range(30):
        action = servo.action()
        assert action is not None
        turned += action[3:6]
        servo.executed(action, action, picture)
    assert turned == pytest.approx([0, 3, 0], abs=1e-5)


def test_a_gripper_whose_largest_action_is_0(known: dict[str, Any]) -> None:
    """What is off is measured against half of the range."""
    low, high = -np.ones(4, np.float32), np.array([1, 1, 1, 0], np.float32)
    servo = Servo((84, 84), np.zeros((8, 4), np.float32), low, high)
    servo.load_state(known)
    servo.reset(kind="plain")
    action, picture = np.zeros(4, np.float32), np.zeros((84, 84, 3), np.uint8)
    for gripper, followed in ((-0.2, True), (-0.3, False)):
        servo.executed(np.array([0, 0, 0, gripper], np.float32), action, picture)
        assert servo._followed == followed


def test_limits_that_differ_by_direction(known: dict[str, Any]) -> None:
    """The hand goes as far as the environment lets it, and no farther than that is believed."""
    low = np.array([-1, -0.2, -1, -1], np.float32)
    high = np.array([0.4, 1, 1, 1], np.float32)
    actions = np.array([[-1, 1, 0.5, -1]] * 6 + [[0.4, -0.2, -1, -1]] * 2, np.float32)
    servo = Servo((84, 84), actions, low, high)
    places = actions[:, :3].astype(float).cumsum(axis=0)
    np.testing.assert_allclose(servo.demonstrated_path(), places, atol=1e-6)
    servo.load_state(known)
    servo.reset(kind="corrected")
    hand, picture = np.zeros(3), np.zeros((84, 84, 3), np.uint8)
    for expected in actions:
        action = servo.action()
        assert action is not None
        np.testing.assert_allclose(action, expected, atol=1e-6)
        hand += action[:3]
        servo.executed(action, action, picture)
        np.testing.assert_allclose(servo._hand, hand, atol=1e-6)
    servo.executed(np.ones(4, np.float32), action, picture)  # clipped by the environment
    np.testing.assert_allclose(servo._hand, hand + high[:3], atol=1e-6)


def test_actions_that_are_no_numbers_or_beyond_the_limits(known: dict[str, Any]) -> None:
    ones, picture = np.ones(7, np.float32), np.zeros((84, 84, 3), np.uint8)
    servo = Servo((84, 84), np.zeros((8, 7), np.float32), -ones, ones, gripper_dim=6,
                  rotation_dims=[3, 4, 5])  # fmt: skip
    suggested = np.zeros(7, np.float32)
    servo.reset()  # calibration moves
    servo.executed(suggested * np.nan, suggested, picture)
    assert servo.kind != "calibration"  # somebody else acts
    servo.load_state({**known, "gripper_dim": 6})
    servo.reset(kind="corrected")
    servo.executed(5 * ones, 5 * ones, picture)
    np.testing.assert_array_equal(servo._turned, np.ones(3))
    servo.executed(suggested * np.nan, suggested, picture)
    np.testing.assert_array_equal(servo._turned, np.ones(3))
    np.testing.assert_array_equal(servo._hand, np.ones(3))
    assert not servo._followed


def test_what_moved_apart_is_looked_for_where_it_is_of_use(known: dict[str, Any]) -> None:
    actions = np.zeros((60, 4), np.float32)
    actions[:, 0], actions[:20, 3], actions[20:, 3] = 0.3, -1, 1
    ones = np.ones(4, np.float32)
    servo = Servo((84, 84), actions, -ones, ones)
    assert servo.grasp == 20
    assert servo.grasp_to_look_at(None) is None  # no camera: it replays plainly
    servo.load_state(known)
    found = Displacement((40.0, 40.0), (3.0, 0.0), 1.0, 0.2, 0.1, (0.0, 0.0))
    assert servo.grasp_to_look_at(found) == servo.grasp_to_look_at(None) == 20
    assert servo.grasp_to_look_at(replace(found, changed=0.4)) is None
