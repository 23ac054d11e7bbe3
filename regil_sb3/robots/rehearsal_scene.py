"""The rehearsal robot's world: an arm over a table, and the paper's three tasks, in MuJoCo.

The hand is moved along x (right as the robot sees it), y (away from its base) and z (up) by servos
of limited force, like an arm under Cartesian impedance control; the links of the arm are drawn, in
the pose that reaches the hand, and touch nothing. Lengths are in metres.

* ``Scene`` - one task's world: physics, pictures, and what only a simulator knows
* ``TASKS`` - the paper's Reach, Insert and Open: limits, ranges, what success is
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from regil_sb3.envs.rendering import Renderer, prepare_graphics

__all__ = ["RATE", "TASKS", "Scene", "Task"]

RATE = 360.0  # Hz, of the physics
_SHOULDER = np.array([0.0, 0.02, 0.3])
_LINK = 0.42  # length of upper arm and forearm
_WRIST = np.array([0.0, 0.0, 0.18])  # above the finger tips
_OPEN = 0.03  # of each finger, from the middle

_CUP = "".join(
    f'<geom type="box" size=".004 .0145 .035" pos="{0.034 * math.cos(a):.4f} '
    f'{0.034 * math.sin(a):.4f} .035" euler="0 0 {math.degrees(a):.0f}" rgba=".8 .1 .1 1"/>'
    for a in np.arange(8) * math.pi / 4
)
_PLUG = """
<body name="plug"><joint type="ball" damping=".004" armature=".0001"/>
 <geom type="capsule" fromto="0 0 0 0 0 -.04" size=".003" rgba=".1 .1 .1 1" mass=".005"
  contype="0" conaffinity="0"/>
 <geom type="cylinder" fromto="0 0 -.035 0 0 -.085" size=".011" rgba=".05 .05 .05 1" mass=".05"/>
 <site name="plug" pos="0 0 -.085"/>
</body>"""
_BOX = """
<joint name="box_x" type="slide" axis="1 0 0" frictionloss="6" damping="20"/>
<joint name="box_y" type="slide" axis="0 1 0" frictionloss="6" damping="20"/>
<geom type="box" size=".07 .05 .004" pos="0 0 .004" rgba=".06 .06 .06 1"/>
<geom type="box" size=".004 .05 .035" pos="-.066 0 .035" rgba=".06 .06 .06 1"/>
<geom type="box" size=".004 .05 .035" pos=".066 0 .035" rgba=".06 .06 .06 1"/>
<geom type="box" size=".07 .004 .035" pos="0 -.046 .035" rgba=".06 .06 .06 1"/>
<geom type="box" size=".07 .004 .035" pos="0 .046 .035" rgba=".06 .06 .06 1"/>
<body name="lid" pos="-.07 0 .074">
 <joint name="lid" axis="0 -1 0" range="0 110" limited="true" frictionloss=".04" damping=".03"/>
 <geom type="box" size=".07 .05 .003" pos=".07 0 0" rgba=".1 .1 .1 1" mass=".08"/>
 <geom type="capsule" fromto=".12 0 .003 .12 0 .03" size=".005" rgba=".6 .6 .65 1" mass=".005"/>
 <geom name="knob" type="sphere" size=".013" pos=".12 0 .035" rgba=".6 .6 .65 1" mass=".01"
  friction="1.5 .05 .001" condim="4"/>
</body>"""


@dataclass(frozen=True)
class Task:
    """One of the paper's tasks.

    Attributes:
        target: what stands on the table, as MJCF.
        held: what hangs from the hand, as MJCF.
        place: (x, y) of the fixed target.
        span: least and largest x that a random target is off from there.
        max_steps: of an episode.
        floor: the lowest that the hand may go.
        closed: whether the gripper starts closed.
    """

    target: str
    held: str
    place: tuple[float, float]
    span: tuple[float, float]
    max_steps: int
    floor: float
    closed: bool


TASKS = {
    "reach": Task(
        '<geom type="box" size=".03 .03 .002" pos="0 0 .002" rgba=".05 .05 .05 1"/>',
        "",
        (0.03, 0.6),
        (-0.14, 0.08),
        125,
        0.004,
        True,
    ),
    "insert": Task(_CUP, _PLUG, (0.0, 0.6), (-0.045, 0.045), 150, 0.095, True),
    "open": Task(_BOX, "", (-0.06, 0.6), (-0.04, 0.07), 175, 0.03, False),
}
"""The paper's tasks on a real robot: targets move left and right by so much, in so many steps."""

