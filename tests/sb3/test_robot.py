"""RobotEnv on the rehearsal robot: control, limits, faults, and episodes on disk."""

from __future__ import annotations

import os
import pickle
import resource
import signal
import time

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from regil_wrappers import Demonstration
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import regil_sb3  # noqa: F401  registers the environments
from regil_sb3.envs.rehearsal import RehearsalEnv
from regil_sb3.envs.robot import RobotEnv
from regil_sb3.recording import record_expert
from regil_sb3.robots.episodes import EpisodeWriter
from regil_sb3.robots.interfaces import RobotError
from regil_sb3.robots.limits import Limits, Patience
from regil_sb3.robots.rehearsal import Disturbances, Rehearsal

PERIOD = 1 / 30
STILL = np.array([0, 0, 0, 1], np.float32)
SIDEWAYS = np.array([1, 0, 0, 1], np.float32)


class Operator:
    """A person who does what the test says."""

    def __init__(self):
        self.stop = self.hold = self.success = self.closed = False
        self.asked = []

    def succeeded(self):
        return self.success

    def aborted(self):
        return self.stop

    def paused(self):
        return self.hold

    def ready(self, message):
        self.asked.append(message)
        self.stop = False

    def close(self):
        self.closed = True


@pytest.fixture(scope="module")
def reach():
    env = RehearsalEnv("reach")
    yield env
    env.close()


def played(env, action, steps):
    """The last info of so many steps, or of the step that ended the episode."""
    for _ in range(steps):
        _, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            break
    return info


@pytest.mark.parametrize("task", ["reach", "insert", "open"])
def test_the_expert_solves_each_task_where_the_target_moved(task):
    demo = record_expert(f"regil/rehearsal-{task}-v0", seed=3, max_seeds=1)
    assert demo.successes[-1]
    assert 20 < len(demo) < 120
    assert demo.metadata["control_rate"] == 30


def test_both_checkers(reach):
    check_env_sb3(reach)
    env = gym.make("regil/rehearsal-reach-v0", render_mode="rgb_array")
    check_env(env.unwrapped)
    env.close()


def test_a_seed_gives_the_same_episode(reach):
    frames = []
    for _ in range(2):
        frame, _ = reach.reset(seed=5)
        frames.append([frame, *(reach.step(SIDEWAYS)[0] for _ in range(5))])
    assert np.array_equal(*frames)


def test_a_copy_has_the_same_arguments():
    env = RehearsalEnv("insert", size=96, max_steps=7)
    copied = pickle.loads(pickle.dumps(env))
    assert copied.observation_space == env.observation_space
    assert copied._max_steps == 7
    env.close()
    copied.close()


def test_targets_stay_in_the_papers_ranges_and_reach_their_ends(reach):
    offs = []
    for seed in range(60):
        reach.reset(seed=seed)
        offs.append(reach.robot.truth["target"][0] - 0.03)
    assert -0.14 <= min(offs) < -0.12
    assert 0.06 < max(offs) <= 0.08


