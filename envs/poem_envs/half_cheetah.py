"""HalfCheetah with a hidden speed or direction."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

from poem_envs.films import Look
from poem_envs.mujoco_family import MujocoFamily
from poem_envs.mujoco_rendering import arrow


@dataclass(kw_only=True, eq=False, repr=False)
class _HalfCheetah(MujocoFamily):
    hidden_qpos = 1
    reward_feature_dim = 2
    camera_config = {"distance": 4.0, "elevation": -20.0, "lookat": np.array([0.0, 0.0, 0.6])}  # noqa: RUF012
    look = Look(distance=3.8, lookat=(0.0, 0.0, 0.4), marks="metres")

    xml_file: str = "half_cheetah.xml"
    forward_reward_weight: float = 1.0
    ctrl_cost_weight: float = 0.05

    def _movement(self, qpos_before: np.ndarray, actions: np.ndarray) -> np.ndarray:
        return (self._qpos[:, 0] - qpos_before[:, 0]) / self.dt


class HalfCheetahVelEnv(_HalfCheetah):
    r"""
    ## Description
    The HalfCheetah, a planar robot of 9 body parts, is to run forward at a speed that it cannot
    see. The dynamics are those of Gymnasium's `HalfCheetah-v5`, but for the solver's warm start,
    which every step begins at zero (see :class:`~poem_envs.mujoco_family.MujocoFamily`).

    ## Task
    The goal speed in m/s, uniform on [0, 3], hidden from the observation: `task_space` is
    `Box(0, 3, (1,), float64)`.

    ## Action Space
    The action space is a `Box(-1, 1, (6,), float32)`: torques at the hinge joints in N m, scaled by
    each motor's gear.

    | Num   | Action                           | Control Min | Control Max | XML name             |
    | ----- | -------------------------------- | ----------- | ----------- | -------------------- |
    | 0 - 2 | torques: back thigh, shin, foot  | -1          | 1           | bthigh, bshin, bfoot |
    | 3 - 5 | torques: front thigh, shin, foot | -1          | 1           | fthigh, fshin, ffoot |

    ## Observation Space
    The observation space is a `Box(-Inf, Inf, (17,), float64)`: positions without the x-coordinate,
    then velocities, all unbounded.

    | Num      | Observation                               | XML name             | Joint | Unit  |
    | -------- | ----------------------------------------- | -------------------- | ----- | ----- |
    | 0        | z-coordinate of the torso, above its rest | rootz                | slide | m     |
    | 1        | pitch of the torso                        | rooty                | hinge | rad   |
    | 2 - 4    | angles of back thigh, shin and foot       | bthigh, bshin, bfoot | hinge | rad   |
    | 5 - 7    | angles of front thigh, shin and foot      | fthigh, fshin, ffoot | hinge | rad   |
    | 8        | velocity of the torso in x                | rootx                | slide | m/s   |
    | 9        | velocity of the torso in z                | rootz                | slide | m/s   |
    | 10       | pitch rate of the torso                   | rooty                | hinge | rad/s |
    | 11 - 16  | angular velocities of hinges, as 2 - 7    | bthigh, ..., ffoot   | hinge | rad/s |
    | excluded | x-coordinate of the torso                 | rootx                | slide | m     |

    ## Rewards
    $-w_{forward} |v_x - v_{goal}| - w_{ctrl} \|action\|_2^2$, where $v_x$ is the change of the
    x-coordinate over the step, divided by its duration `dt` = 0.05 s. The reward features are
    $(v_x, \|action\|_2^2)$.

    ## Starting State
    The pose at rest, plus noise: uniform on [-`reset_noise_scale`, `reset_noise_scale`] in every
    position, and normal with standard deviation `reset_noise_scale` in every velocity.

    ## Episode End
    There is no early end. `gymnasium.make` truncates episodes after 200 steps.

    ## Arguments
    ```python
    import gymnasium as gym
    env = gym.make("poem_envs:poem/HalfCheetahVel-v0", ctrl_cost_weight=0.05)
    ```

    | Parameter               | Type      | Default | Description                              |
    | ----------------------- | --------- | ------- | ---------------------------------------- |
    | `forward_reward_weight` | **float** | `1.0`   | Weight of the speed term                 |
    | `ctrl_cost_weight`      | **float** | `0.05`  | Weight of the action cost                |
    | `reset_noise_scale`     | **float** | `0.1`   | Scale of the noise of the starting state |

    Further arguments (`xml_file="half_cheetah.xml"`, `frame_skip=5`, `render_mode`, cameras, size
    of images) are those of :class:`~poem_envs.mujoco_family.MujocoFamily`. `render_task=True` shows
    the hidden task: an arrow, half a metre long for each m/s.
    """

    task_space = spaces.Box(0.0, 3.0, (1,), np.float64)

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        error = np.abs(features[..., 0] - tasks[..., 0])
        return -self.forward_reward_weight * error - self.ctrl_cost_weight * features[..., 1]

    def _task_markers(self, task: np.ndarray, position: np.ndarray) -> list[dict[str, Any]]:
        return [arrow(np.array([position[0], 0.0, 1.3]), (1.0, 0.0), length=float(task[0]) / 2)]


class HalfCheetahFwdBackEnv(_HalfCheetah):
    r"""
    ## Description
    The HalfCheetah is to run as fast as it can, forward or backward, and cannot see which.

    ## Task
    The direction, 1 (forward) or -1 (backward), hidden from the observation: `all_tasks` holds
    these two, and `task_space` is `Box(-1, 1, (1,), float64)`.

    ## Action Space, Observation Space, Starting State, Episode End, Arguments
    As :class:`HalfCheetahVelEnv`; the arrow of `render_task=True` shows the direction.

    ## Rewards
    $w_{forward} \cdot direction \cdot v_x - w_{ctrl} \|action\|_2^2$, where $v_x$ is the change of
    the x-coordinate over the step, divided by its duration `dt` = 0.05 s. The reward features are
    $(v_x, \|action\|_2^2)$.
    """

    task_space = spaces.Box(-1.0, 1.0, (1,), np.float64)
    all_tasks = np.array([[1.0], [-1.0]])

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        forward = self.forward_reward_weight * tasks[..., 0] * features[..., 0]
        return forward - self.ctrl_cost_weight * features[..., 1]

    def _task_markers(self, task: np.ndarray, position: np.ndarray) -> list[dict[str, Any]]:
        return [arrow(np.array([position[0], 0.0, 1.3]), (float(task[0]), 0.0), length=1.0)]