_XML = """<mujoco>
<option timestep="{timestep}" integrator="implicitfast" cone="elliptic" impratio="10"/>
<visual><headlight ambient=".35 .35 .35" diffuse=".4 .4 .4" specular="0 0 0"/></visual>
<worldbody>
 <light directional="true" dir="-.4 -.5 -1" diffuse=".4 .4 .4" specular=".1 .1 .1"/>
 <camera name="front" pos="0 1.3 .5" xyaxes="-1 0 0 0 -.4 .92" fovy="37"/>
 <geom type="box" size=".6 .5 .05" pos="0 .5 -.05" rgba=".62 .5 .38 1"/>
 <geom type="box" size="1.5 .02 1" pos="0 -.2 .5" rgba=".75 .76 .78 1" contype="0" conaffinity="0"/>
 <geom type="cylinder" size=".07 .13" pos="0 .02 .13" rgba=".85 .85 .86 1" contype="0"
  conaffinity="0"/>
 <body name="upper" mocap="true"><geom type="capsule" size=".045 .21" rgba=".9 .9 .9 1" contype="0"
  conaffinity="0"/></body>
 <body name="fore" mocap="true"><geom type="capsule" size=".035 .21" rgba=".9 .9 .9 1" contype="0"
  conaffinity="0"/></body>
 <body name="hand" gravcomp="1">
  <joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
  <joint name="z" type="slide" axis="0 0 1"/>
  <geom type="cylinder" size=".03 .04" pos="0 0 .14" rgba=".3 .3 .32 1" mass=".6"/>
  <geom type="box" size=".055 .025 .018" pos="0 0 .09" rgba=".9 .9 .92 1" mass=".4"/>
  <body name="right" pos="0 0 .036" gravcomp="1"><joint name="right" type="slide" axis="1 0 0"
   range="0 .035" limited="true" damping="2"/>
   <geom type="box" size=".006 .012 .036" pos=".006 0 0" rgba=".2 .35 .6 1" mass=".05"
    friction="1.5 .05 .001"/></body>
  <body name="left" pos="0 0 .036" gravcomp="1"><joint name="left" type="slide" axis="-1 0 0"
   range="0 .035" limited="true" damping="2"/>
   <geom type="box" size=".006 .012 .036" pos="-.006 0 0" rgba=".2 .35 .6 1" mass=".05"
    friction="1.5 .05 .001"/></body>
  {held}
 </body>
 <body name="target">{target}</body>
</worldbody>
<contact><exclude body1="right" body2="left"/>{exclude}</contact>
<actuator>
 <position joint="x" kp="2500" kv="110" forcerange="-60 60"/>
 <position joint="y" kp="2500" kv="110" forcerange="-60 60"/>
 <position joint="z" kp="2500" kv="110" forcerange="-60 60"/>
 <position joint="right" kp="1000" kv="20" forcerange="-15 15"/>
 <position joint="left" kp="1000" kv="20" forcerange="-15 15"/>
</actuator>
</mujoco>"""


