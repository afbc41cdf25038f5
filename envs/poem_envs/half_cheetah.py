"""HalfCheetah with a hidden speed or direction."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from poem_envs.mujoco_family import MujocoFamily, MujocoTaskEnv, MujocoTaskVectorEnv
from poem_envs.mujoco_rendering import arrow


class _HalfCheetah(MujocoFamily):
    hidden_qpos = 1
    reward_feature_dim = 2

    def __init__(
        self,
        *,
        xml_file: str = "half_cheetah.xml",
        forward_reward_weight: float = 1.0,
        ctrl_cost_weight: float = 0.05,
        reset_noise_scale: float = 0.1,
        **kwargs: Any,
    ) -> None:
        self.forward_reward_weight = forward_reward_weight
        self.ctrl_cost_weight = ctrl_cost_weight
        super().__init__(xml_file=xml_file, reset_noise_scale=reset_noise_scale, **kwargs)

    def _reward_features(self, qpos_before: np.ndarray, actions: np.ndarray) -> np.ndarray:
        velocity = (self._qpos[:, 0] - qpos_before[:, 0]) / self.dt
        return np.stack([velocity, np.square(actions).sum(axis=1)], axis=1)


class _HalfCheetahVel(_HalfCheetah):
    def __init__(self, **kwargs: Any) -> None:
        self.task_space = spaces.Box(0.0, 3.0, (1,), np.float64)
        super().__init__(**kwargs)

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        error = np.abs(features[..., 0] - tasks[..., 0])
        return -self.forward_reward_weight * error - self.ctrl_cost_weight * features[..., 1]

    def _task_markers(self, task: np.ndarray, position: np.ndarray) -> list[dict[str, Any]]:
        return [arrow(np.array([position[0], 0.0, 1.3]), (1.0, 0.0), length=float(task[0]) / 2)]


class _HalfCheetahFwdBack(_HalfCheetah):
    def __init__(self, **kwargs: Any) -> None:
        self.task_space = spaces.Box(-1.0, 1.0, (1,), np.float64)
        self.all_tasks = np.array([[1.0], [-1.0]])
        super().__init__(**kwargs)

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        return self.forward_reward_weight * tasks[..., 0] * features[..., 0] - self.ctrl_cost_weight * features[..., 1]

    def _task_markers(self, task: np.ndarray, position: np.ndarray) -> list[dict[str, Any]]:
        return [arrow(np.array([position[0], 0.0, 1.3]), (float(task[0]), 0.0), length=1.0)]


class HalfCheetahVelEnv(_HalfCheetahVel, MujocoTaskEnv):
    r""" """


class HalfCheetahVelVectorEnv(_HalfCheetahVel, MujocoTaskVectorEnv):
    """The vectorised :class:`HalfCheetahVelEnv`: same arguments, and those of a vectorised MuJoCo family."""


class HalfCheetahFwdBackEnv(_HalfCheetahFwdBack, MujocoTaskEnv):
    r""" """


class HalfCheetahFwdBackVectorEnv(_HalfCheetahFwdBack, MujocoTaskVectorEnv):
    """The vectorised :class:`HalfCheetahFwdBackEnv`: same arguments, and those of a vectorised MuJoCo family."""