@pytest.mark.parametrize(
    "way", [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
)
def test_the_hand_stays_in_its_box_and_below_its_speed(reach, way):
    reach.reset(seed=0)
    places = [reach.robot.arm.state().position]
    for _ in range(60):
        _, _, terminated, _, _ = reach.step(np.array([*way, 1], np.float32))
        places.append(reach.robot.arm.state().position)
        if terminated:
            break
    places = np.array(places)
    assert (places >= np.array(reach.limits.low) - 0.002).all()
    assert (places <= np.array(reach.limits.high) + 0.002).all()
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / PERIOD
    assert speeds.max() <= reach.limits.speed * 1.1


def test_limits():
    limits = Limits((0, 0, 0), (1, 1, 1), delta=0.01, speed=0.3, lead=0.02)
    at = np.array([0.5, 0.5, 0.5])
    far = limits.next_target(at, at + np.array([1, 0, 0]), at, 0.1)
    assert np.allclose(far, (0.52, 0.5, 0.5))  # 3 cm by speed, 2 cm by lead
    assert np.allclose(
        limits.next_target(at, at + np.array([0.01, 0, 0]), at, 0.1), (0.51, 0.5, 0.5)
    )
    edge = np.array([0.99, 0.5, 0.5])
    assert limits.next_target(edge, edge + np.array([0.02, 0, 0]), edge, 0.1)[0] == 1.0
    outside = np.array([0.5, 1.3, 0.5])  # a hand that was pushed there
    back = limits.next_target(outside, np.array([0.5, 0.5, 0.5]), outside, 0.05)
    assert np.allclose(back, (0.5, 1.285, 0.5))
    with pytest.raises(ValueError, match="no room"):
        Limits((0, 0, 0), (1, 0, 1))
    with pytest.raises(ValueError, match="speed is 0"):
        Limits((0, 0, 0), (1, 1, 1), speed=0)


FAULTS = {
    # what: (seconds until it can be known, what is said)
    "camera dies": (0.0, "unplugged"),
    "camera stalls": (3 * PERIOD, "no new picture"),
    "frame freezes": (4 * PERIOD, "very same"),
    "arm error": (0.0, "collision"),
    "arm is silent": (2 * PERIOD, "no word"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_stops_the_arm_within_a_period_and_loses_no_episode(fault, tmp_path):
    known, said = FAULTS[fault]
    env = RehearsalEnv("reach", record_to=str(tmp_path))
    for seed in range(4):
        env.reset(seed=seed)
        assert "fault" not in played(env, SIDEWAYS * (1, -1)[seed % 2] * (1, 1, 1, 0), 3 + seed)
        at = env.robot.clock.now()
        env.robot.inject(fault)
        with pytest.warns(RuntimeWarning, match=f"the arm was stopped: .*{said}"):
            info = played(env, SIDEWAYS * (1, -1)[seed % 2], 20)
        assert said in info["fault"]
        assert not info["is_success"]
        if fault == "arm is silent":  # it says what it did when it answers again
            env.robot.arm.recover()
        env.robot.clock.sleep_until(env.robot.clock.now() + PERIOD)
        stopped = env.robot.truth["alone" if fault == "arm is silent" else "held"]
        assert stopped - at <= known + PERIOD + 0.003
    env.reset(seed=9)
    assert "fault" not in played(env, STILL, 5)  # it works again
    env.close()
    written = [Demonstration.load(file) for file in sorted(tmp_path.glob("*.hdf5"))]
    assert len(written) == 5
    assert all(said in demo.metadata["fault"] for demo in written[:4])


def test_the_process_dies_and_the_program_says_so():
    env = RehearsalEnv("reach")
    env.reset(seed=0)
    os.kill(env.robot._process.pid, signal.SIGKILL)
    # Whichever is asked first after that
    gone = r"the arm was stopped: (camera|arm): the rehearsal robot is"
    with pytest.warns(RuntimeWarning, match=gone):
        info = played(env, STILL, 5)
    assert "rehearsal robot is gone" in info["fault"]
    with pytest.raises(RobotError, match=r"is gone .*; it did not come back in 10 s"):
        env.reset()
    with pytest.warns(UserWarning, match="not told to stop"):
        env.close()


def test_an_operator_aborts_pauses_and_says_success():
    operator = Operator()
    env = RehearsalEnv("reach", operator=operator)
    env.reset(seed=0)
    played(env, SIDEWAYS, 3)
    operator.stop = True
    at = env.robot.clock.now()
    with pytest.warns(RuntimeWarning, match="operator: aborted"):
        assert played(env, SIDEWAYS, 5)["fault"] == "operator: aborted"
    assert env.robot.truth["held"] - at <= PERIOD
    env.reset(seed=0)
    assert len(operator.asked) == 1
    where = env.robot.arm.state().position
    env.pause()
    env.robot.clock.sleep_until(env.robot.clock.now() + 1.0)
    env.resume()
    assert np.abs(env.robot.arm.state().position - where).max() < 0.002
    assert "fault" not in played(env, SIDEWAYS, 3)
    operator.success = True
    _, reward, terminated, truncated, info = env.step(STILL)
    assert (reward, terminated, truncated, info["is_success"]) == (1.0, True, False, True)
    env.close()
    assert operator.closed


def test_a_key_that_came_too_late_is_not_the_next_episodes():
    operator, pressed = Operator(), [True]
    env = RehearsalEnv("reach", operator=operator)
    operator.succeeded = lambda: pressed.pop() if pressed else False
    env.reset(seed=0)
    assert not env.step(STILL)[4]["is_success"]
    env.close()


def test_the_hand_does_not_go_home_while_the_operator_pauses(monkeypatch):
    monkeypatch.setattr(RehearsalEnv, "_put_back", RobotEnv._put_back)  # as a real one's
    operator = Operator()
    env = RehearsalEnv("reach", operator=operator)
    env.reset(seed=0)
    played(env, SIDEWAYS, 12)
    at, asked = env.robot.arm.state().position, []

    def paused():  # for 2 s of the next reset
        asked.append(np.abs(env.robot.arm.state().position - at).max())
        return len(asked) < 60

    operator.paused = paused
    env.reset(seed=1)
    assert max(asked[:60]) < 0.004
    assert np.abs(env.robot.arm.state().position - at).max() > 0.02
    env.close()


def test_whatever_a_driver_raises_stops_the_arm(monkeypatch):
    env = RehearsalEnv("reach")
    env.reset(seed=0)

    def fails():
        raise RuntimeError("a driver's own\nerror")

    monkeypatch.setattr(env.robot.arm, "state", fails)
    with pytest.warns(RuntimeWarning, match="the arm was stopped: a driver's own$"):
        env._watch()
    assert env.fault == "a driver's own"
    monkeypatch.undo()
    env.close()


def test_a_terminals_interrupt_leaves_the_rehearsal_robot_alone(reach):
    assert os.getpgid(reach.robot._process.pid) != os.getpgid(0)


@pytest.mark.parametrize("at_once", [False, True])
def test_an_abort_while_paused_leaves_the_arm_stopped_until_reset(at_once, monkeypatch):
    class Aborting(Operator):
        """Pauses, and aborts while paused; goes on ``at_once``, before the watchdog looks."""

        looks = 0

        def paused(self):
            self.looks += self.hold
            if self.looks > 1:
                self.stop, self.hold = True, not at_once
            return self.hold

    operator = Aborting()
    env = RehearsalEnv("reach", operator=operator)
    env.reset(seed=0)
    played(env, SIDEWAYS, 3)
    recovered = []
    recover = env.robot.arm.recover
    monkeypatch.setattr(env.robot.arm, "recover", lambda: (recovered.append(1), recover()))
    operator.hold = True
    with pytest.warns(RuntimeWarning, match="operator: aborted"):
        _, _, _, truncated, info = env.step(SIDEWAYS)
    assert (truncated, info["fault"], recovered) == (True, "operator: aborted", [])
    operator.hold = False
    operator.looks = 0
    env.reset(seed=0)
    assert recovered
    assert "fault" not in played(env, SIDEWAYS, 3)
    env.close()


@pytest.mark.parametrize("call", ["stop", "recover"])
def test_an_arm_that_fails_at_a_pause_ends_the_episode(call, monkeypatch):
    def failed():
        raise RobotError("arm: it is in error")

    def hold():
        env.pause()
        env.resume()

    env = RehearsalEnv("reach")
    env.reset(seed=0)
    played(env, SIDEWAYS, 3)
    with monkeypatch.context() as patch:
        patch.setattr(env.robot.arm, call, failed)
        with pytest.warns(RuntimeWarning, match="the arm was stopped: arm: it is in error"):
            hold()
        _, _, _, truncated, info = env.step(SIDEWAYS)
    assert truncated
    assert info["fault"] == "arm: it is in error"
    env.reset(seed=0)
    assert "fault" not in played(env, SIDEWAYS, 3)
    env.close()


def test_close_writes_the_open_episode_whatever_fails(tmp_path, monkeypatch):
    def closed_with(owner, call, error):
        env = RehearsalEnv("reach", record_to=str(tmp_path))
        env.reset(seed=0)
        played(env, SIDEWAYS, 3)

        def failed():
            raise error

        with monkeypatch.context() as patch:
            for name in ("stop", "close") if owner == "arm" else ("close",):
                patch.setattr(getattr(env.robot, owner), name, failed)
            call(env)
        env.close()  # a second time does nothing
        return env

    def warned(env):
        with pytest.warns(UserWarning, match="not told to stop: arm: it is gone"):
            env.close()

    def raised(env):
        with pytest.raises(OSError, match="unplugged"):
            env.close()

    closed_with("arm", warned, RobotError("arm: it is gone")).robot.close()
    closed_with("camera", raised, OSError("unplugged"))
    written = [Demonstration.load(file) for file in sorted(tmp_path.glob("*.hdf5"))]
    assert [len(demo.actions) for demo in written] == [3, 3]
    assert all(demo.metadata["fault"] == "closed" for demo in written)


def test_a_late_step_stops_the_arm_in_real_time_and_homing_brings_it_back():
    env = RehearsalEnv("reach", real_time=True, patience=Patience(picture=30, state=30))
    env.reset(seed=0)
    played(env, SIDEWAYS, 5)
    left = time.monotonic()
    with pytest.warns(RuntimeWarning, match="late step"):
        time.sleep(0.5)
    info = played(env, SIDEWAYS, 1)
    assert "late step" in info["fault"]
    # Due a period after the last observation, and two more are patience; a busy machine adds some
    assert 0.05 < env.robot.truth["held"] - left < 0.3
    assert env.robot.arm.state().position[0] > 0.02
    env.reset(seed=0)
    assert np.allclose(env.robot.arm.state().position, (0, 0.48, 0.18), atol=0.01)
    assert env.times.summary()["steps"] == 6
    env.close()


def test_an_episode_that_the_library_cannot_write_is_kept_and_others_follow(tmp_path, monkeypatch):
    writer = EpisodeWriter(tmp_path / "episodes")
    save, calls = Demonstration.save, []

    def failing(self, path):
        calls.append(path)
        if len(calls) <= 2:
            raise RuntimeError("Can't decrement id ref count")  # h5py's, of a disk that is full
        save(self, path)

    monkeypatch.setattr(Demonstration, "save", failing)
    black = np.zeros((84, 84, 3), np.uint8)

    def two_episodes():
        for _ in range(2):
            writer.begin(black)
            writer.add(STILL, black, False)
            writer.end({})
        writer._queue.join()

    with pytest.warns(RuntimeWarning, match="was not written .Can't decrement"):
        two_episodes()
    writer.close()
    assert len(list((tmp_path / "episodes").iterdir())) == 2


def test_a_full_disk_keeps_the_episode_until_there_is_room(tmp_path):
    writer = EpisodeWriter(tmp_path / "episodes")
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (9, 84, 84, 3), np.uint8)

    def episode():
        writer.begin(frames[0])
        for frame in frames[1:]:
            writer.add(STILL, frame, False)
        writer.end({})

    unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, unlimited[1]))
    try:
        episode()
        with pytest.warns(RuntimeWarning, match="kept in memory"):
            writer.retry()
        assert "was not written" in writer.error
        with (
            pytest.warns(RuntimeWarning, match="kept in memory"),
            pytest.raises(RobotError, match="1 episodes could not be written"),
        ):
            writer.require_all_written()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
    episode()
    writer.close()
    files = sorted((tmp_path / "episodes").iterdir())
    assert len(files) == 2
    assert all(np.array_equal(Demonstration.load(file).frames, frames) for file in files)


