"""Ant with a hidden speed, direction or goal."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from poem_envs.mujoco_family import MujocoFamily, MujocoTaskEnv, MujocoTaskVectorEnv
from poem_envs.mujoco_rendering import arrow, pole


class _Ant(MujocoFamily):
    hidden_qpos = 2
    reward_feature_dim = 3
    camera_config = {"distance": 5.0, "elevation": -30.0, "lookat": np.array([0.0, 0.0, 0.5])}  # noqa: RUF012

    def __init__(
        self,
        *,
        xml_file: str = "ant.xml",
        ctrl_cost_weight: float = 0.5,
        terminate_when_unhealthy: bool = True,
        healthy_z_range: tuple[float, float] = (0.2, 1.0),
        reset_noise_scale: float = 0.1,
        **kwargs: Any,
    ) -> None:
        self.ctrl_cost_weight = ctrl_cost_weight
        self.terminate_when_unhealthy = terminate_when_unhealthy
        self.healthy_z_range = healthy_z_range
        super().__init__(xml_file=xml_file, reset_noise_scale=reset_noise_scale, **kwargs)

    def _reward_features(self, qpos_before: np.ndarray, actions: np.ndarray) -> np.ndarray:
        velocity = (self._qpos[:, :2] - qpos_before[:, :2]) / self.dt
        return np.column_stack([velocity, np.square(actions).sum(axis=1)])

    def _unhealthy(self) -> np.ndarray:
        if not self.terminate_when_unhealthy:
            return super()._unhealthy()
        lowest, highest = self.healthy_z_range
        height = self._qpos[:, 2]
        return ~((lowest <= height) & (height <= highest))


class _AntVel(_Ant):
    def __init__(
        self,
        *,
        forward_reward_weight: float = 1.0,
        forward_reward_offset: float = 1.0,
        ctrl_cost_weight: float = 0.005,
        healthy_reward: float = 0.05,
        **kwargs: Any,
    ) -> None:
        self.forward_reward_weight = forward_reward_weight
        self.forward_reward_offset = forward_reward_offset
        self.healthy_reward = healthy_reward
        self.task_space = spaces.Box(0.0, 3.0, (1,), np.float64)
        super().__init__(ctrl_cost_weight=ctrl_cost_weight, **kwargs)

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        forward = self.forward_reward_offset - self.forward_reward_weight * np.abs(features[..., 0] - tasks[..., 0])
        return forward - self.ctrl_cost_weight * features[..., 2] + self.healthy_reward

    def _task_markers(self, task: np.ndarray, position: np.ndarray) -> list[dict[str, Any]]:
        return [arrow(np.array([position[0], position[1], 1.3]), (1.0, 0.0), length=float(task[0]) / 2)]


class _AntDirection(_Ant):
    """Ant that is to run in a direction, whichever directions there are."""

    def __init__(self, *, forward_reward_weight: float = 1.0, healthy_reward: float = 1.0, **kwargs: Any) -> None:
        self.forward_reward_weight = forward_reward_weight
        self.healthy_reward = healthy_reward
        super().__init__(**kwargs)

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        forward = self.forward_reward_weight * speed_towards(tasks, features)
        return forward - self.ctrl_cost_weight * features[..., 2] + self.healthy_reward

    def _task_markers(self, task: np.ndarray, position: np.ndarray) -> list[dict[str, Any]]:
        direction = (float(np.cos(task[0])), float(np.sin(task[0])))
        return [arrow(np.array([position[0], position[1], 1.3]), direction, length=1.0)]


class _AntFwdBack(_AntDirection):
    def __init__(self, **kwargs: Any) -> None:
        self.task_space = spaces.Box(0.0, np.pi, (1,), np.float64)
        self.all_tasks = np.array([[0.0], [np.pi]])
        super().__init__(**kwargs)


class _AntDir2D(_AntDirection):
    def __init__(self, **kwargs: Any) -> None:
        self.task_space = spaces.Box(-np.pi / 2, np.pi / 2, (1,), np.float64)
        super().__init__(**kwargs)


class _AntGoal(_Ant):
    hidden_qpos = 0
    camera_config = {"distance": 9.0, "elevation": -45.0, "lookat": np.array([0.0, 0.0, 0.5])}  # noqa: RUF012
    goal_radius = 3.0

    def __init__(
        self,
        *,
        distance_reward_weight: float = 1.0,
        ctrl_cost_weight: float = 0.1,
        terminate_when_unhealthy: bool = False,
        **kwargs: Any,
    ) -> None:
        self.distance_reward_weight = distance_reward_weight
        self.task_space = spaces.Box(-self.goal_radius, self.goal_radius, (2,), np.float64)
        super().__init__(ctrl_cost_weight=ctrl_cost_weight, terminate_when_unhealthy=terminate_when_unhealthy, **kwargs)

    def _draw_tasks(self, n: int, rng: np.random.Generator) -> np.ndarray:
        radius = self.goal_radius * np.sqrt(rng.uniform(size=n))  # so that the density is even over the disc
        angle = rng.uniform(0.0, 2 * np.pi, size=n)
        return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])

    def _reward_features(self, qpos_before: np.ndarray, actions: np.ndarray) -> np.ndarray:
        return np.column_stack([self._qpos[:, :2], np.square(actions).sum(axis=1)])

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        distance = np.abs(features[..., 0] - tasks[..., 0]) + np.abs(features[..., 1] - tasks[..., 1])
        return -self.distance_reward_weight * distance - self.ctrl_cost_weight * features[..., 2]

    def _task_markers(self, task: np.ndarray, position: np.ndarray) -> list[dict[str, Any]]:
        return [pole(float(task[0]), float(task[1]), height=1.0)]


def speed_towards(angles: np.ndarray, velocities: np.ndarray) -> np.ndarray:
    """The component of a velocity in a direction.

    :param angles: ``(..., 1)``, in the plane, radians
    :param velocities: ``(..., at least 2)``, the first two are taken
    :return: ``(...)``
    """
    angle = np.array(angles[..., 0])  # contiguous: strided input may take another, differently rounded path
    return velocities[..., 0] * np.cos(angle) + velocities[..., 1] * np.sin(angle)


class AntVelEnv(_AntVel, MujocoTaskEnv):
    r""" """


class AntVelVectorEnv(_AntVel, MujocoTaskVectorEnv):
    """The vectorised :class:`AntVelEnv`: same arguments, and those of a vectorised MuJoCo family."""


class AntFwdBackEnv(_AntFwdBack, MujocoTaskEnv):
    r""" """


class AntFwdBackVectorEnv(_AntFwdBack, MujocoTaskVectorEnv):
    """The vectorised :class:`AntFwdBackEnv`: same arguments, and those of a vectorised MuJoCo family."""


class AntDir2DEnv(_AntDir2D, MujocoTaskEnv):
    r""" """


class AntDir2DVectorEnv(_AntDir2D, MujocoTaskVectorEnv):
    """The vectorised :class:`AntDir2DEnv`: same arguments, and those of a vectorised MuJoCo family."""


class AntGoalEnv(_AntGoal, MujocoTaskEnv):
    r""" """


class AntGoalVectorEnv(_AntGoal, MujocoTaskVectorEnv):
    """The vectorised :class:`AntGoalEnv`: same arguments, and those of a vectorised MuJoCo family."""
