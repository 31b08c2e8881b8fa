"""Drawing MuJoCo simulations. One graphics context a process serves all simulations of a task: they differ in their data only."""
from __future__ import annotations

import atexit
import importlib
import os
import sys
from typing import Any

import numpy as np

from ..errors import PdkitError
from .cameras import CAMERAS, View


class _Renderer:
    """A graphics context with the meshes and textures of one model."""

    def __init__(self, model: Any, height: int, width: int):
        import mujoco

        self._mujoco = mujoco
        model.vis.quality.offsamples = model.vis.quality.shadowsize = 0  # ten times cheaper frames
        self._gl, self._context = _contexts(model, height, width)
        self._scene, self._options = mujoco.MjvScene(model, 1000), mujoco.MjvOption()
        self._area, self._pixels = mujoco.MjrRect(0, 0, width, height), np.empty((height, width, 3), np.uint8)

    def draw(self, model: Any, data: Any, camera: Any) -> np.ndarray:
        """The picture (height, width, 3) of a simulation of the same model."""
        self._gl.make_current()  # another renderer of the process may have been drawing
        everything = self._mujoco.mjtCatBit.mjCAT_ALL
        self._mujoco.mjv_updateScene(model, data, self._options, None, camera, everything, self._scene)
        self._mujoco.mjr_render(self._area, self._scene, self._context)
        self._mujoco.mjr_readPixels(self._pixels, None, self._area, self._context)
        return self._pixels[::-1]  # OpenGL begins at the bottom


def _contexts(model: Any, height: int, width: int) -> tuple[Any, Any]:
    """OpenGL's context, current, of the backend that MUJOCO_GL names, else the system's usual one, and MuJoCo's with the model's meshes in
    it. Raises PdkitError where there is none."""
    usual = {"linux": "egl", "darwin": "cgl"}.get(sys.platform, "glfw")
    backend = os.environ.get("MUJOCO_GL", "").lower() or usual
    try:
        import mujoco

        gl = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
        atexit.register(gl.free)  # before the backend itself is shut down
        gl.make_current()
        meshes = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except Exception as error:
        raise PdkitError(f"MuJoCo cannot draw here with {backend} ({type(error).__name__}), and a visual policy needs pictures; "
                         "`pdkit doctor` names the package that is missing (Debian/Ubuntu: libegl1 libgl1-mesa-dri).") from error
    return gl, meshes


_RENDERERS: dict[tuple[str, int, int], _Renderer] = {}  # of this process: task, height, width


class MujocoEyes:
    """The cameras of one simulation; `look` draws what they see now."""

    def __init__(self, view: View, sim: Any):
        import mujoco

        self._env, key = sim._env, (view.task, view.height, view.width)
        if key not in _RENDERERS:
            _RENDERERS[key] = _Renderer(self._env.model, view.height, view.width)
        self._renderer = _RENDERERS[key]
        self._camera = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(self._env.model, self._camera)
        for name, value in CAMERAS[view.task].items():
            setattr(self._camera, name, value)

    def look(self) -> tuple[np.ndarray, np.ndarray]:
        """Colours (3, height, width) uint8, and distances (0, height, width) uint16: none."""
        picture = self._renderer.draw(self._env.model, self._env.data, self._camera)
        return np.ascontiguousarray(picture.transpose(2, 0, 1)), np.empty((0, *picture.shape[:2]), np.uint16)
