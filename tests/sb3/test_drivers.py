"""Drivers that need no hardware: a film in place of a camera, a terminal of the test's own."""

from __future__ import annotations

import base64
import contextlib
import importlib.util
import json
import os
import pty
import sys
import threading
import time
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import serve

from regil_sb3.envs.robot import RobotEnv
from regil_sb3.robots.arms import FrankaArm
from regil_sb3.robots.cameras import GrabbingCamera, OpenCVCamera, RealSenseCamera
from regil_sb3.robots.interfaces import RobotError
from regil_sb3.robots.limits import Limits
from regil_sb3.robots.operator import Keyboard
from regil_sb3.robots.rehearsal import Rehearsal
from regil_sb3.robots.ros import RosArm, RosCamera


def filmed(path, pictures):
    """A film of 160x120, the left half red."""
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 30, (160, 120))
    picture = np.zeros((120, 160, 3), np.uint8)
    picture[:, :80] = (0, 0, 255)  # OpenCV's order
    for _ in range(pictures):
        writer.write(picture)
    writer.release()
    return path


@pytest.fixture
def film(tmp_path):
    return filmed(str(tmp_path / "film.avi"), 40)


def waited(what):
    """The first true answer within a few seconds."""
    end = time.monotonic() + 10
    while time.monotonic() < end:
        if answer := what():
            return answer
        time.sleep(0.01)
    raise AssertionError("it did not happen")


def test_a_camera_that_opencv_opens(film):
    begun = time.monotonic()
    camera = OpenCVCamera(film, (160, 120))
    picture = waited(lambda: camera._picture)
    assert begun < picture.time <= time.monotonic()
    red, green, blue = picture.image[60, 20]
    assert red > 200 > 60 > max(green, blue)
    waited(lambda: camera._error)  # the film is over: the camera is gone
    with pytest.raises(RobotError, match="no more pictures"):
        camera.read()
    camera.recover()
    picture = waited(lambda: camera._picture)  # a new one; by now the film may be over again
    assert picture.image.shape == (120, 160, 3)
    camera.close()


class FailingCamera(GrabbingCamera):
    """Grabs until it is to fail; counts how often it was opened."""

    opened, failure, frozen = 0, None, False

    def _open(self):
        self.opened += 1
        if isinstance(self.failure, cv2.error):
            raise self.failure

    def _grab(self):
        time.sleep(0.005)
        if self.failure is not None:
            raise self.failure
        if not self.frozen:  # a sensor's noise
            self.picture = np.roll(CAMERA, np.random.default_rng().integers(1, 99), axis=1)
        return self.picture

    def _release(self):
        pass


def test_a_camera_is_gone_whatever_its_library_raises():
    camera = FailingCamera("fake", (160, 120), 30)
    waited(camera.read)
    camera.failure = cv2.error("OpenCV: (-215:Assertion failed) !buf.empty()\n> in imdecode")
    waited(lambda: camera._error)
    with pytest.raises(RobotError, match=r"^camera fake: OpenCV: .* !buf.empty\(\)$"):
        camera.read()
    with pytest.raises(RobotError, match=r"^camera fake: OpenCV: "):  # nor does it open again yet
        camera.recover()
    camera.failure = None
    camera.recover()
    assert waited(camera.read)
    opened = camera.opened
    camera.recover()  # it works: nothing to do
    assert camera.opened == opened
    camera._ends = True  # its thread ends without a word
    waited(lambda: not camera._thread.is_alive())
    camera.recover()
    assert camera.opened == opened + 1
    assert waited(camera.read)
    camera.frozen = True  # it repeats one picture
    waited(lambda: camera._repeats > 5)
    camera.recover()
    assert camera.opened == opened + 2
    camera.close()


def test_no_camera_and_another_resolution(film, tmp_path):
    with pytest.raises(ValueError, match=r"opencv:.*cannot be opened"):
        OpenCVCamera(str(tmp_path / "nothing.avi"))
    with pytest.raises(ValueError, match="gives 160x120 pictures, not 640x480"):
        OpenCVCamera(film)


@pytest.mark.parametrize(
    ("library", "make", "said"),
    [
        ("pyrealsense2", RealSenseCamera, r"regil-sb3\[realsense\]"),
        ("franky", lambda: FrankaArm("172.16.0.2"), r"regil-sb3\[franka\]"),
    ],
)
def test_a_library_that_is_not_installed(library, make, said):
    if importlib.util.find_spec(library) is not None:
        pytest.skip(f"{library} is installed")
    with pytest.raises(ImportError, match=said):
        make()


