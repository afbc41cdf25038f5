"""MuJoCo task families, any number of whose copies are stepped by MuJoCo's own threads."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces
from mujoco.rollout import Rollout

from poem_envs.films import MujocoFilms
from poem_envs.mujoco_rendering import StateRenderer, arrow, renders_fast
from poem_envs.vector import BatchFamily


@dataclass(kw_only=True, eq=False, repr=False)
class MujocoFamily(MujocoFilms, BatchFamily):
    """Base class of the families of MuJoCo robots.

    A robot sets the class attributes and defines :meth:`_movement`, :meth:`_draw_start`
    where its start is another, and :meth:`_unhealthy` where it can fall. A family on top of it
    defines tasks, reward, and how a task is shown (:meth:`_task_markers`).

    **A control step** sets MuJoCo's solver warm start (``qacc_warmstart``) to zero and makes
    ``frame_skip`` physics steps. Gymnasium's environments let the warm start run on between control
    steps; it is no part of MuJoCo's physics state (``mjSTATE_FULLPHYSICS``), and ``mujoco.rollout``
    starts each call at zero. So ours makes the next state a function of state and action alone, the
    same in one environment as in many. It moves a step's result by the solver's tolerance
    (most for Humanoid, whose model allows its solver few iterations); apart from it the dynamics
    are Gymnasium's bit for bit.

    **Velocities** of the reward are differences of integrated positions over the control step.
    Gymnasium's Ant and Humanoid read body positions, which MuJoCo updates one physics step late.

    Images have ``width`` and ``height`` in pixels, and hold at most ``max_geom`` shapes.

    :param xml_file: Model file; a bare name is one of Gymnasium's
    :param frame_skip: Physics steps in a control step
    :param reset_noise_scale: Scale of the random start around the model's initial pose
    :param camera_name: Camera of the model to render from; None for one that follows the robot
    :param default_camera_config: Attributes of the following camera, such as ``{"distance": 4.0}``,
        over the robot's own
    :param render_quality: "full", or "fast": without shadows, reflections and antialiasing, for RGB
        images alone
    :raises OSError: If there is no such model file
    :raises ValueError: If the rendering quality is unknown, or does not go with the render mode
    """

    #: Number of positions at the head of ``qpos`` that the observation leaves out.
    hidden_qpos: ClassVar[int]
    #: The following camera: attributes of ``mujoco.MjvCamera``.
    camera_config: ClassVar[dict[str, Any]] = {"distance": 4.0}

    metadata = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]}  # noqa: RUF012

    xml_file: str
    frame_skip: int = 5
    reset_noise_scale: float = 0.1
    width: int = 480
    height: int = 480
    camera_name: str | None = None
    default_camera_config: dict[str, Any] | None = None
    max_geom: int = 1000
    render_quality: str = "full"

    def __post_init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_path(_model_path(self.xml_file))
        if self.model.na:
            raise ValueError(f"xml_file={self.xml_file!r} must not have actuators with activations")
        self._rollout: Rollout | None = None
        self._renderer: StateRenderer | None = None
        initial = mujoco.MjData(self.model)
        self.init_qpos, self.init_qvel = initial.qpos.copy(), initial.qvel.copy()
        self._renders_fast = renders_fast(self.render_quality, self.render_mode)
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.dt)}
        super().__post_init__()
        shape = self._observations().shape[1:]
        self.observation_space = spaces.Box(-np.inf, np.inf, shape, np.float64)
        low, high = self.model.actuator_ctrlrange.astype(np.float32).T
        self.action_space = spaces.Box(low, high, dtype=np.float32)

    def __getstate__(self) -> dict[str, Any]:
        """All but threads and graphics, which a copy makes for itself."""
        return {**vars(self), "_rollout": None, "_renderer": None, "_film_renderer": None}

    @property
    def dt(self) -> float:
        """Seconds in a control step."""
        return self.model.opt.timestep * self.frame_skip

    @property
    def _qpos(self) -> np.ndarray:
        """Positions of all copies, ``(n, nq)``, a view."""
        return self.states[:, 1 : 1 + self.model.nq]

    def _draw_start(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """An episode's first ``qpos`` and ``qvel``; as Gymnasium's Ant unless overridden."""
        scale = self.reset_noise_scale
        qpos = self.init_qpos + rng.uniform(low=-scale, high=scale, size=self.model.nq)
        qvel = self.init_qvel + scale * rng.standard_normal(self.model.nv)
        return qpos, qvel

    def _movement(self, qpos_before: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """What the reward of the step just taken depends on, ``(n,)`` or ``(n, k)``: made of
        positions before ``(n, nq)`` and of those that are now. The last reward feature is added to
        it, the action's squared length.
        """
        raise NotImplementedError

    def visible_difference(self, left: np.ndarray, right: np.ndarray, spread: np.ndarray) -> float:
        """See :class:`TaskFamily`: of the velocity or place; what actions cost is not seen."""
        return super().visible_difference(left[:, :-1], right[:, :-1], spread[:-1])

    def _unhealthy(self) -> np.ndarray:
        """Which copies end their episode now, ``(n,)``: none unless overridden."""
        return np.zeros(len(self.states), dtype=bool)

    def _task_markers(self, task: np.ndarray, position: np.ndarray) -> list[dict[str, Any]]:
        """Shapes that show a task, as ``add_marker`` takes them; ``(3,)``, the robot's root."""
        raise NotImplementedError

    def _allocate(self, n: int) -> None:
        #: Of all copies, MuJoCo's mjSTATE_FULLPHYSICS: time, positions, velocities.
        self.states = np.zeros((n, 1 + self.model.nq + self.model.nv))

    def _begin_episodes(self, copies: np.ndarray, rngs: Sequence[np.random.Generator]) -> None:
        for copy, rng in zip(copies, rngs, strict=True):
            self.states[copy] = np.concatenate(([0.0], *self._draw_start(rng)))

    def _advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        after = self._integrate(actions)
        self._check_divergence(after)
        qpos_before = self._qpos.copy()
        self.states[:] = after
        movement = self._movement(qpos_before, actions)
        return np.column_stack([movement, np.square(actions).sum(axis=1)]), self._unhealthy()

    def _integrate(self, actions: np.ndarray) -> np.ndarray:
        """The states after a control step: a view that the next call overwrites."""
        n, steps = len(self.states), self.frame_skip
        if self._rollout is None:
            nthread = min(self.nthread, n)
            self._rollout = Rollout(nthread=nthread if nthread > 1 else 0)
            self._rollout_data = [mujoco.MjData(self.model) for _ in range(nthread)]
            self._after = np.empty((n, steps, self.states.shape[1]))
        self._rollout.rollout(
            [self.model] * n,
            self._rollout_data,
            self.states,
            np.repeat(actions[:, None], steps, axis=1),
            control_spec=mujoco.mjtState.mjSTATE_CTRL.value,
            skip_checks=True,
            nstep=steps,
            state=self._after,
        )
        return self._after[:, -1]

    def _check_divergence(self, after: np.ndarray) -> None:
        # MuJoCo resets a simulation that blows up, with a mere warning; its clock tells.
        late = np.abs(after[:, 0] - self.states[:, 0] - self.dt) > 0.5 * self.model.opt.timestep
        diverged = late | ~np.isfinite(after).all(axis=1)
        if diverged.any():
            copy = int(np.flatnonzero(diverged)[0])
            qpos, qvel = np.split(np.abs(self.states[copy, 1:]), [self.model.nq])
            raise RuntimeError(
                f"the simulation of {type(self).__name__} diverged at "
                f"{self._describe_episode(copy)}: MuJoCo met a state that is not finite or too "
                f"large; before, max|qpos|={qpos.max():.3g} and max|qvel|={qvel.max():.3g}"
            )

    def _observations(self) -> np.ndarray:
        return self.states[:, 1 + self.hidden_qpos :].copy()

    def _render_copy(self, copy: int, render_mode: str, task: np.ndarray | None) -> Any:
        markers = [] if task is None else self._task_markers(task, self._qpos[copy, :3])
        if self._renderer is None:
            camera = {**self.camera_config, **(self.default_camera_config or {})}
            names = ("width", "height", "camera_name", "max_geom")
            view: dict[str, Any] = {name: getattr(self, name) for name in names}
            view["default_cam_config"] = camera
            self._renderer = StateRenderer(self.model, fast=self._renders_fast, **view)
        return self._renderer.render(self.states[copy], render_mode, markers)

    def film_state(self) -> np.ndarray:
        """See :class:`~poem_envs.films.Filmed`; of the first copy."""
        return self.states[0].copy()

    def _film_model(self) -> mujoco.MjModel:
        return self.model

    def close(self) -> None:
        """Free what rendering and simulation hold."""
        self._close_films()
        for held in (self._rollout, self._renderer):
            if held is not None:
                held.close()
        self._rollout = self._renderer = None