class Scene:
    """A task's world.

    Args:
        task: a name of ``TASKS``.
        size: height and width of its pictures, in pixels.
    """

    def __init__(self, task: str, size: int) -> None:
        prepare_graphics()
        try:
            import mujoco  # type: ignore[import-untyped]
        except ModuleNotFoundError:
            raise ImportError(
                "MuJoCo is not installed: pip install 'regil-sb3[metaworld]'"
            ) from None
        self._mujoco = mujoco
        self.task = TASKS[task]
        exclude = "".join(
            f'<exclude body1="plug" body2="{other}"/>' for other in ("hand", "right", "left")
        )
        xml = _XML.format(
            timestep=1 / RATE,
            held=self.task.held,
            target=self.task.target,
            exclude=exclude if self.task.held else "",
        )
        self.model: Any = mujoco.MjModel.from_xml_string(xml)
        self.data: Any = mujoco.MjData(self.model)
        self._size = size
        self._renderer: Renderer | None = None
        self._light = self.model.vis.headlight.diffuse.copy(), self.model.light_diffuse.copy()
        self.reset(np.array([0.0, 0.5, 0.2]), 0.0, 1.0)

    def reset(self, hand: npt.NDArray[np.float64], off: float, light: float) -> None:
        """Put the hand there, and the target ``off`` its fixed place along x; set the lamps."""
        mujoco, model, data = self._mujoco, self.model, self.data
        mujoco.mj_resetData(model, data)
        x, y = self.task.place
        model.body("target").pos[:] = (x + off, y, 0.0)
        model.vis.headlight.diffuse[:] = self._light[0] * light
        model.light_diffuse[:] = self._light[1] * light
        data.qpos[:3] = hand
        data.ctrl[:3] = hand
        fingers = 0.0 if self.task.closed else _OPEN
        data.qpos[3:5] = data.ctrl[3:5] = fingers
        mujoco.mj_forward(model, data)

    def command(self, position: npt.NDArray[np.float64], closed: bool) -> None:
        """Where the servos pull the hand, and whether the fingers close."""
        self.data.ctrl[:3] = position
        self.data.ctrl[3:5] = 0.0 if closed else _OPEN

    def step(self) -> None:
        """Let 1 / ``RATE`` seconds pass."""
        self._mujoco.mj_step(self.model, self.data)

    @property
    def hand(self) -> npt.NDArray[np.float64]:
        """(3,) where the finger tips are."""
        return np.array(self.data.qpos[:3])

    @property
    def speed(self) -> float:
        """Of the hand, m/s."""
        return float(np.linalg.norm(self.data.qvel[:3]))

    @property
    def closed(self) -> bool:
        """Whether the fingers are told to close."""
        return bool(self.data.ctrl[3] < _OPEN / 2)

    @property
    def target(self) -> npt.NDArray[np.float64]:
        """(3,) where the target stands."""
        return np.array(self.data.body("target").xpos)

    @property
    def lid(self) -> float:
        """Angle of the box's lid, radians; 0 without one."""
        return float(self.data.joint("lid").qpos[0]) if self.task.target is _BOX else 0.0

    @property
    def solved(self) -> bool:
        """Whether the task is solved, as the paper describes it."""
        if self.task.held:  # the bottom of the plug is inside the cup
            off = self.data.site("plug").xpos - self.target
            return bool(np.hypot(off[0], off[1]) < 0.03 and off[2] < 0.05)
        if self.task.target is _BOX:  # open, and the box stands about where it stood
            moved = np.hypot(self.data.joint("box_x").qpos[0], self.data.joint("box_y").qpos[0])
            return bool(self.lid > 0.8 and moved < 0.03)
        off = self.hand - self.target
        return bool((np.abs(off[:2]) < 0.03).all() and off[2] < 0.012)

    def draw(self) -> npt.NDArray[np.uint8]:
        """Draw the scene, (size, size, 3) and upright."""
        if self._renderer is None:
            self._renderer = Renderer(self.model, self.model.camera("front").id, self._size)
        self._pose_links()
        frame: npt.NDArray[np.uint8] = self._renderer.draw(self.data, self._size)[::-1].copy()
        return frame

    def _pose_links(self) -> None:
        """Draw the arm as two links of equal length that reach from the shoulder to the wrist."""
        reach = self.hand + _WRIST - _SHOULDER
        length = min(float(np.linalg.norm(reach)), 2 * _LINK - 1e-6)
        along = reach / np.linalg.norm(reach)
        up = np.array([0.0, 0.0, 1.0]) - along[2] * along
        up /= np.linalg.norm(up)
        elbow = _SHOULDER + along * length / 2 + up * math.sqrt(_LINK**2 - length**2 / 4)
        for i, (start, end) in enumerate(((_SHOULDER, elbow), (elbow, self.hand + _WRIST))):
            self.data.mocap_pos[i] = (start + end) / 2
            axis = (end - start) / np.linalg.norm(end - start)
            self._mujoco.mju_quatZ2Vec(self.data.mocap_quat[i], axis)
        self._mujoco.mj_kinematics(self.model, self.data)

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