def test_a_franka_arm_that_is_gone_is_let_go_all_the_same(monkeypatch):
    class Robot:
        """What `FrankaArm` asks of franky's; its connection ends."""

        is_in_control, has_errors, current_errors, lost = True, False, "", False

        def __init__(self, *_, **__):
            self.current_pose = SimpleNamespace(
                end_effector_pose=SimpleNamespace(quaternion=None, translation=[0.4, 0.0, 0.3])
            )

        @property
        def state(self):
            return SimpleNamespace(time=time.monotonic())

        def move(self, *_, **__):
            if self.lost:
                raise RuntimeError("UDP receive: timeout")

    franky = SimpleNamespace(
        Robot=Robot,
        Gripper=lambda _: None,
        RealtimeConfig=SimpleNamespace(Enforce=1, Ignore=0),
        CartesianStopMotion=lambda: None,
    )
    monkeypatch.setitem(sys.modules, "franky", franky)
    arm = FrankaArm("172.16.0.2")
    arm._robot.lost = True
    with pytest.raises(RobotError, match="arm: UDP receive: timeout"):
        arm.close()
    assert not arm._thread.is_alive()


def test_an_operator_at_a_terminal():
    ours, theirs = pty.openpty()
    keys = Keyboard(theirs)
    assert not any([keys.succeeded(), keys.aborted(), keys.paused()])
    os.write(ours, b"s ")
    waited(keys.paused)
    assert keys.succeeded()
    assert not keys.succeeded()  # once
    os.write(ours, b" ")
    waited(lambda: not keys.paused())
    os.write(ours, b"x")
    waited(keys.aborted)
    waiting = threading.Thread(target=keys.ready, args=["put it back"])
    waiting.start()

    def answered():
        os.write(ours, b"\n")
        waiting.join(0.05)
        return not waiting.is_alive()

    waited(answered)
    assert not keys.aborted()
    keys.close()
    keys.close()  # once is enough
    os.close(ours)
    os.close(theirs)


def test_no_terminal():
    reading, writing = os.pipe()
    with pytest.raises(ValueError, match="this is none"):
        Keyboard(reading)
    os.close(reading)
    os.close(writing)


def test_a_real_camera_beside_a_simulated_arm(tmp_path):
    film = filmed(str(tmp_path / "film.avi"), 3000)  # it is read as fast as can be
    robot = Rehearsal("reach")
    camera = OpenCVCamera(film, (160, 120))
    limits = Limits((-0.25, 0.38, 0.0), (0.25, 0.72, 0.3))
    env = RobotEnv(camera, robot.arm, limits, (0.0, 0.48, 0.18))
    assert env.encoder_frame(100).shape == (100, 100, 3)
    assert env.metadata["regil"]["camera"] == f"opencv:{film}"
    env.close()


class FakeRobot:
    """rosbridge's side of a robot: a camera at 50 Hz, and a hand that is where it is sent."""

    TOPICS = ("/camera", "/hand")

    def __init__(self):
        self.hand, self.stamp = np.array([0.4, 0.0, 0.3]), 0
        self.received, self.moves, self.silent = [], True, False
        self.data = base64.b64encode(cv2.imencode(".png", CAMERA[..., ::-1])[1]).decode()
        self.start()

    def start(self, port=0):
        self.stopped = False
        self.server = serve(self.serve, "localhost", port)
        self.port = self.server.socket.getsockname()[1]
        self.address = f"ws://localhost:{self.port}"
        self.thread = threading.Thread(target=self.server.serve_forever)
        self.thread.start()

    def stop(self):
        self.stopped = True  # before websockets 15 a server that ends leaves its connections open
        self.server.shutdown()
        self.thread.join()

    def pose(self, at):
        header = {"frame_id": "base", "stamp": {"sec": 0, "nanosec": self.stamp}}
        position = dict(zip("xyz", map(float, at), strict=True))
        return {"header": header, "pose": {"position": position, "orientation": DOWN}}

    def serve(self, socket):
        topics = {}
        while not self.stopped:
            try:
                said = json.loads(socket.recv(0.02))
            except TimeoutError:
                said = {"op": None}
            except ConnectionClosed:
                return
            self.received.append(said)
            if said["op"] == "subscribe":
                topics[said["topic"]] = said["type"]
            elif said["op"] == "publish" and said["topic"] == "/go":
                self.hand = np.array([said["msg"]["pose"]["position"][a] for a in "xyz"])
            self.stamp += self.moves
            for topic in () if self.silent else topics:
                message = {"data": self.data} if topic == "/camera" else self.pose(self.hand)
                with contextlib.suppress(ConnectionClosed):
                    socket.send(json.dumps({"op": "publish", "topic": topic, "msg": message}))


