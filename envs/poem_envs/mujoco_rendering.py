"""Rendering of MuJoCo states, with a camera that follows the robot and markers for its task."""

import atexit
import weakref
from typing import Any

import mujoco
import numpy as np

from poem_envs.headless import choose_headless_backend

RENDER_QUALITIES = ("full", "fast")
TASK_COLOUR = (0.16, 0.65, 0.27, 1.0)
# Slices and stacks of a sphere, quads of a plane: at a web page's size nobody sees it.
COARSE = 12, 6, 1
FLAGS = mujoco.mjtRndFlag
LEFT_OUT = [FLAGS.mjRND_SHADOW.value, FLAGS.mjRND_REFLECTION.value, FLAGS.mjRND_HAZE.value]


class StateRenderer:
    """Renders states as Gymnasium's ``MujocoRenderer`` does; its own camera follows the root. The
    model's settings of rendering are changed. A graphics context belongs to the thread that
    rendered first; render from no other. Fast is without shadows, reflections, haze or details.
    """

    def __init__(
        self, model: mujoco.MjModel, width: int, height: int, *, fast: bool = False, **view: Any
    ) -> None:
        from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer  # loads the window system

        self._model, self._data, self._fast = model, mujoco.MjData(model), fast
        fit_buffer(model, width, height)
        if fast:
            leave_out_details(model)
        self._follows = view.get("camera_name") is None
        self._renderer = MujocoRenderer(model, self._data, width=width, height=height, **view)

    def render(self, state: np.ndarray, render_mode: str, markers: list[dict[str, Any]]) -> Any:
        """Render time, positions and velocities ``(1 + nq + nv,)`` with markers as ``add_marker``
        takes them.
        """
        mujoco.mj_setState(self._model, self._data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_forward(self._model, self._data)
        viewer = prepared_viewer(self._renderer, render_mode, self._fast)
        if self._follows:
            viewer.cam.lookat[:2] = self._data.xpos[1, :2]
        for marker in markers:
            viewer.add_marker(**marker)
        image = self._renderer.render(render_mode)
        return np.ascontiguousarray(image) if isinstance(image, np.ndarray) else image

    def close(self) -> None:
        close_viewers(self._renderer)


def renders_fast(render_quality: str, render_mode: str | None) -> bool:
    """Whether images are to be drawn fast; refuses what is unknown or does not fit."""
    if render_quality not in RENDER_QUALITIES:
        raise ValueError(f"{render_quality=} must be one of {RENDER_QUALITIES}")
    if render_quality == "fast" and render_mode not in (None, "rgb_array"):
        raise ValueError(f"{render_quality=} needs render_mode='rgb_array', got {render_mode!r}")
    return render_quality == "fast"


def fit_buffer(model: mujoco.MjModel, width: int, height: int) -> None:
    """Let images of a model be as large as this."""
    settings = model.vis.global_
    settings.offwidth = max(settings.offwidth, width)
    settings.offheight = max(settings.offheight, height)


def leave_out_details(model: mujoco.MjModel) -> None:
    """Let images of a model be without antialiasing, and round shapes coarse."""
    quality = model.vis.quality
    quality.offsamples = 0
    quality.numslices, quality.numstacks, quality.numquads = COARSE


def prepared_viewer(renderer: Any, render_mode: str, fast: bool = False) -> Any:
    """The viewer of a ``MujocoRenderer``, whose graphics context is made the current one:
    Gymnasium does not when another has rendered since, and gives an image of nothing.
    """
    if render_mode != "human":
        choose_headless_backend()
    viewer = renderer._get_viewer(render_mode)
    viewer.make_context_current()
    if fast:
        viewer.scn.flags[LEFT_OUT] = 0
    # A context must go before the library that made it: so register after its import.
    if not _open_renderers:
        atexit.register(_close_open_renderers)
    _open_renderers.add(renderer)
    return viewer


_open_renderers: weakref.WeakSet[Any] = weakref.WeakSet()


def _close_open_renderers() -> None:
    for renderer in list(_open_renderers):
        close_viewers(renderer)


def close_viewers(renderer: Any) -> None:
    """Close what a ``MujocoRenderer`` renders with, so that a later rendering opens it anew:
    Gymnasium's own ``close`` keeps what it has closed, and renders black with it.
    """
    for viewer in renderer._viewers.values():
        viewer.make_context_current()
        if hasattr(viewer, "opengl_context"):
            viewer.con.free()  # while its own context is current
        viewer.close()
    renderer._viewers.clear()
    renderer.viewer = None
    _open_renderers.discard(renderer)


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
