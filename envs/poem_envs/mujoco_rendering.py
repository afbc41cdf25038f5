"""Rendering of MuJoCo states, with a camera that follows the robot and markers for what is hidden."""

from __future__ import annotations

import atexit
import weakref
from typing import Any, Protocol

import mujoco
import numpy as np

from poem_envs.headless import choose_headless_backend


class _Closable(Protocol):
    def close(self) -> None: ...


_open_renderers: weakref.WeakSet[_Closable] = weakref.WeakSet()

TASK_COLOUR = (0.16, 0.65, 0.27, 1.0)


class StateRenderer:
    """Renders states of one model, whoever simulated them.

    :param model: the model that the states are of
    :param width: of the image, pixels
    :param height: of the image, pixels
    :param camera_id: camera of the model; None for one that follows the robot's root
    :param camera_name: the same by name
    :param camera_config: attributes of the following camera
    :param max_geom: largest number of shapes in a scene
    :param visual_options: flags of ``mujoco.MjvOption``
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
        max_geom: int,
        visual_options: dict[int, bool] | None,
    ) -> None:
        from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer  # loads the window system

        model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, height)
        self._model = model
        self._data = mujoco.MjData(model)
        self._follows = camera_id is None and camera_name is None
        self._renderer = MujocoRenderer(
            model,
            self._data,
            camera_config,
            width,
            height,
            max_geom,
            camera_id,
            camera_name,
            visual_options,
        )

    def render(self, state: np.ndarray, render_mode: str, markers: list[dict[str, Any]]) -> Any:
        """Render one state.

        :param state: time, positions and velocities, ``(1 + nq + nv,)``
        :param render_mode: one of Gymnasium's MuJoCo render modes
        :param markers: shapes to add, as ``MujocoRenderer``'s ``add_marker`` takes them
        :return: what Gymnasium returns in that mode
        """
        mujoco.mj_setState(self._model, self._data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_forward(self._model, self._data)
        if render_mode != "human":
            choose_headless_backend()
        viewer = self._renderer._get_viewer(render_mode)
        viewer.make_context_current()  # another environment may have rendered since
        close_at_exit(self)
        if self._follows:
            viewer.cam.lookat[:2] = self._data.xpos[1, :2]
        for marker in markers:
            viewer.add_marker(**marker)
        image = self._renderer.render(render_mode)
        return np.ascontiguousarray(image) if isinstance(image, np.ndarray) else image

    def close(self) -> None:
        """Close windows and graphics contexts."""
        self._renderer.close()
        stays_closed(self)


def renderer_inside(env: Any) -> Any:
    """The ``MujocoRenderer`` of an environment that renders by itself; None where there is none.

    :param env: the bare environment; mazes of gymnasium-robotics keep the robot's environment one
        deeper
    """
    for holder in (env, getattr(env, "ant_env", None), getattr(env, "point_env", None)):
        renderer = getattr(holder, "mujoco_renderer", None)
        if renderer is not None:
            return renderer
    return None


def prepare_to_render(env: Any, render_mode: str | None) -> None:
    """Choose a backend, and make an environment's graphics context the current one: Gymnasium does
    not when another environment has rendered since, and gives an image of nothing.

    :param env: a bare environment that renders by itself
    """
    renderer = renderer_inside(env)
    if renderer is None or render_mode is None:
        return
    if render_mode != "human":
        choose_headless_backend()
    renderer._get_viewer(render_mode).make_context_current()


def close_viewers(env: Any) -> None:
    """Close what an environment renders with, so that a later rendering opens it anew: Gymnasium's
    own ``close`` keeps what it has closed, and renders black with it.

    :param env: a bare environment that renders by itself
    """
    renderer = renderer_inside(env)
    for viewer in [] if renderer is None else renderer._viewers.values():
        viewer.make_context_current()
        if hasattr(viewer, "opengl_context"):
            viewer.con.free()  # while its own context is current
        viewer.close()
    if renderer is not None:
        renderer._viewers.clear()
        renderer.viewer = None


def close_at_exit(renderer: _Closable) -> None:
    """Close a renderer when the program ends, if it still is open then."""
    # A graphics context must go before the library that made it, which ends itself at exit: so
    # register after its import.
    if not _open_renderers:
        atexit.register(_close_open_renderers)
    _open_renderers.add(renderer)


def stays_closed(renderer: _Closable) -> None:
    """Undo :func:`close_at_exit`."""
    _open_renderers.discard(renderer)


def _close_open_renderers() -> None:
    for renderer in list(_open_renderers):
        renderer.close()


def arrow(start: np.ndarray, direction: tuple[float, float], length: float) -> dict[str, Any]:
    """A horizontal arrow, as a marker.

    :param start: where it begins, ``(3,)``
    :param direction: a unit vector in the plane
    :param length: in metres
    """
    x, y = direction
    rotation = np.array(
        [[0.0, -y, x], [0.0, x, y], [-1.0, 0.0, 0.0]]
    )  # columns; the arrow points along its own z axis
    return {
        "type": mujoco.mjtGeom.mjGEOM_ARROW,
        "pos": np.asarray(start, dtype=np.float64),
        "mat": rotation.flatten(),
        "size": np.array([0.03, 0.03, length]),
        "rgba": np.array(TASK_COLOUR),
    }


def pole(x: float, y: float, height: float) -> dict[str, Any]:
    """An upright pole on the floor, as a marker.

    :param x: in metres
    :param y: in metres
    :param height: in metres
    """
    return {
        "type": mujoco.mjtGeom.mjGEOM_CYLINDER,
        "pos": np.array([x, y, height / 2]),
        "mat": np.eye(3).flatten(),
        "size": np.array([0.08, height / 2, 0.0]),
        "rgba": np.array(TASK_COLOUR),
    }
