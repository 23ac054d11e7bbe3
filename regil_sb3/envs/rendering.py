"""Pictures of MuJoCo's scenes, drawn off screen.

* ``Renderer`` - one camera of one model
* ``prepare_graphics`` - chooses the graphics library that the user left open
"""

from __future__ import annotations

import atexit
import functools
import importlib
import os
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["Renderer", "prepare_graphics"]

Frame = npt.NDArray[np.uint8]


class Renderer:
    """Draws one camera of one model, off screen, in any square size.

    MuJoCo's own `Renderer` draws in one size only, copies each picture twice, and has an OpenGL
    context of its own: with several, it is chance whose pictures a garbage collection frees.
    Without shadows, reflections and smoothed edges a picture takes a fraction of the time.

    Args:
        model: MuJoCo's, `MjModel`.
        camera: its number in the model.
        size: height and width in pixels that pictures will mostly have.
        hidden: groups of geoms that are not drawn.
        sites: whether sites are drawn.
    """

    def __init__(
        self,
        model: Any,
        camera: int,
        size: int,
        hidden: Sequence[int] = (),
        sites: bool = False,
    ) -> None:
        import mujoco  # type: ignore[import-untyped]

        self._mujoco = mujoco
        self._model = model
        quality = model.vis.quality
        quality.shadowsize = quality.offsamples = 0  # read once, when a context is made
        self._gl = _gl_context()
        self._gl.make_current()
        self._scene = mujoco.MjvScene(model, maxgeom=1000)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._options = mujoco.MjvOption()
        if not sites:  # they are marks, and in Meta-World the goal is one of them
            self._options.sitegroup[:] = 0
        self._options.geomgroup[list(hidden)] = 0
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = camera
        self._perturbation = mujoco.MjvPerturb()
        model.vis.global_.offwidth = model.vis.global_.offheight = self._size = size
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50)

    def draw(self, data: Any, size: int) -> Frame:
        """Draw the scene: (size, size, 3) uint8, in OpenGL's order (bottom row first)."""
        mujoco = self._mujoco
        view = mujoco.MjrRect(0, 0, size, size)
        frame = np.empty((size, size, 3), np.uint8)
        self._gl.make_current()
        if size > self._size:
            mujoco.mjr_resizeOffscreen(size, size, self._context)
            self._size = size
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        mujoco.mjv_updateScene(
            self._model,
            data,
            self._options,
            self._perturbation,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL,
            self._scene,
        )
        mujoco.mjr_render(view, self._scene, self._context)
        mujoco.mjr_readPixels(frame, None, view, self._context)
        return frame

    def close(self) -> None:
        """Free what the graphics library holds; nothing can be drawn afterwards."""
        self._gl.make_current()
        self._context.free()


@functools.cache
def _gl_context() -> Any:
    """Make the one OpenGL context of this process, of the backend that MUJOCO_GL names."""
    backend = os.environ.get("MUJOCO_GL", "").lower() or "glfw"
    try:
        module = importlib.import_module(f"mujoco.{backend}")
    except ModuleNotFoundError:
        raise ValueError(f"MUJOCO_GL={backend!r} must be one of egl, glfw, osmesa") from None
    context = module.GLContext(64, 64)
    # Registered last, hence run first: before the library closes its display.
    atexit.register(context.free)
    return context


def prepare_graphics() -> None:
    """Choose what the user left open, before the graphics library reads it."""
    display = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    if sys.platform == "linux" and not display:
        os.environ.setdefault("MUJOCO_GL", "egl")
    # Mesa's software renderer: its threads do not survive a fork (the child would hang), and at
    # these sizes they save nothing.
    os.environ.setdefault("LP_NUM_THREADS", "0")
