"""A camera and an arm that speak ROS 1 or ROS 2, through rosbridge: no ROS is installed here.

* ``RosCamera`` - compressed pictures of a topic
* ``RosArm`` - an arm whose controller follows a pose

rosbridge (``ros2 launch rosbridge_server rosbridge_websocket_launch.xml``) carries the messages of
topics as JSON over a WebSocket, on the robot's network.
Protocol: https://github.com/RobotWebTools/rosbridge_suite/blob/ros2/ROSBRIDGE_PROTOCOL.md
"""

from __future__ import annotations

import base64
import contextlib
import json
import threading
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from regil_sb3.robots.cameras import GrabbingCamera
from regil_sb3.robots.interfaces import ArmState, RobotError, first_line

__all__ = ["RosArm", "RosCamera"]

_SILENCE = 2.0  # s without a message, after which a topic is given up
_POSE = "geometry_msgs/msg/PoseStamped"


class _Bridge:
    """A connection to rosbridge; messages arrive in a thread of its own."""

    def __init__(self, address: str, topics: dict[str, tuple[str, Callable[[Any], None]]]) -> None:
        try:
            from websockets.exceptions import WebSocketException
            from websockets.sync.client import connect
        except ModuleNotFoundError:
            raise ImportError("websockets is not installed: pip install 'regil-sb3[ros]'") from None
        self.address, self._topics = address, topics
        self.error: str | None = None
        self._failures = (WebSocketException, OSError, TimeoutError)
        self._open = contextlib.ExitStack()
        try:
            self._socket = self._open.enter_context(
                connect(address, open_timeout=5, max_size=None, compression=None)
            )
            for topic, (kind, _) in topics.items():
                # throttle_rate 0 and a queue of one: the newest, as soon as it is there
                self.send("subscribe", topic=topic, type=kind, throttle_rate=0, queue_length=1)
        except self._failures as error:
            raise ValueError(
                f"rosbridge at {address} does not answer ({first_line(error)}): "
                "is rosbridge_server running there?"
            ) from None
        threading.Thread(target=self._run, daemon=True).start()

    def send(self, op: str, **words: Any) -> None:
        """Send an operation.

        Raises:
            RobotError: the connection is gone.
        """
        try:
            self._socket.send(json.dumps({"op": op, **words}))
        except self._failures as error:
            self.error = self.error or f"rosbridge at {self.address} is gone: {first_line(error)}"
            raise RobotError(self.error) from None

    def close(self) -> None:
        """End the connection."""
        self._open.close()

    def _run(self) -> None:
        try:
            for text in self._socket:
                message = json.loads(text)
                if message.get("op") == "publish" and message.get("topic") in self._topics:
                    self._topics[message["topic"]][1](message["msg"])
                elif message.get("op") == "status" and message.get("level") == "error":
                    self.error = f"rosbridge at {self.address}: {message.get('msg')}"
            self.error = self.error or f"rosbridge at {self.address} ended the connection"
        except KeyError as error:
            self.error = f"rosbridge at {self.address}: a message lacks {error}"
        except (*self._failures, ValueError, TypeError) as error:
            self.error = self.error or f"rosbridge at {self.address}: {first_line(error)}"


class RosCamera(GrabbingCamera):
    """The pictures of a topic of ``sensor_msgs/CompressedImage``, JPEG or PNG.

    It needs ``websockets``. A picture's time is that of its arrival in this computer.

    Args:
        topic: its name.
        address: of rosbridge.
        size: width and height in pixels, as the topic has them.

    Raises:
        ImportError: ``websockets`` is not installed.
        ValueError: no rosbridge answers, the topic is silent, or pictures have another size.
    """

    def __init__(
        self,
        topic: str = "/camera/color/image_raw/compressed",
        address: str = "ws://localhost:9090",
        size: tuple[int, int] = (640, 480),
    ) -> None:
        self._topic, self._address = topic, address
        super().__init__(f"ros:{topic}", size, 0)

    def _open(self) -> None:
        self._arrived = threading.Condition()
        self._newest: bytes | None = None
        kind = "sensor_msgs/msg/CompressedImage"
        self._bridge = _Bridge(self._address, {self._topic: (kind, self._take)})
        try:
            height, width = self._grab().shape[:2]
        except OSError as error:
            self._bridge.close()
            raise ValueError(f"camera {self.name} gives no picture: {error}") from None
        if (width, height) != self._size:
            self._bridge.close()
            raise self._wrong_size(height, width)

    def _take(self, message: Any) -> None:
        with self._arrived:
            self._newest = base64.b64decode(message["data"])
            self._arrived.notify()

    def _grab(self) -> npt.NDArray[np.uint8]:
        with self._arrived:
            self._arrived.wait_for(lambda: self._newest is not None, _SILENCE)
            data, self._newest = self._newest, None
        if data is None:
            raise OSError(self._bridge.error or f"no picture for {_SILENCE:g} s")
        # OpenCV raises an error of its own where there is nothing to decode
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
        if image is None:
            raise OSError("what it sends is neither JPEG nor PNG")
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8)

    def _release(self) -> None:
        self._bridge.close()


