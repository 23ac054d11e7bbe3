"""Meta-World's tasks: seeds, pictures, endings, processes, bad arguments."""

import gc
import hashlib
import os
import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv

import regil_sb3.envs
from regil_sb3.envs import METAWORLD_TASKS
from regil_sb3.envs.metaworld import CAMERAS, MetaWorldEnv
from regil_sb3.envs.rendering import prepare_graphics

BUTTON = "regil/metaworld-button-press-v0"
PAPER_TASKS = (
    "button-press",
    "door-open",
    "drawer-close",
    "drawer-open",
    "hammer",
    "window-close",
    "window-open",
)


@pytest.fixture
def make():
    made = []

    def make_env(task="button-press", **kwargs):
        made.append(MetaWorldEnv(task, **kwargs))
        return made[-1]

    yield make_env
    for env in made:
        env.close()


def episode(env, seed, steps=4):
    """The first frames of an episode of fixed actions."""
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, 4)).astype(np.float32)
    return np.stack([env.reset(seed=seed)[0], *(env.step(action)[0] for action in actions)])


def fingers(frame):
    """Where the cyan finger is: mean row and column, in pixels from the top left."""
    red, green, blue = (frame[..., i].astype(int) for i in range(3))
    rows, columns = np.nonzero((green > red + 60) & (blue > red + 60))
    assert len(rows) > 3, "the finger is not in the picture"
    return rows.mean(), columns.mean()


# Registration


def test_every_task_of_meta_world_is_registered():
    from metaworld.env_dict import ENV_CLS_MAP

    assert sorted(METAWORLD_TASKS) == sorted(name.removesuffix("-v3") for name in ENV_CLS_MAP)
    assert {f"regil/metaworld-{task}-v0" for task in METAWORLD_TASKS} <= set(gym.registry)
    regil_sb3.envs.register_envs()  # again: no warning, which would be an error here


def test_registering_imports_no_simulator_and_no_torch():
    code = (
        "import sys, regil_sb3.envs, gymnasium; gymnasium.spec('regil/metaworld-hammer-v0'); "
        "print({'metaworld', 'mujoco', 'torch', 'stable_baselines3'} & set(sys.modules))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "set()"


@pytest.mark.parametrize("obs", ["pixels", "state"])
def test_gymnasium_checker_has_no_complaint(obs):
    env = gym.make(BUTTON, obs=obs)
    check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize("obs", ["pixels", "state"])
def test_sb3_checker_has_no_complaint(obs, make):
    from stable_baselines3.common.env_checker import check_env as sb3_check_env

    sb3_check_env(make(obs=obs))


def test_spec_rebuilds_the_environment():
    env = gym.make(BUTTON, camera="corner-near", size=32, max_steps=7, random_object=False)
    again = gym.make(env.spec)
    assert again.unwrapped.metadata == env.unwrapped.metadata
    assert np.array_equal(episode(env, 1), episode(again, 1))
    env.close()
    again.close()


def test_pickle_rebuilds_the_environment(make):
    env = make(size=32)
    expected = episode(env, 1)  # with a renderer in use, which cannot be pickled
    again = pickle.loads(pickle.dumps(env))
    assert np.array_equal(episode(again, 1), expected)
    again.close()


# Seeds


@pytest.mark.parametrize("task", PAPER_TASKS)
def test_seed_decides_every_frame(task, make):
    env = make(task, size=32)
    expected = episode(env, 5)
    other = episode(env, 6, steps=12)
    assert not np.array_equal(other[0], expected[0])
    assert np.array_equal(episode(env, 5), expected)
    assert np.array_equal(episode(make(task, size=32), 5), expected)


def test_same_frames_in_another_process_that_ends_without_a_word(make):
    # It closes nothing, and a module that outlives the others holds the graphics context: the
    # library must not complain when Python ends.
    code = (
        "import hashlib, threading; from regil_sb3.envs import metaworld, rendering; "
        "e = metaworld.MetaWorldEnv('hammer'); threading.kept = rendering._gl_context(); "
        "print(hashlib.sha256(e.reset(seed=3)[0].tobytes() + e.step([1, 1, 1, 1])[0].tobytes())"
        ".hexdigest())"
    )
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True
    )
    env = make("hammer")
    frames = env.reset(seed=3)[0].tobytes() + env.step(np.ones(4, np.float32))[0].tobytes()
    assert run.stdout.strip() == hashlib.sha256(frames).hexdigest()
    assert run.stderr == ""


