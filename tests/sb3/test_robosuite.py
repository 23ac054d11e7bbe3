"""robosuite's own tasks: names, versions, seeds, pictures, the scripted experts."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from regil_wrappers import Demonstration

from regil_sb3.cli import main
from regil_sb3.envs import ROBOSUITE_ROBOTS, ROBOSUITE_TASKS, robosuite_import
from regil_sb3.envs.robosuite import CAMERAS, RobosuiteEnv
from regil_sb3.envs.robosuite_import import import_robosuite


@pytest.fixture(scope="module")
def env():
    """One for all tests of Lift: to make it takes seconds."""
    made = RobosuiteEnv("lift", obs="state", render_mode="rgb_array")
    yield made
    made.close()


def episode(env, seed, steps=3):
    """The first states of an episode of fixed actions."""
    shape = (steps, *env.action_space.shape)
    actions = np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)
    return np.stack([env.reset(seed=seed)[0], *(env.step(action)[0] for action in actions)])


def solved(env, seed):
    """Whether the expert succeeds, and nothing but success ends the episode."""
    _, info = env.reset(seed=seed)
    flags, over = [info["is_success"]], False
    while not over:
        action = env.expert_action()
        assert action in env.action_space
        observation, reward, terminated, truncated, info = env.step(action)
        assert observation in env.observation_space
        assert reward == info["is_success"] == terminated
        flags.append(info["is_success"])
        over = terminated or truncated
    return flags == [False] * (len(flags) - 1) + [True] and not truncated


# Names and versions


def test_every_task_for_one_arm_and_every_arm_is_registered():
    robosuite = import_robosuite()
    from robosuite.models.robots.robot_model import REGISTERED_ROBOTS

    theirs = {
        name
        for name in robosuite.ALL_ENVIRONMENTS
        # LIBERO's own tasks stand there too once it is imported
        if robosuite.environments.base.REGISTERED_ENVS[name].__module__.startswith("robosuite.")
        and not name.startswith("TwoArm")
        and not name.endswith("Single")
    }
    ours = {task: "".join(map(str.capitalize, task.split("-"))) for task in ROBOSUITE_TASKS}
    assert set(ours.values()) == theirs
    arms = {
        name
        for name, arm in REGISTERED_ROBOTS.items()
        # and so do its arms
        if arm.__module__.startswith("robosuite.")
    }
    assert set(ROBOSUITE_ROBOTS.values()) == arms - {"Baxter"}
    ids = {f"regil/robosuite-{task}-{robot}-v0" for task in ours for robot in ROBOSUITE_ROBOTS}
    assert ids <= set(gym.registry)


def test_another_version_gets_one_line(monkeypatch):
    monkeypatch.setattr(import_robosuite(), "__version__", "1.5.1")
    with pytest.raises(
        ImportError, match=r"^robosuite 1\.5\.1 is not 1\.4: pip .*--no-deps robosuite==1\.4\.0$"
    ):
        RobosuiteEnv("lift")


def test_a_missing_package_gets_one_line(monkeypatch):
    monkeypatch.delitem(robosuite_import.sys.modules, "robosuite", raising=False)
    monkeypatch.setattr(robosuite_import.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"^robosuite is not installed: pip .*robosuite==1\.4\.0"):
        RobosuiteEnv("lift")


# Episodes


@pytest.mark.parametrize("obs", ["pixels", "state"])
def test_checkers_have_no_complaint(obs, env):
    from stable_baselines3.common.env_checker import check_env as sb3_check_env

    other = env if obs == "state" else gym.make("regil/robosuite-lift-panda-v0").unwrapped
    assert other.observation_space.shape == ((84, 84, 3) if obs == "pixels" else (42,))
    check_env(other, skip_render_check=True)
    sb3_check_env(other)


def test_seed_decides_every_state(env):
    expected = episode(env, 5)
    assert not np.array_equal(episode(env, 6), expected)
    before = np.random.get_state()[1].copy()
    assert np.array_equal(episode(env, 5), expected)
    assert np.array_equal(np.random.get_state()[1], before)  # robosuite draws from it


@pytest.mark.parametrize(
    ("task", "robot", "actions"),
    [("nut-assembly-square", "sawyer", 7), ("pick-place-can", "ur5e", 7), ("wipe", "jaco", 6)],
)
def test_tasks_that_keep_more_than_the_simulation_does(task, robot, actions):
    """Meshes without a volume, objects put away, dirt that is wiped off, no gripper."""
    other = RobosuiteEnv(task, robot, obs="state", max_steps=3)
    assert other.action_space.shape == (actions,)
    expected = episode(other, 5)
    episode(other, 6)
    assert np.array_equal(episode(other, 5), expected)
    assert other.step(np.zeros(actions, np.float32))[2:4] == (False, True)
    assert other.targets().shape == (1, 3)
    assert (other.metadata["regil"]["gripper_dim"] == "none") == (actions == 6)


def test_without_random_objects_every_episode_begins_alike():
    other = RobosuiteEnv("lift", obs="state", random_object=False)
    assert np.array_equal(other.reset(seed=1)[0], other.reset(seed=2)[0])


def test_scripted_expert_lifts_the_cube(env):
    assert solved(env, 0)


def test_scripted_expert_opens_the_door():
    other = RobosuiteEnv("door", obs="state")
    assert solved(other, 0)
    # It stands by its handle
    assert np.allclose(other.targets(), [other._sim._handle_xpos])


def test_a_task_without_an_expert_says_so(env, monkeypatch):
    monkeypatch.setattr(env, "_task", "stack")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"^robosuite.s stack has no .*: those are lift, door"):
        env.expert_action()


def test_record(tmp_path):
    path = tmp_path / "lift.hdf5"
    assert main(["record", "regil/robosuite-lift-panda-v0", "-o", str(path)]) == 0
    demo = Demonstration.load(path)
    assert demo.frames.shape[1:] == (84, 84, 3)
    assert 30 <= len(demo.actions) <= 80
    assert demo.metadata["control_rate"] == 20


# Pictures


def test_pictures_are_upright_and_not_mirrored(env):
    def cube(*moved):
        """Mean row and column of the red cube, moved from the middle of the table."""
        data = env._sim.sim.data
        data.set_joint_qpos("cube_joint0", [*(np.array([0.1, 0, 0.9]) + moved), 1, 0, 0, 0])
        env._sim.sim.forward()
        frame = env.encoder_frame(256).astype(int)
        return np.argwhere(frame[..., 0] > frame[..., 1] + 60).mean(axis=0)

    env.reset(seed=0)
    still = cube(0, 0, 0)
    assert cube(0, 0, 0.05)[0] < still[0] - 5
    assert cube(0, 0.05, 0)[1] > still[1] + 5  # +y is to the right, seen from before the robot
    assert cube(0.05, 0, 0)[0] > still[0] + 5  # nearer to the camera


def test_larger_frames_are_drawn_when_asked(env):
    env.reset(seed=0)
    assert env.encoder_frame(224).shape == (224, 224, 3)
    assert np.array_equal(env.render(), env.encoder_frame(84))


# Bad arguments


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "lifts"}, r"^task 'lifts' is not one of robosuite's: try lift$"),
        ({"robot": "baxter"}, r"^robot 'baxter' is not one of iiwa, .*ur5e$"),
        ({"camera": "corner"}, r"^camera 'corner' is not one of agentview, .*robotview$"),
        ({"size": 0}, r"^size 0 must be at least 1$"),
    ],
)
def test_bad_arguments_get_one_line(arguments, message):
    with pytest.raises(ValueError, match=message):
        RobosuiteEnv(**{"task": "lift", **arguments})


def test_cameras_exist(env):
    names = {env._sim.sim.model.camera_id2name(i) for i in range(env._sim.sim.model.ncam)}
    assert set(CAMERAS) <= names
