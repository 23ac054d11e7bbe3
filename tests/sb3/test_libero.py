"""LIBERO's tasks: names, assets, initial states, pictures, endings, the scripted experts."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import zipfile

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from regil_wrappers import Demonstration, formats

from regil_sb3.cli import main
from regil_sb3.envs import EVALUATION_SEEDS, LIBERO_TASKS, libero_import, robosuite_import
from regil_sb3.envs.libero import CAMERAS, LiberoEnv
from regil_sb3.envs.libero_import import ASSETS, initial_states
from regil_sb3.envs.libero_tasks import SHORT_LIBERO_TASKS

DRAWER = "regil/libero-kitchen1-drawer-v0"
UP = np.array([0, 0, 1, 0, 0, 0, -1], np.float32)


@pytest.fixture(scope="module")
def env(libero_assets):
    """One for all tests: to make it takes seconds."""
    made = LiberoEnv("kitchen1-drawer", obs="state", render_mode="rgb_array", max_steps=100)
    yield made
    made.close()


def episode(env, seed, steps=3):
    """The first states of an episode of fixed actions."""
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, 7)).astype(np.float32)
    return np.stack([env.reset(seed=seed)[0], *(env.step(action)[0] for action in actions)])


# Names


def test_every_task_of_libero_is_registered():
    files = (libero_import._package() / "bddl_files").glob("*/*.bddl")
    theirs = {(file.parent.name, file.stem) for file in files}
    assert len(theirs) == 130
    assert set(LIBERO_TASKS.values()) == theirs
    assert len(LIBERO_TASKS) == 130 + len(SHORT_LIBERO_TASKS) == 136
    assert {f"regil/libero-{task}-v0" for task in LIBERO_TASKS} <= set(gym.registry)


def test_registering_imports_no_simulator():
    code = (
        f"import sys, regil_sb3.envs, gymnasium; gymnasium.spec({DRAWER!r}); "
        "print({'libero', 'robosuite', 'mujoco', 'torch'} & set(sys.modules))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "set()"


# What it reads


def test_initial_states_of_every_task():
    for suite, task in set(LIBERO_TASKS.values()):
        states = initial_states(suite, task)
        assert states.shape[0] == 50
        assert np.isfinite(states).all()


class _Harmful:
    def __reduce__(self):
        return os.system, ("true",)


@pytest.mark.parametrize(
    "content", [_Harmful(), [1, 2], np.zeros((2, 2), "U1"), b"no pickle at all"]
)
def test_a_file_of_initial_states_that_holds_anything_else_is_refused(
    content, tmp_path, monkeypatch
):
    monkeypatch.setattr(libero_import, "_package", lambda: tmp_path)
    (tmp_path / "init_files/suite").mkdir(parents=True)
    with zipfile.ZipFile(tmp_path / "init_files/suite/task.pruned_init", "w") as archive:
        data = content if isinstance(content, bytes) else pickle.dumps(content, 2)
        archive.writestr("archive/data.pkl", data)
    with pytest.raises(ValueError, match=r"task\.pruned_init"):
        initial_states("suite", "task")
    with pytest.raises(ValueError, match=r"other\.pruned_init cannot be read"):
        initial_states("suite", "other")


@pytest.mark.parametrize("named", [None, "nowhere"])
def test_missing_assets_get_one_line(named, tmp_path, monkeypatch):
    if named is None:
        monkeypatch.delenv(ASSETS, raising=False)
    else:
        monkeypatch.setenv(ASSETS, str(tmp_path / named))
    with pytest.raises(ValueError, match=r"assets.*environment variable REGIL_LIB") as caught:
        LiberoEnv("kitchen1-drawer")
    assert "\n" not in str(caught.value)


def test_assets_that_lack_what_a_task_needs_get_one_line(libero_assets):
    with pytest.raises(ValueError, match=r"assets lack something that .*basket needs: ") as caught:
        LiberoEnv("object-pick-up-the-milk-and-place-it-in-the-basket")
    assert "\n" not in str(caught.value)


def test_missing_packages_get_one_line(monkeypatch):
    find = robosuite_import.importlib.util.find_spec
    monkeypatch.setattr(
        robosuite_import.importlib.util,
        "find_spec",
        lambda name: None if name == "libero" else find(name),
    )
    with pytest.raises(ImportError, match=r"LIBERO is not installed: pip .*--no-deps robosuite=="):
        LiberoEnv("kitchen1-drawer")


def test_import_asks_nothing_and_leaves_the_process_as_it_was(libero_assets, tmp_path):
    code = (
        "import os, warnings; "
        "from regil_sb3.envs.libero_import import import_libero; import_libero(); "
        "print(os.environ.get('MUJOCO_GL'), 'LIBERO_CONFIG_PATH' in os.environ, "
        "('once', None, DeprecationWarning, None, 0) in warnings.filters)"
    )
    env = {**os.environ, "HOME": str(tmp_path)}
    for name in ("LIBERO_CONFIG_PATH", "MUJOCO_GL"):
        env.pop(name, None)
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        env=env,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
    )
    assert (run.stdout, run.stderr) == ("None False False\n", "")
    assert not (tmp_path / ".libero").exists()


# Episodes


@pytest.mark.parametrize("obs", ["pixels", "state"])
def test_checkers_have_no_complaint(obs, env):
    from stable_baselines3.common.env_checker import check_env as sb3_check_env

    other = env if obs == "state" else gym.make(DRAWER).unwrapped
    assert other.observation_space.shape == ((128, 128, 3) if obs == "pixels" else (29,))
    check_env(other, skip_render_check=True)
    sb3_check_env(other)


def test_seed_decides_every_state(env):
    expected = episode(env, 5)
    assert not np.array_equal(episode(env, 6), expected)
    before = np.random.get_state()[1].copy()
    assert np.array_equal(episode(env, 5), expected)
    assert np.array_equal(np.random.get_state()[1], before)  # LIBERO draws from it


def test_each_reset_places_the_objects_anew(env):
    states = [env.reset(seed=0)[0], env.reset()[0], env.reset()[0]]
    assert len({state.tobytes() for state in states}) == 3
    again = [env.reset(seed=0)[0], env.reset()[0], env.reset()[0]]
    assert np.array_equal(again, states)


@pytest.mark.parametrize("i", [0, 7, 57])
def test_seeds_of_evaluation_name_the_initial_states(i, env):
    bowl = slice(9, 11)
    # time, 9 of the arm, 3 of the drawers, then the bowl
    columns = env._sim.sim.model.get_joint_qpos_addr("akita_black_bowl_1_joint0")[0] + 1
    expected = env._states[i % 50, columns : columns + 2]
    state = env.reset(seed=EVALUATION_SEEDS + i)[0]
    assert np.allclose(state[bowl], expected, atol=2e-3)  # it falls, and may slide a little
    assert not np.allclose(env.reset(seed=i)[0][bowl], expected, atol=2e-3)


def test_scripted_expert_solves_the_task_and_success_terminates(env):
    for seed in (0, EVALUATION_SEEDS):
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
        assert flags == [False] * (len(flags) - 1) + [True]
        assert not truncated


def test_time_limit_truncates(env):
    env.reset(seed=0)
    ends = [env.step(np.zeros(7, np.float32))[2:4] for _ in range(100)]
    assert ends == [(False, False)] * 99 + [(False, True)]


def test_declared_step_is_what_the_hand_makes_of_an_action(env):
    start = env.reset(seed=0)[0][2]
    for _ in range(8):
        state = env.step(UP)[0]
    for _ in range(10):
        state = env.step(0 * UP)[0]
    assert 100 * (state[2] - start) == pytest.approx(8 * env.metadata["regil"]["step_cm"], rel=0.1)


# Pictures


def test_pictures_are_upright_and_not_mirrored(env):
    def fingers(frame):
        """Mean row and column of what the gripper's opening changes."""
        before = frame.astype(int)
        for _ in range(12):
            env.step(np.array([0, 0, 0, 0, 0, 0, 1], np.float32))
        changed = np.abs(env.encoder_frame(256).astype(int) - before).max(axis=2) > 25
        return np.argwhere(changed).mean(axis=0)

    places = []
    for action in (0 * UP, UP, np.array([0, 1, 0, 0, 0, 0, 0], np.float32)):
        env.reset(seed=0)
        for _ in range(6):
            env.step(action)
        for _ in range(8):
            env.step(-np.array([0, 0, 0, 0, 0, 0, 1], np.float32))
        places.append(fingers(env.encoder_frame(256)))
    still, raised, aside = places
    assert raised[0] < still[0] - 5
    assert aside[1] > still[1] + 5  # +y is to the right, seen from before the robot


