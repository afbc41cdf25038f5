"""Humanoid with a hidden direction."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from gymnasium import spaces

from poem_envs.films import Look
from poem_envs.mujoco_family import DirectionFamily

TORSO = 1  # its subtree is the whole robot
DERIVED = ("cinert", "cvel", "qfrc_actuator", "cfrc_ext")


@dataclass(kw_only=True, eq=False, repr=False)
class HumanoidDir2DEnv(DirectionFamily):
    r"""
    ## Description
    The Humanoid, a robot with 17 hinges, is to run in a direction of the plane that it cannot see,
    and not to fall. The positions and velocities follow Gymnasium's `Humanoid-v4`, but for the
    solver's warm start, which every step begins at zero (see
    :class:`~poem_envs.mujoco_family.MujocoFamily`).

    ## Task
    The direction as an angle, uniform on [-pi/2, pi/2], 0 being the x direction, hidden from the
    observation: `task_space` is `Box(-pi/2, pi/2, (1,), float64)`.

    ## Action Space
    The action space is a `Box(-0.4, 0.4, (17,), float32)`: torques at the hinge joints in N m,
    scaled by each motor's gear.

    | Num     | Action                                         | Control Min | Control Max |
    | ------- | ---------------------------------------------- | ----------- | ----------- |
    | 0 - 2   | torques on the abdomen (y, z, x)               | -0.4        | 0.4         |
    | 3 - 6   | torques on the right hip (x, z, y) and knee    | -0.4        | 0.4         |
    | 7 - 10  | torques on the left hip (x, z, y) and knee     | -0.4        | 0.4         |
    | 11 - 13 | torques on the right shoulder (1, 2) and elbow | -0.4        | 0.4         |
    | 14 - 16 | torques on the left shoulder (1, 2) and elbow  | -0.4        | 0.4         |

    ## Observation Space
    The observation space is a `Box(-Inf, Inf, (376,), float64)`, in the layout of Gymnasium's
    Humanoid-v4.

    | Num       | Observation                                                                   |
    | --------- | ----------------------------------------------------------------------------- |
    | 0 - 21    | positions `qpos` without x and y: height, orientation, 17 hinge angles        |
    | 22 - 44   | velocities `qvel`: of the torso (3), angular (3), of the hinges (17)          |
    | 45 - 184  | `cinert`: mass and inertia of the 14 bodies about the centre of mass, 10 each |
    | 185 - 268 | `cvel`: velocity of the 14 bodies about the centre of mass, 6 each            |
    | 269 - 291 | `qfrc_actuator`: generalised forces of the actuators                          |
    | 292 - 375 | `cfrc_ext`: external forces and torques on the 14 bodies, 6 each              |

    `cinert` to `cfrc_ext` are those of the state that the observation shows, under the action just
    applied. Gymnasium reads what MuJoCo computed at the start of the last physics step, and has no
    `cfrc_ext` at a reset.

    ## Rewards
    $w_{forward} \cdot (v_x \cos(angle) + v_y \sin(angle)) - w_{ctrl} \|action\|_2^2 + healthy$,
    where $v$ is the change of the centre of mass over the step, divided by its duration
    `dt` = 0.015 s; Gymnasium's Humanoid-v4 takes centres that lag by a physics step. Every step
    earns `healthy_reward`, the last of an early end too. The reward features are
    $(v_x, v_y, \|action\|_2^2)$.

    ## Starting State
    The model's initial pose, standing, plus noise: uniform on
    [-`reset_noise_scale`, `reset_noise_scale`] in every position and velocity.

    ## Episode End
    An episode terminates when the torso's z-coordinate is not strictly inside `healthy_z_range`,
    unless `terminate_when_unhealthy=False`. `gymnasium.make` truncates episodes after 200 steps.

    ## Arguments
    ```python
    import gymnasium as gym
    env = gym.make("poem_envs:poem/HumanoidDir2D-v0", ctrl_cost_weight=0.1)
    ```

    | Parameter                  | Type      | Default      | Description                       |
    | -------------------------- | --------- | ------------ | --------------------------------- |
    | `forward_reward_weight`    | **float** | `1.25`       | Weight of the speed term          |
    | `ctrl_cost_weight`         | **float** | `0.1`        | Weight of the action cost         |
    | `healthy_reward`           | **float** | `5.0`        | Added to the reward of every step |
    | `terminate_when_unhealthy` | **bool**  | `True`       | Whether falling ends the episode  |
    | `healthy_z_range`          | **tuple** | `(1.0, 2.0)` | Healthy heights of the torso, m   |
    | `reset_noise_scale`        | **float** | `0.01`       | Scale of the noise of the start   |

    Further arguments (`xml_file="humanoid.xml"`, `frame_skip=5`, `render_mode`, cameras, size of
    images) are those of :class:`~poem_envs.mujoco_family.MujocoFamily`. `render_task=True` shows
    the hidden task: an arrow.
    """

    within = np.less
    marker_height = 2.0
    camera_config = {"distance": 5.0, "elevation": -20.0, "lookat": np.array([0.0, 0.0, 1.2])}  # noqa: RUF012
    look = Look(0.0, -25.0, 3.4, (0.0, 0.0, 0.8), "compass")
    task_space = spaces.Box(-np.pi / 2, np.pi / 2, (1,), np.float64)

    xml_file: str = "humanoid.xml"
    forward_reward_weight: float = 1.25
    ctrl_cost_weight: float = 0.1
    healthy_reward: float = 5.0
    healthy_z_range: tuple[float, float] = (1.0, 2.0)
    reset_noise_scale: float = 1e-2

    def _allocate(self, n: int) -> None:
        super()._allocate(n)
        # cinert, cvel, qfrc_actuator, cfrc_ext
        self._derived = np.zeros((n, (10 + 6 + 6) * self.model.nbody + self.model.nv))
        self._centre_of_mass = np.zeros((n, 2))
        self._forward_data = mujoco.MjData(self.model)

    def _draw_start(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        scale = self.reset_noise_scale
        qpos = self.init_qpos + rng.uniform(low=-scale, high=scale, size=self.model.nq)
        qvel = self.init_qvel + rng.uniform(low=-scale, high=scale, size=self.model.nv)
        return qpos, qvel

    def _begin_episodes(self, copies: np.ndarray, rngs: Sequence[np.random.Generator]) -> None:
        super()._begin_episodes(copies, rngs)
        self._derive(copies, np.zeros((len(copies), self.model.nu)))

    def _movement(self, qpos_before: np.ndarray, actions: np.ndarray) -> np.ndarray:
        before = self._centre_of_mass.copy()
        self._derive(np.arange(len(actions)), actions)
        return (self._centre_of_mass - before) / self.dt

    def _observations(self) -> np.ndarray:
        return np.concatenate([super()._observations(), self._derived], axis=1)

    def _derive(self, copies: np.ndarray, controls: np.ndarray) -> None:
        """Compute what observation and reward take from the simulator, for some copies."""
        model, data = self.model, self._forward_data
        # views, as are those below
        derived = [np.ravel(getattr(data, name)) for name in DERIVED]
        ctrl, warm_start = data.ctrl, data.qacc_warmstart
        centre_of_mass = data.subtree_com[TORSO, :2]
        for copy, control in zip(copies.tolist(), controls, strict=True):
            mujoco.mj_setState(model, data, self.states[copy], mujoco.mjtState.mjSTATE_FULLPHYSICS)
            ctrl[:] = control
            warm_start[:] = 0.0
            mujoco.mj_forward(model, data)
            mujoco.mj_rnePostConstraint(model, data)
            np.concatenate(derived, out=self._derived[copy])
            self._centre_of_mass[copy] = centre_of_mass
