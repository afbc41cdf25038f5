"""Families around two of Gymnasium's robots: a walker that should go at some speed, and an arm that
should point to some place. No setting of the package was chosen on them.

    cd docs/examples
    sb3-poem train --env example/Walker2dVel-v0 --gym-packages gymnasium_robots
    sb3-poem record-video --env example/Walker2dVel-v0 --gym-packages gymnasium_robots --out a.mp4
"""

import functools
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from poem_envs import TaskFamily, TaskFamilyVector
from poem_envs.films import Look, MujocoFilms

Array = NDArray[Any]


class Walker2dVel(MujocoFilms, TaskFamily):
    """Gymnasium's Walker2d, which should walk at a speed from 0 to 2 m/s. Reward of a step: 1 while
    it is up, minus how far its speed is from the task's, minus the cost of its actions. An episode
    ends when it falls. It can be drawn, and filmed for the page on which people answer.
    """

    task_space = spaces.Box(0.0, 2.0, (1,), np.float64)
    reward_feature_dim = 2  # speed (m/s), cost of the action
    metadata = {"render_modes": ["rgb_array"], "render_fps": 125}  # noqa: RUF012
    look = Look(marks="metres")

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.robot = gym.make("Walker2d-v5", render_mode=self.render_mode)
        self.observation_space = self.robot.observation_space
        self.action_space = self.robot.action_space

    def _begin_episode(self, rng: np.random.Generator) -> Array:
        return self.robot.reset(seed=int(rng.integers(2**31)))[0]

    def _simulate(self, action: Array) -> tuple[Array, Array, bool]:
        observation, _, fell, _, info = self.robot.step(action)
        return observation, np.array([info["x_velocity"], -info["reward_ctrl"]]), fell

    def _reward(self, tasks: Array, features: Array) -> Array:
        return 1.0 - np.abs(features[..., 0] - tasks[..., 0]) - features[..., 1]

    def render(self) -> Any:
        return self.robot.render()

    def _simulation(self) -> tuple[Any, Any]:  # what films are drawn from
        robot: Any = self.robot.unwrapped
        return robot.model, robot.data

    def close(self) -> None:
        self._close_films()
        self.robot.close()


class ReacherGoal(TaskFamily):
    """Gymnasium's Reacher, an arm of two joints whose fingertip should be at a place in the plane
    within 0.2 m. Reward of a step: minus the distance (m), minus a tenth of the action's square.
    """

    task_space = spaces.Box(-0.2, 0.2, (2,), np.float64)
    observation_space = spaces.Box(-np.inf, np.inf, (8,), np.float64)
    reward_feature_dim = 3  # fingertip's place (m), square of the action

    def __init__(self) -> None:
        self.robot = gym.make("Reacher-v5")
        self.action_space = self.robot.action_space

    def _draw_tasks(self, n: int, rng: np.random.Generator) -> Array:
        radius, angle = 0.2 * np.sqrt(rng.random(n)), 2.0 * np.pi * rng.random(n)
        return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    def _begin_episode(self, rng: np.random.Generator) -> Array:
        return self._observe(self.robot.reset(seed=int(rng.integers(2**31)))[0])

    def _simulate(self, action: Array) -> tuple[Array, Array, bool]:
        observation = self._observe(self.robot.step(action)[0])
        return observation, np.append(observation[-2:], np.square(action).sum()), False

    def _observe(self, observation: Array) -> Array:
        """Joints' cosines, sines and velocities, and where the fingertip is: no target."""
        fingertip = self.robot.unwrapped.get_body_com("fingertip")[:2]  # type: ignore[attr-defined]
        return np.concatenate([observation[:4], observation[6:8], fingertip])

    def _reward(self, tasks: Array, features: Array) -> Array:
        return -np.linalg.norm(features[..., :2] - tasks, axis=-1) - 0.1 * features[..., 2]

    def close(self) -> None:
        self.robot.close()


for name, family, steps in (("Walker2dVel", Walker2dVel, 200), ("ReacherGoal", ReacherGoal, 50)):
    gym.register(
        f"example/{name}-v0",
        entry_point=family,
        vector_entry_point=functools.partial(TaskFamilyVector, family),
        max_episode_steps=steps,
    )