def test_larger_frames_are_drawn_when_asked(env):
    env.reset(seed=0)
    assert env.encoder_frame(224).shape == (224, 224, 3)
    assert np.array_equal(env.render(), env.encoder_frame(128))


# Demonstrations


def test_record_and_the_layout_of_libero_own_demonstrations(libero_assets, tmp_path):
    path, theirs = tmp_path / "drawer.hdf5", tmp_path / "theirs.hdf5"
    assert main(["record", DRAWER, "-o", str(path)]) == 0
    demo = Demonstration.load(path)
    assert demo.frames.shape[1:] == (128, 128, 3)
    assert demo.metadata["control_rate"] == 20
    formats.write(demo, theirs, "libero")
    read = formats.read(theirs, "libero")
    assert np.array_equal(read.frames, demo.frames[:-1])
    assert np.array_equal(read.actions, demo.actions)


def test_a_task_without_an_expert_says_so(env, monkeypatch):
    monkeypatch.setattr(env, "_task", "90-kitchen-scene1-put-the-black-bowl-on-the-plate")
    env.reset(seed=0)
    env.expert_action()  # the long name of one that has
    monkeypatch.setattr(env, "_task", "90-kitchen-scene2-open-the-top-drawer-of-the-cabinet")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"drawer-of-the-cabinet-v0 has no scripted expert: "):
        env.expert_action()


# Bad arguments


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "kitchen1-drawr"}, r"^task 'kitchen1-drawr' .*kitchen1-drawer"),
        ({"camera": "corner"}, r"^camera 'corner' is not one of agentview, .*robotview"),
        ({"obs": "image"}, r"^obs 'image' must be 'pixels' or 'state'$"),
        ({"render_mode": "human"}, r"^render_mode 'human' must be 'rgb_array' or None$"),
        ({"size": 0}, r"^size 0 must be at least 1$"),
        ({"max_steps": -1}, r"^max_steps -1 must be"),
    ],
)
def test_bad_arguments_get_one_line(arguments, message):
    with pytest.raises(ValueError, match=message) as caught:
        LiberoEnv(**{"task": "kitchen1-drawer", **arguments})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("action", [np.full(7, np.nan), np.zeros(4)])
def test_bad_actions_are_refused(action, env):
    env.reset(seed=0)
    with pytest.raises(ValueError, match="must be 7 finite numbers"):
        env.step(action)


def test_cameras_exist(env):
    names = {env._sim.sim.model.camera_id2name(i) for i in range(env._sim.sim.model.ncam)}
    assert set(CAMERAS) <= names
