"""Rendering of MuJoCo states for a processor without a graphics card: no shadows, reflections or
haze, coarse shapes.
"""

from __future__ import annotations

import importlib
import os
from typing import Any

import mujoco
import numpy as np

from poem_envs.headless import choose_headless_backend
from poem_envs.mujoco_rendering import close_at_exit, stays_closed

RENDER_QUALITIES = ("full", "fast")
MAX_GEOM = 200
# Slices and stacks of a sphere, and quads of a plane: at the size of a web page nobody sees the
# difference.
COARSE = (12, 6, 1)


class FastRenderer:
    """Renders states of one model as RGB images. On a software renderer an image takes a small part
    of what Gymnasium's takes.

    A graphics context belongs to the thread that rendered first; render from no other.

    :param model: the model that the states are of; its settings of rendering quality are changed
    :param width: of the image, pixels
    :param height: of the image, pixels
    :param camera_id: camera of the model; None for one that follows the robot's root
    :param camera_name: the same by name
    :param camera_config: attributes of the following camera
    :raises ValueError: if the model has no camera of that name
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        width: int,
        height: int,
        camera_id: int | None,
        camera_name: str | None,
        camera_config: dict[str, Any],
    ) -> None:
        self._model = model
        self._data = mujoco.MjData(model)
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, height)
        quality = model.vis.quality
        quality.offsamples = 0
        quality.numslices, quality.numstacks, quality.numquads = COARSE
        self._context = _make_context(width, height)
        self._context.make_current()
        self._scene = mujoco.MjvScene(model, MAX_GEOM)
        flags = mujoco.mjtRndFlag
        for flag in (flags.mjRND_SHADOW, flags.mjRND_REFLECTION, flags.mjRND_HAZE):
            self._scene.flags[flag] = 0
        self._resources = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        self._options = mujoco.MjvOption()
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        self._pixels = np.empty((height, width, 3), dtype=np.uint8)
        self._camera = self._make_camera(camera_id, camera_name, camera_config)
        close_at_exit(self)

    def render(self, state: np.ndarray, markers: list[dict[str, Any]]) -> np.ndarray:
        """Render one state.

        :param state: time, positions and velocities, ``(1 + nq + nv,)``
        :param markers: shapes to add: ``type``, ``pos``, ``size``, ``mat``, ``rgba`` of an
            ``MjvGeom``
        :return: ``(height, width, 3)`` uint8
        """
        mujoco.mj_setState(self._model, self._data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_forward(self._model, self._data)
        return self.render_data(self._data, markers)

    def render_data(self, data: mujoco.MjData, markers: list[dict[str, Any]]) -> np.ndarray:
        """Render what a simulation has computed last.

        :param data: of the model
        :param markers: see :meth:`render`
        :return: ``(height, width, 3)`` uint8
        """
        if self._camera.type == mujoco.mjtCamera.mjCAMERA_FREE:
            self._camera.lookat[:2] = data.xpos[1, :2]
        self._context.make_current()  # another environment may have rendered since
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._resources)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(
            self._model, data, self._options, None, self._camera, everything, self._scene
        )
        for marker in markers:
            self._add(marker)
        mujoco.mjr_render(self._viewport, self._scene, self._resources)
        mujoco.mjr_readPixels(self._pixels, None, self._viewport, self._resources)
        return self._pixels[::-1].copy()

    def close(self) -> None:
        """Free the graphics context."""
        self._context.make_current()
        self._resources.free()
        self._context.free()
        stays_closed(self)

    def _make_camera(
        self, camera_id: int | None, camera_name: str | None, config: dict[str, Any]
    ) -> mujoco.MjvCamera:
        camera = mujoco.MjvCamera()
        if camera_name is not None:
            camera_id = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_CAMERA, camera_name)
            if camera_id < 0:
                raise ValueError(
                    f"camera_name={camera_name!r}: the model has no camera of this name"
                )
        if camera_id is not None and camera_id >= 0:
            camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, camera_id
            return camera
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.azimuth = 90.0  # as Gymnasium's viewer
        for name, value in config.items():
            if isinstance(value, np.ndarray):
                getattr(camera, name)[:] = value
            else:
                setattr(camera, name, value)
        return camera

    def _add(self, marker: dict[str, Any]) -> None:
        if self._scene.ngeom >= self._scene.maxgeom:
            raise RuntimeError(
                f"a scene of more than {self._scene.maxgeom} shapes cannot be rendered fast"
            )
        geom = self._scene.geoms[self._scene.ngeom]
        size = np.asarray(marker.get("size", (0.1, 0.1, 0.1)), dtype=np.float64)
        rotation = np.asarray(marker.get("mat", np.eye(3)), dtype=np.float64).reshape(9)
        colour = np.asarray(marker.get("rgba", (1.0, 1.0, 1.0, 1.0)), dtype=np.float32)
        mujoco.mjv_initGeom(
            geom,
            marker["type"],
            size,
            np.asarray(marker["pos"], dtype=np.float64),
            rotation,
            colour,
        )
        self._scene.ngeom += 1


def renders_fast(render_quality: str, render_mode: str | None) -> bool:
    """Whether images come from a :class:`FastRenderer`.

    :param render_quality: "full" or "fast", as users give it
    :param render_mode: of the environment
    :raises ValueError: if the quality is another, or "fast" is asked of a mode that has no images
        in colour
    """
    if render_quality not in RENDER_QUALITIES:
        raise ValueError(
            f"render_quality must be one of {RENDER_QUALITIES}, got {render_quality!r}"
        )
    if render_quality == "fast" and render_mode not in (None, "rgb_array"):
        raise ValueError(
            f'render_quality="fast" goes with render_mode="rgb_array" alone, got {render_mode!r}'
        )
    return render_quality == "fast"


def _make_context(width: int, height: int) -> Any:
    """A graphics context off screen. ``mujoco.GLContext`` itself is fixed when MuJoCo is imported,
    which was long ago.
    """
    choose_headless_backend()
    backend = os.environ.get("MUJOCO_GL", "").lower()
    module = (
        importlib.import_module(f"mujoco.{backend}") if backend in ("egl", "osmesa") else mujoco
    )
    return module.GLContext(width, height)
