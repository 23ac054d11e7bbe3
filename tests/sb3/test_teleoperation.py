"""A person at keyboard, gamepad and SpaceMouse: real events through the real loop and window."""

from __future__ import annotations

import errno
import os
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
import toy_camera
from regil_wrappers import Demonstration

from regil_sb3.cli import main
from regil_sb3.recording import Recorder
from regil_sb3.teleoperation.devices import Axes, Gamepad, Keyboard, SpaceMouse
from regil_sb3.teleoperation.session import Session, teleoperate

pg = pytest.importorskip("pygame", reason="pygame is not installed")

ENV = "ToyCamera-v0"


@pytest.fixture(autouse=True)
def no_screen(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


class Person:
    """Presses something each time that the loop comes round; gives up in the end."""

    def __init__(self, *acts, most=300):
        self.acts, self.rates, self.most = list(acts), [], most

    def tick(self, rate):
        self.rates.append(rate)
        assert len(self.rates) < self.most, "it goes on for ever"
        for event in self.acts.pop(0) if self.acts else [pg.event.Event(pg.QUIT)]:
            pg.event.post(event)


def down(*keys):
    return [pg.event.Event(pg.KEYDOWN, key=key) for key in keys]


def up(*keys):
    return [pg.event.Event(pg.KEYUP, key=key) for key in keys]


def press(*keys):
    return down(*keys) + up(*keys)


def hold(key, ticks):
    """The key is down for so many rounds."""
    return [down(key), *[[]] * (ticks - 1), up(key)]


# The square of seed 0, where it stands: 2 right, 4 away, 22 down
TO_HOME = [*hold(pg.K_RIGHT, 2), *hold(pg.K_UP, 4), *hold(pg.K_s, 22)]
STILL = {"frozen": True}


def played(*acts, **settings):
    person = Person(*acts)
    return teleoperate(ENV, clock=person, **{"env_kwargs": STILL, **settings}), person


def test_an_episode_by_keyboard():
    demo, person = played(*TO_HOME, [], press(pg.K_RETURN))
    assert demo.successes.tolist() == [*[False] * (len(demo) - 1), True]
    assert 0 < np.abs(demo.actions[:, :3]).sum(axis=1).max() <= 1
    assert demo.actions[:2].tolist() == [[1, 0, 0, -1]] * 2
    assert demo.actions[-1].tolist() == [0, 0, -1, -1]
    assert len(demo) == 28  # no idle frame, though the loop came round more often
    assert set(person.rates) == {20}
    assert demo.metadata["seed"] == 0
    assert demo.metadata["provenance"] == [
        "steered by hand (keyboard), success said by the environment"
    ]
    # what it recorded is what its actions do
    env = gym.make(ENV, **STILL)
    frames = [env.reset(seed=0)[0], *[env.step(action)[0] for action in demo.actions]]
    np.testing.assert_array_equal(frames, demo.frames)


def test_success_said_by_the_person():
    demo, _ = played(*hold(pg.K_RIGHT, 3), press(pg.K_RETURN), [], press(pg.K_RETURN))
    assert len(demo) == 4
    assert demo.successes[-1]
    assert demo.metadata["provenance"] == ["steered by hand (keyboard), success said by a person"]
    # not before something was done, and the window's own buttons do the same
    click = [pg.event.Event(pg.MOUSEBUTTONDOWN, button=1, pos=(40, 25))]
    demo, _ = played(click, *hold(pg.K_LEFT, 1), click, [], click)
    assert demo.actions.tolist() == [[-1, 0, 0, -1]]


def test_undo_takes_back_the_last_second():
    wrong = hold(pg.K_LEFT, 20)  # a second at 20 a second
    demo, _ = played(*hold(pg.K_RIGHT, 2), *wrong, press(pg.K_BACKSPACE), *TO_HOME[3:], [],
                     press(pg.K_RETURN))  # fmt: skip
    alone, _ = played(*TO_HOME, [], press(pg.K_RETURN))
    np.testing.assert_array_equal(demo.actions, alone.actions)
    np.testing.assert_array_equal(demo.frames, alone.frames)


def test_undo_after_the_end_goes_on():
    """Reviewed, taken back, done again."""
    demo, _ = played(*TO_HOME, [], press(pg.K_BACKSPACE), [], *hold(pg.K_s, 20), [],
                     press(pg.K_RETURN))  # fmt: skip
    assert len(demo) == 28
    assert demo.successes.tolist() == [*[False] * 27, True]


def test_begin_again_takes_the_next_seed():
    demo, _ = played(*hold(pg.K_LEFT, 4), press(pg.K_r), *hold(pg.K_RIGHT, 2), press(pg.K_RETURN),
                     [], press(pg.K_RETURN), seed=7, env_kwargs={})  # fmt: skip
    assert demo.metadata["seed"] == 8
    assert len(demo) == 3
    env = gym.make(ENV)
    np.testing.assert_array_equal(env.reset(seed=8)[0], demo.frames[0])


def test_giving_up_keeps_nothing(tmp_path, monkeypatch, capsys):
    assert played(*hold(pg.K_LEFT, 4), press(pg.K_ESCAPE))[0] is None
    assert played(*TO_HOME, [], press(pg.K_ESCAPE))[0] is None  # in the review
    assert played([])[0] is None  # the window is closed
    pg.display.init()
    monkeypatch.setattr("regil_sb3.teleoperation.window.Window.clock", lambda self: Person([]))
    path = tmp_path / "demo.hdf5"
    assert main(["record", ENV, "--teleop", "keyboard", "-o", str(path)]) == 0
    assert "nothing was recorded" in capsys.readouterr().err
    assert not path.exists()


def test_what_cannot_be_written_is_kept_elsewhere(tmp_path, monkeypatch, capsys):
    path = tmp_path / "demo.hdf5"

    def full(demo, target, save=Demonstration.save):
        if target == path:
            raise OSError(errno.ENOSPC, "No space left on device")
        save(demo, target)

    person = Person(*TO_HOME, [], press(pg.K_RETURN))
    monkeypatch.setattr("regil_sb3.teleoperation.window.Window.clock", lambda self: person)
    monkeypatch.setattr(Demonstration, "save", full)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    words = ["record", ENV, "--teleop", "keyboard", "-o", str(path), "--env-kwargs", "frozen=true"]
    assert main(words) == 2
    assert not path.exists()
    (kept,) = tmp_path.rglob("demo.hdf5")
    assert str(kept) in capsys.readouterr().err
    assert len(Demonstration.load(kept)) == 28


def test_time_that_is_over_is_no_success():
    demo, _ = played(*hold(pg.K_LEFT, 9), [], press(pg.K_RETURN), [], press(pg.K_r), [],
                     *hold(pg.K_RIGHT, 2), press(pg.K_RETURN), [], press(pg.K_RETURN),
                     env_kwargs={"max_steps": 9})  # fmt: skip
    assert (len(demo), demo.metadata["seed"]) == (3, 1)  # Enter did not keep the first


def test_the_gripper_and_time():
    keys = [press(pg.K_SPACE), *[[]] * 6, press(pg.K_PERIOD), *[[]] * 6, press(pg.K_RETURN), [],
            press(pg.K_RETURN)]  # fmt: skip
    demo, _ = played(*keys)
    # 0.3 s of each, without anything held
    assert demo.actions.tolist() == [[0, 0, 0, 1]] * 12
    live, _ = played([], [], press(pg.K_RETURN), [], press(pg.K_RETURN), live=True)
    assert live.actions.tolist() == [[0, 0, 0, -1]] * 3


def test_slowly_and_in_turned_directions():
    keys = [down(pg.K_LSHIFT), *hold(pg.K_RIGHT, 1), up(pg.K_LSHIFT), press(pg.K_t),
            *hold(pg.K_RIGHT, 1), press(pg.K_RETURN), [], press(pg.K_RETURN)]  # fmt: skip
    demo, _ = played(*keys)
    assert demo.actions.tolist() == [[0.25, 0, 0, -1], [0, 1, 0, -1]]


def test_keys_of_a_window_that_lost_the_focus_are_up():
    keyboard = Keyboard()
    for event in down(pg.K_RIGHT):
        assert list(keyboard.handle(event)) == []
    assert keyboard.motion().tolist() == [1, 0, 0, 0, 0, 0]
    list(keyboard.handle(pg.event.Event(pg.WINDOWFOCUSLOST)))
    assert not keyboard.motion().any()


class Moody(toy_camera.ToyCamera):
    """Its seed decides nothing."""

    def reset(self, *, seed=None, options=None):
        return super().reset()


def test_an_environment_that_does_not_repeat_itself():
    session = Session(Recorder(Moody()), 0)
    for _ in range(30):
        session.step(np.float32([1, 0, 0, -1]), closed=False)
    session.undo(20)
    assert "does not repeat itself" in session.said
    assert len(session.recorder) == 0  # nothing that no action leads to
    honest = Session(Recorder(toy_camera.ToyCamera()), 0)
    for _ in range(30):
        honest.step(np.float32([1, 0, 0, -1]), closed=True)
    kept = honest.recorder.frames[10]
    honest.undo(20)
    assert (honest.said, len(honest.recorder)) == ("undone: 20 steps", 10)
    assert honest.closed
    np.testing.assert_array_equal(honest.recorder.frames[-1], kept)
    honest.undo(20)
    assert (honest.said, len(honest.recorder), honest.closed) == ("undone: 10 steps", 0, False)


class Robot(toy_camera.ToyCamera):
    """There is one."""

    def __init__(self):
        super().__init__()
        self.metadata = {**self.metadata, "regil": {"exists_once": True}}


def test_a_robot_does_not_repeat_what_it_has_done():
    session = Session(Recorder(Robot()), 0)
    for _ in range(30):
        session.step(np.float32([1, 0, 0, -1]), closed=False)
    session.undo(20)
    assert (session.said, len(session.recorder)) == ("a robot takes nothing back: begin again", 30)


class Pad:
    """What pygame gives for a gamepad."""

    def __init__(self, number):
        self.number = number

    def quit(self):
        self.number = None


def test_gamepad(monkeypatch):
    controllers = pytest.importorskip("pygame._sdl2.controller")
    pg.display.init()
    with pytest.raises(ValueError, match="no gamepad is connected"):
        Gamepad()
    monkeypatch.setattr(controllers, "get_count", lambda: 1)
    monkeypatch.setattr(controllers, "is_controller", lambda i: True)
    monkeypatch.setattr(controllers, "Controller", Pad)

    def stick(axis, value):
        return [pg.event.Event(pg.CONTROLLERAXISMOTION, axis=axis, value=value)]

    def button(number):
        return [pg.event.Event(pg.CONTROLLERBUTTONDOWN, button=number)]

    demo, _ = played(
        stick(pg.CONTROLLER_AXIS_LEFTX, 32767),
        stick(pg.CONTROLLER_AXIS_LEFTX, 2000) + stick(pg.CONTROLLER_AXIS_LEFTY, -32767),
        stick(pg.CONTROLLER_AXIS_LEFTY, 0) + stick(pg.CONTROLLER_AXIS_RIGHTY, 32767),
        stick(pg.CONTROLLER_AXIS_RIGHTY, 0) + button(pg.CONTROLLER_BUTTON_A),
        *[[]] * 5,
        button(pg.CONTROLLER_BUTTON_START),
        [],
        button(pg.CONTROLLER_BUTTON_START),
        device="gamepad",
    )
    assert demo.actions[:3].tolist() == [[1, 0, 0, -1], [0, 1, 0, -1], [0, 0, -1, -1]]
    assert demo.actions[3:].tolist() == [[0, 0, 0, 1]] * 6
    assert demo.metadata["provenance"][0].startswith("steered by hand (gamepad)")


class Wire:
    """A SpaceMouse Compact's reports, as they come over USB."""

    def __init__(self, *reports):
        self.reports = list(reports)
        self.closed = False

    def read(self, size, timeout=0):
        return bytes(self.reports.pop(0)) if self.reports else b""

    def close(self):
        self.closed = True


def report(channel, *values):
    return [channel, *(b for v in values for b in int(v).to_bytes(2, "little", signed=True))]


def test_spacemouse():
    """The library's own reading of what the device sends."""
    mice = pytest.importorskip("pyspacemouse", reason="pyspacemouse is not installed")
    from pyspacemouse.loader import get_device_specs

    wire = Wire(
        report(1, 350, 0, 0),
        report(1, 0, -350, 0),
        report(1, 0, 0, -350),
        report(2, 0, 0, 350),
        report(2, 0, 0, 10),  # within the dead zone
        [3, 1, 0],
        [3, 1, 0],
        [3, 0, 0],
    )
    device = SpaceMouse(mice.SpaceMouseDevice(get_device_specs()["SpaceMouseCompact"], wire))
    read = []
    for _ in range(8):
        commands = list(device.poll())
        read.append((device.motion().round(2).tolist(), commands))
    motions = [motion for motion, _ in read]
    assert motions[0] == [1, 0, 0, 0, 0, 0]
    assert motions[1] == [0, 1, 0, 0, 0, 0]
    assert motions[2] == [0, 0, 1, 0, 0, 0]
    assert motions[3][:5] == [0, 0, 1, 0, 0]
    assert abs(motions[3][5]) == 1
    assert motions[4] == [0, 0, 1, 0, 0, 0]
    assert [commands for _, commands in read] == [[]] * 5 + [["gripper"], [], []]  # once
    device.close()
    assert wire.closed


def test_no_spacemouse_is_one_line(capsys, tmp_path):
    pytest.importorskip("pyspacemouse", reason="pyspacemouse is not installed")
    words = ["record", ENV, "--teleop", "spacemouse", "-o", str(tmp_path / "demo.hdf5")]
    assert main(words) == 2
    assert "SpaceMouse" in capsys.readouterr().err


def test_without_a_screen_it_says_so(tmp_path):
    """In a process of its own: SDL's last resort ends the EGL display that MuJoCo draws with."""
    hidden = ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY")
    env = {name: value for name, value in os.environ.items() if name not in hidden}
    words = ["record", "regil/metaworld-reach-v0", "--teleop", "keyboard", "-o", "demo.hdf5"]
    done = subprocess.run(
        [sys.executable, "-m", "regil_sb3.cli", *words],
        env=env, cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "regil: no window can be opened here" in done.stderr


def test_which_dimensions_move():
    def axes(n, **said):
        return Axes.of(gym.spaces.Box(-2, 2, (n,), np.float32), said)

    libero = axes(7)
    assert (libero.translation, libero.rotation, libero.gripper) == ([0, 1, 2], [3, 4, 5], 6)
    assert libero.action(np.arange(6) / 5, True).tolist() == pytest.approx(
        [0, 0.4, 0.8, 1.2, 1.6, 2, 2]
    )
    assert (axes(2).translation, axes(2).rotation, axes(2).gripper) == ([0, 1], [], None)
    assert (axes(6).rotation, axes(6).gripper) == ([3, 4, 5], None)
    declared = axes(4, translation_dims=[1, 2, 3], gripper_dim=0)
    assert declared.action(np.array([1.0, 0, 0, 0, 0, 0]), False).tolist() == [-2, 2, 0, 0]
    wipe = axes(6, gripper_dim="none")  # as robosuite's task declares it
    assert (wipe.rotation, wipe.gripper) == ([3, 4, 5], None)
    assert wipe.action(np.arange(6) / 5, True).tolist() == pytest.approx([0, 0.4, 0.8, 1.2, 1.6, 2])
    assert axes(4, gripper_dim="none").gripper is None
    narrow = Axes.of(gym.spaces.Box(np.float32([0, -1]), np.float32([1, np.inf])), {})
    assert narrow.action(np.zeros(6), False).tolist() == [0, 0]


def test_nothing_pressed_is_no_motion_where_limits_are_not_symmetric():
    box = gym.spaces.Box(np.float32([-0.5, -1, 0.25, -2]), np.float32([1, -0.5, 1, 4]))
    axes = Axes.of(box, {})
    steps = [axes.action(np.full(6, v), v > 0).tolist() for v in (0, -1, -0.5, 0.5, 1)]
    assert [step[:3] for step in steps] == [
        [0, -0.5, 0.25],
        [-0.5, -1, 0.25],
        [-0.25, -0.75, 0.25],
        [0.5, -0.5, 0.625],
        [1, -0.5, 1],
    ]
    assert [step[3] for step in steps] == [-2, -2, -2, 4, 4]  # the gripper has its whole way


class Nothing(gym.Env):
    """No expert, and a state in place of a picture, which it draws."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    observation_space = gym.spaces.Dict(
        {
            "front": gym.spaces.Box(0, 255, (8, 10, 3), np.uint8),
            "state": gym.spaces.Box(-9, 9, (1,), np.float32),
        }
    )
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, render_mode=None, pictures=True):
        self.render_mode = render_mode
        if not pictures:
            self.observation_space = gym.spaces.Box(-9, 9, (1,), np.float32)
        self.pictures = pictures

    def reset(self, *, seed=None, options=None):
        self.x = 0.0
        return self._see(), {}

    def step(self, action):
        self.x += float(action[0])
        return self._see(), 0.0, self.x >= 3, False, {}

    def _see(self):
        state = np.array([self.x], np.float32)
        return {"front": self.render(), "state": state} if self.pictures else state

    def render(self):
        return np.full((8, 10, 3), 20 * self.x, np.uint8)


@pytest.fixture
def without_expert():
    gym.register("Nothing-v0", Nothing)
    yield "Nothing-v0"
    del gym.registry["Nothing-v0"]


def test_without_an_expert_a_window_opens(without_expert, tmp_path, monkeypatch, capsys):
    keys = [*hold(pg.K_RIGHT, 3), [], press(pg.K_RETURN)]
    monkeypatch.setattr("regil_sb3.teleoperation.window.Window.clock", lambda self: Person(*keys))
    path = tmp_path / "new" / "demo.hdf5"
    assert main(["record", without_expert, "-o", str(path)]) == 0
    assert "4 frames, seed 0" in capsys.readouterr().out
    demo = Demonstration.load(path)
    assert demo.frames[:, 0, 0, 0].tolist() == [0, 20, 40, 60]
    assert demo.observations["state"].ravel().tolist() == [0, 1, 2, 3]
    assert list(demo.observations) == ["state"]
    assert demo.actions.tolist() == [[1, 0]] * 3
    assert main(["record", without_expert, "-o", str(path)]) == 2
    assert "exists already" in capsys.readouterr().err


def test_pictures_that_are_rendered_or_missing(without_expert, capsys):
    keys = [*hold(pg.K_RIGHT, 3), [], press(pg.K_RETURN)]
    settings = {"pictures": False, "render_mode": "rgb_array"}
    demo = teleoperate(without_expert, clock=Person(*keys), env_kwargs=settings)
    assert demo.frames.shape == (4, 8, 10, 3)
    assert demo.observations.ravel().tolist() == [0, 1, 2, 3]
    words = ["record", without_expert, "--teleop", "keyboard", "--env-kwargs", "pictures=false"]
    assert main(words) == 2
    assert "gives no pictures" in capsys.readouterr().err
    assert main([*words[:4], "--seed", "1000000"]) == 2
    assert "kept for evaluation" in capsys.readouterr().err
    assert main([*words[:4], "--encoder-size", "112"]) == 2
    assert "no larger pictures" in capsys.readouterr().err


def test_undo_in_a_simulator():
    """Meta-World repeats itself to the last bit."""
    session = Session(Recorder(gym.make("regil/metaworld-button-press-v0", size=32)), 3)
    rng = np.random.default_rng(0)
    for _ in range(8):
        session.step(rng.uniform(-1, 1, 4).astype(np.float32), closed=False)
    before = session.recorder.frames
    session.undo(3)
    assert (session.said, len(session.recorder)) == ("undone: 3 steps", 5)
    np.testing.assert_array_equal(session.recorder.frames, before[:6])
    session.recorder.env.close()