def test_disturbed_pictures_arrive_late_and_not_at_all():
    robot = Rehearsal("reach", real_time=False, disturbances=Disturbances(0.05, dropped=0.5))
    seen = set()
    for _ in range(120):
        robot.clock.sleep_until(robot.clock.now() + PERIOD)
        picture = robot.camera.read()
        if picture is not None:
            assert robot.clock.now() - picture.time >= 0.05 - 1e-6
            seen.add(picture.time)
    assert 40 < len(seen) < 80
    robot.close()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"task": "fly"}, "task 'fly' is not one of reach, insert, open"),
        ({"task": "reach", "jitter": -1}, "jitter is -1"),
        ({"task": "reach", "max_steps": -1}, "max_steps -1 must be at least 1"),
        ({"task": "reach", "start_noise": -0.1}, "start_noise"),
        ({"task": "reach", "render_mode": "human"}, "render_mode 'human'"),
    ],
)
def test_bad_arguments(arguments, said):
    with pytest.raises(ValueError, match=said):
        RehearsalEnv(**arguments)


def test_bad_actions_and_calls(reach):
    reach.reset(seed=0)
    with (
        pytest.raises(ValueError, match="4 finite numbers"),
        pytest.warns(RuntimeWarning, match="policy's action"),
    ):
        reach.step(np.array([np.nan, 0, 0, 0], np.float32))
    reach.reset(seed=0)
    with pytest.raises(ValueError, match="too small for 128"):
        reach.encoder_frame(128)
    fresh = RehearsalEnv("reach")
    with pytest.raises(ValueError, match=r"call reset\(\) first"):
        fresh.step(STILL)
    fresh.close()


def test_no_camera_and_a_camera_with_small_pictures():
    robot = Rehearsal("reach", size=64, real_time=False)
    limits = Limits((-1, -1, 0), (1, 1, 1))
    with pytest.raises(ValueError, match="64x64 pictures, too small for size 84"):
        RobotEnv(robot.camera, robot.arm, limits, (0, 0.5, 0.2), clock=robot.clock)
    robot = Rehearsal("reach", real_time=False)
    robot.inject("camera stalls")
    with pytest.raises(RobotError, match=r"camera: no picture for 10\.0 s"):
        RobotEnv(robot.camera, robot.arm, limits, (0, 0.5, 0.2), clock=robot.clock)
    robot = Rehearsal("reach", real_time=False)
    with pytest.raises(ValueError, match="home"):
        RobotEnv(robot.camera, robot.arm, limits, (0, 5, 0.2), clock=robot.clock)
    robot.close()
