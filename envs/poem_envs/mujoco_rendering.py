"""Rendering of MuJoCo states, with a camera that follows the robot and markers for its task."""

from __future__ import annotations

import atexit
import importlib
import os
import weakref
from typing import Any

import mujoco
import numpy as np

from poem_envs.headless import choose_headless_backend

RENDER_QUALITIES = ("full", "fast")
TASK_COLOUR = (0.16, 0.65, 0.27, 1.0)
# Slices and stacks of a sphere, quads of a plane: at a web page's size nobody sees it.
SLICES, COARSE = 12, (6, 1)


class _Renderer:
    """What the renderers below have in common; the model's settings of rendering are changed."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        fit_buffer(model, width, height)

    def _show(self, state: np.ndarray) -> None:
        """Bring the data up to date with time, positions and velocities, ``(1 + nq + nv,)``."""
        mujoco.mj_setState(self._model, self._data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_forward(self._model, self._data)

    def _close_at_exit(self) -> None:
        # A context must go before the library that made it: so register after its import.
        if not _open_renderers:
            atexit.register(_close_open_renderers)
        _open_renderers.add(self)

    def close(self) -> None:
        """Close windows and graphics contexts."""
        _open_renderers.discard(self)


class StateRenderer(_Renderer):
    """Renders states as Gymnasium's ``MujocoRenderer`` does; its own camera follows the root."""

    def __init__(self, model: mujoco.MjModel, *, width: int, height: int, **view: Any) -> None:
        from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer  # loads the window system

        super().__init__(model, width, height)
        self._follows = view.get("camera_name") is None
        self._renderer = MujocoRenderer(model, self._data, width=width, height=height, **view)

    def render(self, state: np.ndarray, render_mode: str, markers: list[dict[str, Any]]) -> Any:
        """Render a state ``(1 + nq + nv,)`` with markers as ``add_marker`` takes them."""
        self._show(state)
        if render_mode != "human":
            choose_headless_backend()
        viewer = self._renderer._get_viewer(render_mode)
        viewer.make_context_current()  # another environment may have rendered since
        self._close_at_exit()
        if self._follows:
            viewer.cam.lookat[:2] = self._data.xpos[1, :2]
        for marker in markers:
            viewer.add_marker(**marker)
        image = self._renderer.render(render_mode)
        return np.ascontiguousarray(image) if isinstance(image, np.ndarray) else image

    def close(self) -> None:
        _empty(self._renderer)
        super().close()