def test_each_reset_places_the_object_anew(make):
    env = make(size=32)
    frames = [env.reset(seed=0)[0], env.reset()[0], env.reset()[0]]
    assert len({frame.tobytes() for frame in frames}) == 3
    again = [env.reset(seed=0)[0], env.reset()[0], env.reset()[0]]
    assert np.array_equal(again, frames)


def test_random_object_false_keeps_the_object_in_place(make):
    env = make(size=32, random_object=False)
    frames = {env.reset(seed=seed)[0].tobytes() for seed in (None, 0, 1, None)}
    assert len(frames) == 1


# Pictures


@pytest.mark.parametrize("render_mode", [None, "rgb_array"])
def test_observation_is_an_84_pixel_frame_whatever_render_mode_is(render_mode):
    env = gym.make(BUTTON, render_mode=render_mode)
    assert env.observation_space == gym.spaces.Box(0, 255, (84, 84, 3), np.uint8)
    frame, _ = env.reset(seed=0)
    assert frame in env.observation_space
    if render_mode:
        assert np.array_equal(env.render(), frame)
    env.close()


@pytest.mark.parametrize("camera", [name for name in CAMERAS if name.startswith("corner")])
def test_pictures_are_upright(camera, make):
    env = make(camera=camera, size=200)
    start = fingers(env.reset(seed=0)[0])[0]
    for _ in range(8):
        frame = env.step(np.array([0, 0, 1, -1], np.float32))[0]
    assert fingers(frame)[0] < start - 5  # the hand went up


def test_only_the_rows_are_flipped(make):
    # The default camera hangs upside down. Rows flipped alone leave a mirror image, as in the
    # pictures of others who flip it: away from the robot (+y) is to the left.
    env = make(size=200)
    start = fingers(env.reset(seed=0)[0])[1]
    for _ in range(5):
        frame = env.step(np.array([0, 1, 0, -1], np.float32))[0]
    assert fingers(frame)[1] < start - 5


def test_a_camera_that_hangs_upright_is_upright_too(make):
    env = make(camera="topview", size=200)
    far = env.reset(seed=0)[0].astype(int)
    yellow = (far[..., 0] > 150) & (far[..., 1] > 100) & (far[..., 2] < 60)
    assert np.nonzero(yellow)[0].mean() < 100  # the box stands far from the robot: on top


@pytest.mark.parametrize("task", ["reach", "push", "pick-place", "drawer-open", "window-open"])
def test_the_goal_is_not_in_the_picture(task, make):
    import mujoco

    env = make(task)
    before = env.reset(seed=0)[0]
    model, data = env._sim.model, env._sim.data
    model.site("goal").pos = np.add(model.site("goal").pos, [0.05, -0.1, 0.1])
    mujoco.mj_forward(model, data)
    assert np.array_equal(env.encoder_frame(84), before)
    env._renderer._options.sitegroup[:] = 1
    assert not np.array_equal(env.encoder_frame(84), before)  # so this test can fail


@pytest.mark.parametrize("task", ["drawer-open", "window-open", "window-close", "button-press"])
def test_the_first_frame_shows_this_episode(task, make):
    import mujoco

    env = make(task)
    env.reset(seed=1)
    frame = env.reset(seed=2)[0]
    mujoco.mj_forward(env._sim.model, env._sim.data)
    assert np.array_equal(env.encoder_frame(84), frame)