class RosArm:
    """An arm whose controller follows a pose, the hand keeping the direction it has at first.

    Cartesian impedance controllers, MoveIt Servo's pose tracking and cartesian_controllers do. The
    controller must hold where it is while nothing new is published: that is how this arm stops,
    and what happens when the network fails.

    Args:
        pose: topic (``geometry_msgs/PoseStamped``) that says where the hand is.
        target: topic (the same) that says where it is to go.
        gripper: topic that opens and closes the gripper.
        gripper_type: type of its message, which has one field ``data``.
        gripper_data: what is sent to open and to close.
        address: of rosbridge.

    Raises:
        ImportError: ``websockets`` is not installed.
        ValueError: no rosbridge answers, or it says nothing of the pose.
    """

    def __init__(
        self,
        pose: str = "/current_pose",
        target: str = "/target_pose",
        gripper: str = "/gripper_command",
        gripper_type: str = "std_msgs/msg/Bool",
        gripper_data: tuple[Any, Any] = (False, True),
        address: str = "ws://localhost:9090",
    ) -> None:
        self._pose, self._target, self._address = pose, target, address
        self._gripper, self._gripper_type = gripper, gripper_type
        self._gripper_data = gripper_data
        self._lock = threading.Lock()
        self._held = False
        self._closed: bool | None = None  # not known: the first move says it
        self._message: Any = None
        self._arrived = 0.0
        first = self._connect()
        self._frame = first["header"].get("frame_id", "")
        self._direction = first["pose"]["orientation"]

    def state(self) -> ArmState:
        """The newest pose; its time stands still where the topic is silent or repeats itself."""
        if self._bridge.error is not None:
            raise RobotError(f"arm: {self._bridge.error}")
        message, arrived = self._message, self._arrived
        return ArmState(_position(message), bool(self._closed), arrived)

    def move(self, position: npt.NDArray[np.float64], closed: bool) -> None:
        """Send the pose to follow and, where it changes, the gripper's command."""
        with self._lock:
            if not self._held:
                self._go(np.asarray(position, float))
                if closed != self._closed:
                    self._closed = closed
                    data = self._gripper_data[int(closed)]
                    self._publish(self._gripper, {"data": data})

    def stop(self) -> None:
        """Follow the pose that the hand has now."""
        with self._lock:
            self._held = True
            self._go(_position(self._message))

    def recover(self) -> None:
        """Connect anew where the connection is gone, and be ready to move."""
        with self._lock:
            if self._bridge.error is not None:
                self._bridge.close()
                try:
                    self._connect()
                except ValueError as error:
                    raise RobotError(f"arm: {error}") from None
            self._held = False

    def close(self) -> None:
        """Stop, and end the connection."""
        try:
            self.stop()
        finally:
            self._bridge.close()

    def _connect(self) -> Any:
        """Connect, and wait for the first message."""
        self._message = None
        self._bridge = _Bridge(self._address, {self._pose: (_POSE, self._take)})
        self._bridge.send("advertise", topic=self._target, type=_POSE)
        self._bridge.send("advertise", topic=self._gripper, type=self._gripper_type)
        end = time.monotonic() + _SILENCE
        while self._message is None:
            if self._bridge.error is not None or time.monotonic() > end:
                why = self._bridge.error or f"nothing came for {_SILENCE:g} s"
                self._bridge.close()
                raise ValueError(f"{self._pose} says no pose: {why}")
            time.sleep(0.01)
        return self._message

    def _take(self, message: Any) -> None:
        before = self._message
        _position(message)  # a KeyError here ends the connection, with its reason
        if before is None or message["header"]["stamp"] != before["header"]["stamp"]:
            self._message, self._arrived = message, time.monotonic()

    def _go(self, position: npt.NDArray[np.float64]) -> None:
        pose = {
            "position": dict(zip("xyz", map(float, position), strict=True)),
            "orientation": self._direction,
        }
        header = {"frame_id": self._frame, "stamp": self._message["header"]["stamp"]}
        self._publish(self._target, {"header": header, "pose": pose})

    def _publish(self, topic: str, message: dict[str, Any]) -> None:
        try:
            self._bridge.send("publish", topic=topic, msg=message)
        except RobotError as error:
            raise RobotError(f"arm: {error}") from None


def _position(message: Any) -> npt.NDArray[np.float64]:
    return np.array([float(message["pose"]["position"][axis]) for axis in "xyz"])