CAMERA = np.zeros((120, 160, 3), np.uint8)
CAMERA[:, :80] = (255, 0, 0)
DOWN = {"x": 1.0, "y": 0.0, "z": 0.0, "w": 0.0}


@pytest.fixture
def robot():
    fake = FakeRobot()
    yield fake
    fake.stop()


def test_a_camera_of_ros(robot):
    camera = RosCamera("/camera", robot.address, (160, 120))
    picture = waited(camera.read)
    np.testing.assert_array_equal(picture.image, CAMERA)
    waited(lambda: camera.read().time > picture.time)
    robot.silent = True
    waited(lambda: camera._error)
    with pytest.raises(RobotError, match="camera ros:/camera: no picture for 2 s"):
        camera.read()
    robot.silent = False
    camera.recover()
    assert waited(camera.read)
    camera.close()
    with pytest.raises(ValueError, match="gives 160x120 pictures, not 640x480"):
        RosCamera("/camera", robot.address)
    for data in (b"no picture", b""):
        robot.data = base64.b64encode(data).decode()
        with pytest.raises(ValueError, match="gives no picture: what it sends is neither JPEG nor"):
            RosCamera("/camera", robot.address)


def test_an_arm_of_ros(robot):
    arm = RosArm("/hand", "/go", "/grip", address=robot.address)
    waited(lambda: sum(said["op"] == "advertise" for said in robot.received) == 2)
    kinds = {said["topic"]: said["type"] for said in robot.received if said["op"] == "advertise"}
    assert kinds == {"/go": "geometry_msgs/msg/PoseStamped", "/grip": "std_msgs/msg/Bool"}
    np.testing.assert_allclose(arm.state().position, [0.4, 0.0, 0.3])
    arm.move(np.array([0.41, 0.02, 0.25]), True)
    waited(lambda: np.allclose(arm.state().position, [0.41, 0.02, 0.25]))
    assert arm.state().closed
    arm.move(np.array([0.41, 0.02, 0.25]), True)  # it is closed already
    arm.stop()
    arm.move(np.array([0.0, 0.0, 0.0]), False)  # does not count
    waited(lambda: sum(said["op"] == "publish" for said in robot.received) == 4)
    said = [(s["topic"], s["msg"]) for s in robot.received if s["op"] == "publish"]
    assert [topic for topic, _ in said] == ["/go", "/grip", "/go", "/go"]
    assert said[1][1] == {"data": True}
    assert said[3][1]["pose"] == {
        "position": {"x": 0.41, "y": 0.02, "z": 0.25},
        "orientation": DOWN,
    }
    assert said[3][1]["header"]["frame_id"] == "base"
    robot.moves = False  # the driver repeats itself: its state is as old as its stamp
    time.sleep(0.1)
    old = arm.state().time
    time.sleep(0.1)
    assert arm.state().time == old
    robot.moves = True
    robot.stop()
    waited(lambda: arm._bridge.error)
    for call in (arm.state, arm.stop):
        with pytest.raises(RobotError, match="arm: rosbridge at ws://localhost:"):
            call()
    with pytest.raises(RobotError, match=r"does not answer .*: is rosbridge_server running there"):
        arm.recover()
    robot.start(robot.port)
    arm.recover()
    arm.move(np.array([0.42, 0.0, 0.3]), False)
    waited(lambda: np.allclose(arm.state().position, [0.42, 0.0, 0.3]))
    arm.close()


def test_a_gripper_is_told_what_to_be_at_first(robot):
    """A program that was killed may have left it closed."""
    arm = RosArm("/hand", "/go", "/grip", address=robot.address)
    assert not arm.state().closed
    arm.move(np.array([0.4, 0.0, 0.3]), False)
    waited(lambda: sum(said["op"] == "publish" for said in robot.received) == 2)
    (grip,) = [s["msg"] for s in robot.received if s.get("msg") and s["topic"] == "/grip"]
    assert grip == {"data": False}
    arm.close()


def test_ros_topics_that_say_nothing(robot):
    robot.silent = True
    with pytest.raises(ValueError, match="/hand says no pose: nothing came for 2 s"):
        RosArm("/hand", address=robot.address)
    with pytest.raises(ValueError, match="camera ros:/camera gives no picture: no picture for 2 s"):
        RosCamera("/camera", robot.address)
    with pytest.raises(ValueError, match="ws://localhost:9 does not answer"):
        RosArm(address="ws://localhost:9")
    robot.silent, robot.pose = False, lambda at: {"header": {}}
    with pytest.raises(ValueError, match=r"/hand says no pose: .*: a message lacks 'pose'"):
        RosArm("/hand", address=robot.address)
