"""What Ant and Humanoid have in common: they can fall, and may run in a hidden direction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from poem_envs.mujoco_family import MujocoFamily
from poem_envs.mujoco_rendering import arrow


@dataclass(kw_only=True, eq=False, repr=False)
class LeggedFamily(MujocoFamily):
    """A robot that ends its episode outside a range of heights; the last feature is the cost."""

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

    def visible_difference(self, left: np.ndarray, right: np.ndarray, spread: np.ndarray) -> float:
        """See :class:`TaskFamily`: of the velocity or place; what actions cost is not seen."""
        return super().visible_difference(left[:, :-1], right[:, :-1], spread[:-1])

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