class FastRenderer(_Renderer):
    """Renders RGB images without shadows, reflections, haze or details, fast without a graphics
    card. A graphics context belongs to the thread that rendered first; render from no other.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        width: int,
        height: int,
        camera_name: str | None = None,
        default_cam_config: dict[str, Any] | None = None,
        max_geom: int = 1000,
        slices: int = SLICES,
    ) -> None:
        super().__init__(model, width, height)
        quality = model.vis.quality
        quality.offsamples = 0
        quality.numslices, quality.numstacks, quality.numquads = slices, *COARSE
        self._context = _make_context(width, height)
        self._context.make_current()
        self._scene = mujoco.MjvScene(model, max_geom)
        flags = mujoco.mjtRndFlag
        for flag in (flags.mjRND_SHADOW, flags.mjRND_REFLECTION, flags.mjRND_HAZE):
            self._scene.flags[flag] = 0
        self._resources = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        self._options = mujoco.MjvOption()
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        self._pixels = np.empty((height, width, 3), dtype=np.uint8)
        self._camera = self._make_camera(camera_name, default_cam_config or {})
        self._close_at_exit()

    def render(self, state: np.ndarray, render_mode: str, markers: list[dict[str, Any]]) -> Any:
        """Render a state ``(1 + nq + nv,)`` with markers as ``add_marker`` takes them."""
        self._show(state)
        return self.render_data(self._data, markers)

    def render_data(self, data: mujoco.MjData, markers: list[dict[str, Any]]) -> np.ndarray:
        """Render what a simulation of the model has computed last, ``(height, width, 3)`` uint8."""
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
        self._context.make_current()
        self._resources.free()
        self._context.free()
        super().close()

    def _make_camera(self, name: str | None, config: dict[str, Any]) -> mujoco.MjvCamera:
        camera = mujoco.MjvCamera()
        if name is not None:
            number = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_CAMERA, name)
            if number < 0:
                raise ValueError(f"camera_name={name!r}: the model has no camera of this name")
            camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, number
            return camera
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        for key, value in {"azimuth": 90.0, **config}.items():  # 90 degrees: Gymnasium's viewer
            setattr(camera, key, value)
        return camera

    def _add(self, marker: dict[str, Any]) -> None:
        scene = self._scene
        if scene.ngeom >= scene.maxgeom:
            raise RuntimeError(f"a scene of more than max_geom={scene.maxgeom} shapes")
        shape = {"size": (0.1, 0.1, 0.1), "mat": np.eye(3), "rgba": (1.0, 1.0, 1.0, 1.0), **marker}
        sizes = (np.asarray(shape[key], np.float64).ravel() for key in ("size", "pos", "mat"))
        colour = np.asarray(shape["rgba"], np.float32)
        mujoco.mjv_initGeom(scene.geoms[scene.ngeom], shape["type"], *sizes, colour)
        scene.ngeom += 1


_open_renderers: weakref.WeakSet[_Renderer] = weakref.WeakSet()


def _close_open_renderers() -> None:
    for renderer in list(_open_renderers):
        renderer.close()


def renders_fast(render_quality: str, render_mode: str | None) -> bool:
    """Whether images come from a :class:`FastRenderer`; refuses what is unknown or does not fit."""
    if render_quality not in RENDER_QUALITIES:
        raise ValueError(
            f"render_quality must be one of {RENDER_QUALITIES}, got {render_quality!r}"
        )
    if render_quality == "fast" and render_mode not in (None, "rgb_array"):
        raise ValueError(
            f'render_quality="fast" goes with render_mode="rgb_array" alone, got {render_mode!r}'
        )
    return render_quality == "fast"


def fit_buffer(model: mujoco.MjModel, width: int, height: int) -> None:
    """Let images of a model be as large as this."""
    settings = model.vis.global_
    settings.offwidth = max(settings.offwidth, width)
    settings.offheight = max(settings.offheight, height)


def _make_context(width: int, height: int) -> Any:
    """A graphics context off screen; ``mujoco.GLContext`` is fixed when MuJoCo is imported."""
    choose_headless_backend()
    backend, module = os.environ.get("MUJOCO_GL", "").lower(), mujoco
    if backend in ("egl", "osmesa"):
        module = importlib.import_module(f"mujoco.{backend}")
    return module.GLContext(width, height)


def renderer_inside(env: Any) -> Any:
    """The ``MujocoRenderer`` of a bare environment, which mazes keep one deeper, if it has one."""
    for holder in (env, getattr(env, "ant_env", None), getattr(env, "point_env", None)):
        renderer = getattr(holder, "mujoco_renderer", None)
        if renderer is not None:
            return renderer
    return None


def prepare_to_render(env: Any, render_mode: str | None) -> None:
    """Choose a backend, and make a bare environment's graphics context the current one: Gymnasium
    does not when another environment has rendered since, and gives an image of nothing.
    """
    renderer = renderer_inside(env)
    if renderer is None or render_mode is None:
        return
    if render_mode != "human":
        choose_headless_backend()
    renderer._get_viewer(render_mode).make_context_current()


def close_viewers(env: Any) -> None:
    """Close what a bare environment renders with, so that a later rendering opens it anew:
    Gymnasium's own ``close`` keeps what it has closed, and renders black with it.
    """
    renderer = renderer_inside(env)
    if renderer is not None:
        _empty(renderer)


def _empty(renderer: Any) -> None:
    for viewer in renderer._viewers.values():
        viewer.make_context_current()
        if hasattr(viewer, "opengl_context"):
            viewer.con.free()  # while its own context is current
        viewer.close()
    renderer._viewers.clear()
    renderer.viewer = None


def arrow(start: np.ndarray, direction: tuple[float, float], length: float) -> dict[str, Any]:
    """A horizontal arrow from a point ``(3,)`` in a direction (a unit vector), as a marker."""
    x, y = direction
    return {
        "type": mujoco.mjtGeom.mjGEOM_ARROW,
        "pos": np.asarray(start, dtype=np.float64),
        "mat": np.array([0.0, -y, x, 0.0, x, y, -1.0, 0.0, 0.0]),  # it points along its own z axis
        "size": np.array([0.03, 0.03, length]),
        "rgba": np.array(TASK_COLOUR),
    }


def pole(x: float, y: float, height: float) -> dict[str, Any]:
    """An upright pole on the floor, as a marker."""
    return {
        "type": mujoco.mjtGeom.mjGEOM_CYLINDER,
        "pos": np.array([x, y, height / 2]),
        "mat": np.eye(3).flatten(),
        "size": np.array([0.08, height / 2, 0.0]),
        "rgba": np.array(TASK_COLOUR),
    }
