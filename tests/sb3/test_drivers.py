"""Drivers that need no hardware: a film in place of a camera, a terminal of the test's own."""

from __future__ import annotations

import importlib.util
import os
import pty
import threading
import time

import cv2
import numpy as np
import pytest

from regil_sb3.envs.robot import RobotEnv
from regil_sb3.robots.arms import FrankaArm
from regil_sb3.robots.cameras import OpenCVCamera, RealSenseCamera
from regil_sb3.robots.interfaces import RobotError
from regil_sb3.robots.limits import Limits
from regil_sb3.robots.operator import Keyboard
from regil_sb3.robots.rehearsal import Rehearsal


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
    assert waited(camera.read).image.shape == (120, 160, 3)
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