@dataclass(kw_only=True, eq=False, repr=False)
class LeggedFamily(MujocoFamily):
    """A robot that ends its episode outside a range of heights."""

    hidden_qpos = 2
    reward_feature_dim = 3
    #: Height at which the task is shown, m.
    marker_height: ClassVar[float]
    #: How a healthy height compares to the ends of the range.
    within: ClassVar[np.ufunc] = np.less_equal

    ctrl_cost_weight: float
    healthy_z_range: tuple[float, float]
    terminate_when_unhealthy: bool = True

    def _unhealthy(self) -> np.ndarray:
        if not self.terminate_when_unhealthy:
            return super()._unhealthy()
        (lowest, highest), height = self.healthy_z_range, self._qpos[:, 2]
        return ~(self.within(lowest, height) & self.within(height, highest))

    def _marker_place(self, position: np.ndarray) -> np.ndarray:
        """Above the robot, ``(3,)``."""
        return np.array([position[0], position[1], self.marker_height])


@dataclass(kw_only=True, eq=False, repr=False)
class DirectionFamily(LeggedFamily):
    """A robot that is to run in a direction; features are v_x, v_y and the action's square."""

    forward_reward_weight: float = 1.0
    healthy_reward: float = 1.0

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        angle = np.array(tasks[..., 0])  # contiguous: strided input may be rounded differently
        speed = features[..., 0] * np.cos(angle) + features[..., 1] * np.sin(angle)
        forward = self.forward_reward_weight * speed
        return forward - self.ctrl_cost_weight * features[..., 2] + self.healthy_reward

    def _task_markers(self, task: np.ndarray, position: np.ndarray) -> list[dict[str, Any]]:
        direction = (float(np.cos(task[0])), float(np.sin(task[0])))
        return [arrow(self._marker_place(position), direction, length=1.0)]


def _model_path(xml_file: str) -> str:
    path = os.path.expanduser(xml_file)
    if os.sep not in path:
        path = os.path.join(os.path.dirname(gymnasium.__file__), "envs", "mujoco", "assets", path)
    if not os.path.exists(path):
        raise OSError(f"{xml_file=} does not exist; give a path, or the name of a Gymnasium model")
    return path
