"""Ant with a hidden speed, direction or goal."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

from poem_envs.films import Look
from poem_envs.mujoco_family import DirectionFamily, LeggedFamily
from poem_envs.mujoco_rendering import arrow, pole


@dataclass(kw_only=True, eq=False, repr=False)
class _Ant(LeggedFamily):
    marker_height = 1.3
    camera_config = {"distance": 5.0, "elevation": -30.0, "lookat": np.array([0.0, 0.0, 0.5])}  # noqa: RUF012
    look = Look(elevation=-25.0, distance=4.0, lookat=(0.0, 0.0, 0.4), marks="metres")

    xml_file: str = "ant.xml"
    ctrl_cost_weight: float = 0.5
    healthy_z_range: tuple[float, float] = (0.2, 1.0)

    def _movement(self, qpos_before: np.ndarray, actions: np.ndarray) -> np.ndarray:
        return (self._qpos[:, :2] - qpos_before[:, :2]) / self.dt


@dataclass(kw_only=True, eq=False, repr=False)
class AntVelEnv(_Ant):
    r"""
    ## Description
    The Ant, a quadruped with eight hinges, is to run forward (in x direction) at a speed that it
    cannot see. The dynamics are those of Gymnasium's `Ant-v5`, but for the solver's warm start,
    which every step begins at zero (see :class:`~poem_envs.mujoco_family.MujocoFamily`).

    ## Task
    The goal speed in m/s, uniform on [0, 3], hidden from the observation: `task_space` is
    `Box(0, 3, (1,), float64)`.

    ## Action Space
    The action space is a `Box(-1, 1, (8,), float32)`: torques at the hinge joints in N m, scaled by
    each motor's gear.

    | Num  | Action                               | Control Min | Control Max | XML name       |
    | ---- | ------------------------------------ | ----------- | ----------- | -------------- |
    | 0, 1 | torques on back right hip and ankle  | -1          | 1           | hip_4, ankle_4 |
    | 2, 3 | torques on front left hip and ankle  | -1          | 1           | hip_1, ankle_1 |
    | 4, 5 | torques on front right hip and ankle | -1          | 1           | hip_2, ankle_2 |
    | 6, 7 | torques on back left hip and ankle   | -1          | 1           | hip_3, ankle_3 |

    ## Observation Space
    The observation space is a `Box(-Inf, Inf, (27,), float64)`: positions without x and y, then
    velocities, all unbounded. Contact forces, which Gymnasium's Ant-v5 appends, are left out.

    | Num      | Observation                             | XML name            | Joint | Unit  |
    | -------- | --------------------------------------- | ------------------- | ----- | ----- |
    | 0        | z-coordinate of the torso               | root                | free  | m     |
    | 1 - 4    | orientation of the torso (w, x, y, z)   | root                | free  | -     |
    | 5, 6     | angles of the front left hip and ankle  | hip_1, ankle_1      | hinge | rad   |
    | 7, 8     | angles of the front right hip and ankle | hip_2, ankle_2      | hinge | rad   |
    | 9, 10    | angles of the back left hip and ankle   | hip_3, ankle_3      | hinge | rad   |
    | 11, 12   | angles of the back right hip and ankle  | hip_4, ankle_4      | hinge | rad   |
    | 13 - 15  | velocity of the torso in x, y, z        | root                | free  | m/s   |
    | 16 - 18  | angular velocity of the torso           | root                | free  | rad/s |
    | 19 - 26  | velocities of the hinges, as 5 - 12     | hip_1, ..., ankle_4 | hinge | rad/s |
    | excluded | x- and y-coordinate of the torso        | root                | free  | m     |

    ## Rewards
    $offset - w_{forward} |v_x - v_{goal}| - w_{ctrl} \|action\|_2^2 + healthy$, where $v_x$ is the
    change of the torso's x-coordinate over the step, divided by its duration `dt` = 0.05 s.
    Gymnasium's Ant-v5 takes the position that lags by a physics step; here both ends are the
    integrated state. Every step earns `forward_reward_offset` and `healthy_reward`, the last of an
    early end too. The reward features are $(v_x, v_y, \|action\|_2^2)$.

    ## Starting State
    The model's initial pose, 0.75 m above the floor, plus noise: uniform on
    [-`reset_noise_scale`, `reset_noise_scale`] in every position, and normal with standard
    deviation `reset_noise_scale` in every velocity.

    ## Episode End
    An episode terminates when the torso's z-coordinate leaves `healthy_z_range`, unless
    `terminate_when_unhealthy=False`. `gymnasium.make` truncates episodes after 200 steps.

    ## Arguments
    ```python
    import gymnasium as gym
    env = gym.make("poem_envs:poem/AntVel-v0", ctrl_cost_weight=0.005)
    ```

    | Parameter                  | Type      | Default      | Description                       |
    | -------------------------- | --------- | ------------ | --------------------------------- |
    | `forward_reward_weight`    | **float** | `1.0`        | Weight of the speed term          |
    | `forward_reward_offset`    | **float** | `1.0`        | Added to the reward of every step |
    | `healthy_reward`           | **float** | `0.05`       | Added to the reward of every step |
    | `ctrl_cost_weight`         | **float** | `0.005`      | Weight of the action cost         |
    | `terminate_when_unhealthy` | **bool**  | `True`       | Whether a fall ends the episode   |
    | `healthy_z_range`          | **tuple** | `(0.2, 1.0)` | Healthy heights of the torso, m   |
    | `reset_noise_scale`        | **float** | `0.1`        | Scale of the noise of the start   |

    Further arguments (`xml_file="ant.xml"`, `frame_skip=5`, `render_mode`, cameras, size of images)
    are those of :class:`~poem_envs.mujoco_family.MujocoFamily`. `render_task=True` shows the hidden
    task: an arrow, half a metre long for each m/s.
    """

    task_space = spaces.Box(0.0, 3.0, (1,), np.float64)

    forward_reward_weight: float = 1.0
    forward_reward_offset: float = 1.0
    healthy_reward: float = 0.05
    ctrl_cost_weight: float = 0.005

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        error = np.abs(features[..., 0] - tasks[..., 0])
        forward = self.forward_reward_offset - self.forward_reward_weight * error
        return forward - self.ctrl_cost_weight * features[..., 2] + self.healthy_reward

    def _task_markers(self, task: np.ndarray, position: np.ndarray) -> list[dict[str, Any]]:
        return [arrow(self._marker_place(position), (1.0, 0.0), length=float(task[0]) / 2)]


@dataclass(kw_only=True, eq=False, repr=False)
class AntFwdBackEnv(_Ant, DirectionFamily):
    r"""
    ## Description
    The Ant is to run as fast as it can forward or backward (in x direction), and cannot see which.

    ## Task
    The direction as an angle, 0 (forward) or pi (backward), hidden from the observation:
    `all_tasks` holds these two, and `task_space` is `Box(0, pi, (1,), float64)`.

    ## Action Space, Observation Space, Starting State, Episode End
    As :class:`AntVelEnv`.

    ## Rewards
    $w_{forward} \cdot (v_x \cos(angle) + v_y \sin(angle)) - w_{ctrl} \|action\|_2^2 + healthy$,
    where $v$ is the change of the torso's position over the step, divided by its duration
    `dt` = 0.05 s. Every step earns `healthy_reward`, the last of an early end too. The reward
    features are $(v_x, v_y, \|action\|_2^2)$.

    ## Arguments
    ```python
    import gymnasium as gym
    env = gym.make("poem_envs:poem/AntFwdBack-v0", ctrl_cost_weight=0.5)
    ```

    | Parameter               | Type      | Default | Description                       |
    | ----------------------- | --------- | ------- | --------------------------------- |
    | `forward_reward_weight` | **float** | `1.0`   | Weight of the speed term          |
    | `healthy_reward`        | **float** | `1.0`   | Added to the reward of every step |
    | `ctrl_cost_weight`      | **float** | `0.5`   | Weight of the action cost         |

    The others are those of :class:`AntVelEnv`, but for `forward_reward_offset`.
    `render_task=True` shows the hidden task: an arrow.
    """

    task_space = spaces.Box(0.0, np.pi, (1,), np.float64)
    all_tasks = np.array([[0.0], [np.pi]])


@dataclass(kw_only=True, eq=False, repr=False)
class AntDir2DEnv(_Ant, DirectionFamily):
    r"""
    ## Description
    The Ant is to run as fast as it can in a direction of the plane that it cannot see.

    ## Task
    The direction as an angle, uniform on [-pi/2, pi/2], 0 being the x direction, hidden from the
    observation: `task_space` is `Box(-pi/2, pi/2, (1,), float64)`.

    ## Action Space, Observation Space, Starting State, Episode End
    As :class:`AntVelEnv`.

    ## Rewards, Arguments
    As :class:`AntFwdBackEnv`.
    """

    look = Look(0.0, -50.0, 5.0, marks="compass")
    task_space = spaces.Box(-np.pi / 2, np.pi / 2, (1,), np.float64)


@dataclass(kw_only=True, eq=False, repr=False)
class AntGoalEnv(_Ant):
    r"""
    ## Description
    The Ant is to walk to a place that it cannot see, and to stay there.

    ## Task
    The goal's x- and y-coordinate in m, uniform on the disc of radius 3 around the origin, hidden
    from the observation: `task_space` is `Box(-3, 3, (2,), float64)`.

    ## Action Space, Starting State
    As :class:`AntVelEnv`.

    ## Observation Space
    The observation space is a `Box(-Inf, Inf, (29,), float64)`: the x- and y-coordinate of the
    torso, then the 27 elements of :class:`AntVelEnv`. Where the ant is belongs to it, since the
    goal is a place.

    ## Rewards
    $-w_{distance} (|x - x_{goal}| + |y - y_{goal}|) - w_{ctrl} \|action\|_2^2$, with the torso's
    position after the step. The reward features are $(x, y, \|action\|_2^2)$.

    ## Episode End
    There is no early end unless `terminate_when_unhealthy=True`, which works as in
    :class:`AntVelEnv`. `gymnasium.make` truncates episodes after 200 steps.

    ## Arguments
    ```python
    import gymnasium as gym
    env = gym.make("poem_envs:poem/AntGoal-v0", ctrl_cost_weight=0.1)
    ```

    | Parameter                  | Type      | Default | Description                     |
    | -------------------------- | --------- | ------- | ------------------------------- |
    | `distance_reward_weight`   | **float** | `1.0`   | Weight of the distance term     |
    | `ctrl_cost_weight`         | **float** | `0.1`   | Weight of the action cost       |
    | `terminate_when_unhealthy` | **bool**  | `False` | Whether a fall ends the episode |

    `healthy_z_range`, `reset_noise_scale` and further arguments are those of :class:`AntVelEnv`.
    `render_task=True` shows the hidden task: a pole at the goal.
    """

    hidden_qpos = 0
    camera_config = {**_Ant.camera_config, "distance": 9.0, "elevation": -45.0}  # noqa: RUF012
    goal_radius = 3.0
    # From above; a little more than the places that may be meant.
    look = Look(0.0, -90.0, 8.5, (0.0, 0.0, 0.0), "circles", follows=False)
    task_space = spaces.Box(-goal_radius, goal_radius, (2,), np.float64)

    distance_reward_weight: float = 1.0
    ctrl_cost_weight: float = 0.1
    terminate_when_unhealthy: bool = False

    def _draw_tasks(self, n: int, rng: np.random.Generator) -> np.ndarray:
        # the root makes the density even over the disc
        radius = self.goal_radius * np.sqrt(rng.uniform(size=n))
        angle = rng.uniform(0.0, 2 * np.pi, size=n)
        return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])

    def _movement(self, qpos_before: np.ndarray, actions: np.ndarray) -> np.ndarray:
        return self._qpos[:, :2]

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        return self._potential(tasks, features) - self.ctrl_cost_weight * features[..., 2]

    def _potential(self, tasks: np.ndarray, observations: np.ndarray) -> np.ndarray:
        # observations and features both begin with the position
        x, y = (np.abs(observations[..., i] - tasks[..., i]) for i in range(2))
        return -self.distance_reward_weight * (x + y)

    def _task_markers(self, task: np.ndarray, position: np.ndarray) -> list[dict[str, Any]]:
        return [pole(float(task[0]), float(task[1]), height=1.0)]