def test_larger_frames_are_drawn_when_asked(make):
    env = make(render_mode="rgb_array", render_size=120)
    frame = env.reset(seed=0)[0]
    other = make(size=224)
    assert np.array_equal(env.encoder_frame(224), other.reset(seed=0)[0])
    assert env.render().shape == (120, 120, 3)
    assert np.array_equal(env.encoder_frame(84), frame)


def test_environments_do_not_disturb_one_another(make):
    first, second = make(), make("hammer", camera="corner-near")
    expected = first.reset(seed=0)[0], second.reset(seed=0)[0]
    third = MetaWorldEnv("window-open")
    third.reset(seed=0)
    del third  # never closed
    gc.collect()
    assert np.array_equal(first.encoder_frame(84), expected[0])
    assert np.array_equal(second.encoder_frame(84), expected[1])
    first.close()
    first.close()
    assert np.array_equal(second.encoder_frame(84), expected[1])
    assert np.array_equal(first.encoder_frame(84), expected[0])


def test_graphics_library_is_chosen_only_where_the_user_chose_none(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY", "LP_NUM_THREADS"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("DISPLAY", ":0")
    prepare_graphics()
    assert "MUJOCO_GL" not in os.environ
    monkeypatch.delenv("DISPLAY")
    prepare_graphics()
    assert os.environ["MUJOCO_GL"] == "egl"
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    prepare_graphics()
    assert os.environ["MUJOCO_GL"] == "osmesa"


# Episodes


@pytest.mark.parametrize("task", PAPER_TASKS)
def test_scripted_expert_solves_the_task_and_success_terminates(task, make):
    env = make(task, obs="state")
    _, info = env.reset(seed=0)
    flags = [info["is_success"]]
    terminated = truncated = False
    while not (terminated or truncated):
        action = env.expert_action()
        assert action in env.action_space
        observation, _, terminated, truncated, info = env.step(action)
        assert observation in env.observation_space
        flags.append(info["is_success"])
    assert terminated
    assert not truncated
    assert flags == [False] * (len(flags) - 1) + [True]


def test_time_limit_counts_agent_steps_and_truncates(make):
    env = make(obs="state")
    env.reset(seed=0)
    ends = [env.step(np.zeros(4, np.float32))[2:4] for _ in range(125)]
    assert ends == [(False, False)] * 124 + [(False, True)]


def test_success_at_the_last_step_is_no_truncation(make):
    env = make(obs="state")
    env.reset(seed=0)
    steps = 1
    while not env.step(env.expert_action())[2]:
        steps += 1
    short = make(obs="state", max_steps=steps)
    short.reset(seed=0)
    ends = [short.step(short.expert_action())[2:4] for _ in range(steps)]
    assert ends[-1] == (True, False)


def test_action_is_repeated_and_rewards_summed(make):
    once, twice = make(obs="state", action_repeat=1), make(obs="state", action_repeat=2)
    once.reset(seed=0)
    twice.reset(seed=0)
    action = np.array([0.3, -0.2, 0.1, 1], np.float32)
    parts = [once.step(action) for _ in range(2)]
    whole = twice.step(action)
    assert np.array_equal(whole[0], parts[1][0])
    assert whole[1] == parts[0][1] + parts[1][1]
    assert parts[0][1] > 0


def test_repetition_stops_at_success(make):
    env = make(obs="state", action_repeat=1)
    env.reset(seed=0)
    reward = 0.0
    before = []
    terminated = False
    while not terminated:
        before.append(env.expert_action())
        _, reward, terminated, _, _ = env.step(before[-1])
    many = make(obs="state", action_repeat=1)
    many.reset(seed=0)
    for action in before[:-1]:
        many.step(action)
    many._action_repeat = 50
    assert many.step(before[-1])[1] == reward


def test_actions_are_clipped(make):
    env, other = make(obs="state"), make(obs="state")
    env.reset(seed=0)
    other.reset(seed=0)
    for _ in range(3):
        first = env.step(np.array([5, -5, 3, 9], np.float32))
        second = other.step(np.array([1, -1, 1, 1], np.float32))
        assert np.array_equal(first[0], second[0])


def test_state_knows_the_object_and_the_goal(make):
    env = make("reach", obs="state")
    observation, _ = env.reset(seed=0)
    assert observation.shape == (39,)
    assert observation.dtype == np.float32
    assert np.allclose(observation[-3:], env._sim._target_pos)
    assert np.allclose(observation[:18], observation[18:36])


def test_metadata_describes_this_instance(make):
    fast, slow = make(), make(action_repeat=4, camera="corner3", size=64)
    assert fast.metadata["regil"] == {
        "camera": "corner4",
        "render": {"shadows": False, "reflections": False, "samples": 0, "sites": False},
        "image_size": [84, 84],
        "action_repeat": 2,
        "control_rate": 40.0,
        "translation_dims": [0, 1, 2],
        "gripper_dim": 3,
        "plane": [5.0, 5.0, 0.25],
        "mirror": -1,
        "step_cm": 2.0,
    }
    ours = slow.metadata["regil"]
    assert (ours["camera"], ours["image_size"], ours["control_rate"]) == ("corner3", [64, 64], 20.0)
    seconds = slow._sim.data.time
    slow.reset(seed=0)
    seconds = slow._sim.data.time
    slow.step(np.zeros(4, np.float32))
    assert slow._sim.data.time - seconds == pytest.approx(1 / ours["control_rate"])


# Processes


# Python 3.12 and later warn of any fork beside threads, whoever started them.
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
@pytest.mark.parametrize("context", ["fork", "spawn"])
@pytest.mark.timeout(60)
def test_vector_environments_in_processes_give_the_same_frames(context, make):
    if context == "fork" and sys.platform != "linux":
        pytest.skip("fork is the default on Linux only")
    single = make(size=32)
    expected = [single.reset(seed=seed)[0] for seed in (7, 8)]  # this process has drawn already
    spec = gym.spec(BUTTON)  # a fresh process has registered nothing
    envs = AsyncVectorEnv([lambda: gym.make(spec, size=32)] * 2, context=context)
    frames, _ = envs.reset(seed=7)
    envs.close()
    assert np.array_equal(frames, expected)


# Bad arguments


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "buton-press"}, r"^task 'buton-press' .*button-press, .*"),
        ({"camera": "corner5"}, r"^camera 'corner5' is not one of corner4, .*gripperPOV"),
        ({"obs": "image"}, r"^obs 'image' must be 'pixels' or 'state'$"),
        ({"render_mode": "human"}, r"^render_mode 'human' must be 'rgb_array' or None$"),
        ({"size": 0}, r"^size 0 must be at least 1$"),
        ({"action_repeat": 0}, r"^action_repeat 0 must be"),
        ({"max_steps": -1}, r"^max_steps -1 must be"),
        ({"render_size": 0}, r"^render_size 0 must be"),
    ],
)
def test_bad_arguments_get_one_line(arguments, message):
    with pytest.raises(ValueError, match=message) as caught:
        MetaWorldEnv(**{"task": "button-press", **arguments})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("action", [np.full(4, np.nan), np.zeros(3)])
def test_bad_actions_are_refused(action, make):
    env = make(obs="state")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="must be 4 finite numbers"):
        env.step(action)


def test_use_before_reset_gets_one_line(make):
    env = make(obs="state")
    with pytest.raises(ValueError, match="call reset"):
        env.expert_action()
    with pytest.raises(ValueError, match="call reset"):
        env.step(np.zeros(4, np.float32))


def test_missing_meta_world_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "metaworld.env_dict", None)
    with pytest.raises(ImportError, match=r"pip install 'regil-sb3\[meta"):
        MetaWorldEnv("button-press")


def test_unknown_graphics_library_gets_one_line():
    code = "from regil_sb3.envs.rendering import _gl_context as g; g()"
    run = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "MUJOCO_GL": "off"},
        capture_output=True,
        text=True,
    )
    assert run.stderr.splitlines()[-1].endswith("MUJOCO_GL='off' must be one of egl, glfw, osmesa")
