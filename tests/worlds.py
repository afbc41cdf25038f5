"""Small worlds whose truth is known, with the model that solves them: no training, no networks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from scipy.special import ndtr
from stable_baselines3.common.vec_env import VecEnv

from poem_envs import TaskFamily
from sb3_poem.adaptation import MetaModel
from sb3_poem.common.trajectory import Trajectory

TOP_SPEED = 3.0
HORIZON = 20
STEP_WEIGHT = 200.0 / HORIZON  # returns as over HalfCheetahVel's 200 steps


class Walk1D(TaskFamily):
    """The example of TaskFamily's docstring, but that its episodes end beyond 2."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    task_space = spaces.Box(-1.0, 1.0, (1,), np.float64)
    reward_feature_dim = 1

    def _begin_episode(self, rng):
        self.x = rng.normal(0.0, 0.1, size=1)
        return self.x.copy()

    def _simulate(self, action):
        self.x = self.x + 0.1 * action
        return self.x.copy(), self.x.copy(), bool(abs(self.x[0]) > 2)

    def _reward(self, tasks, features):
        return -np.abs(features[..., 0] - tasks[..., 0])


class SpeedEnv(gym.Env):
    """A cart that moves at the speed it is told to; its task is a goal speed in [0, 3], its reward
    -10 |speed - goal|, and 20 steps an episode. Observations (place, speed) do not hold the goal.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012
    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    task_space = spaces.Box(0.0, TOP_SPEED, (1,), np.float64)
    all_tasks = None
    shared_dynamics = True
    reward_feature_dim = 1

    def __init__(self, end_at: float = np.inf, render_mode: str | None = None) -> None:
        self.end_at = end_at
        self.render_mode = render_mode
        self._next_task = self.task = np.array([1.5])

    def sample_tasks(self, n: int, rng: np.random.Generator) -> np.ndarray:
        return rng.uniform(0.0, TOP_SPEED, size=(n, 1))

    def set_task(self, task: np.ndarray) -> None:
        self._next_task = np.array(task, dtype=np.float64)

    @staticmethod
    def compute_rewards(tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        return -STEP_WEIGHT * np.abs(features[..., 0] - tasks[..., 0])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.task = self._next_task
        self._time = 0
        self._place = self.np_random.normal()
        return np.array([self._place, 0.0]), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        speed = 0.5 * TOP_SPEED * (float(action[0]) + 1.0)
        self._place += 0.05 * speed
        self._time += 1
        features = np.array([speed])
        reward = float(self.compute_rewards(self.task, features))
        truncated = self._time >= HORIZON
        return (
            np.array([self._place, speed]),
            reward,
            self._place > self.end_at,
            truncated,
            {"reward_features": features},
        )

    def render(self) -> np.ndarray:
        return np.full((16, 16, 3), min(255, int(abs(self._place) * 40)), dtype=np.uint8)


class SpeedVecEnv(VecEnv):
    """Many copies of :class:`SpeedEnv` in arrays, with the face of ``TaskVecEnv``; its episodes all
    end by their horizon.
    """

    def __init__(self, num_envs: int) -> None:
        self._one = SpeedEnv()
        super().__init__(num_envs, SpeedEnv.observation_space, SpeedEnv.action_space)
        self.tasks = self._next_tasks = np.full((num_envs, 1), 1.5)
        self.last_reward_features: np.ndarray | None = None

    def set_tasks(self, tasks: np.ndarray) -> None:
        self._next_tasks = np.array(tasks, dtype=np.float64)

    def keep_tasks(self) -> None:
        pass  # a seed draws no task here

    def reset(self) -> np.ndarray:
        self.tasks, self._time = self._next_tasks, 0
        self._places = np.array([np.random.default_rng(seed).normal() for seed in self._seeds])
        return np.column_stack([self._places, np.zeros(self.num_envs)])

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict]]:
        speeds = 0.5 * TOP_SPEED * (self._actions[:, 0].astype(np.float64) + 1.0)
        self._places = self._places + 0.05 * speeds
        self._time += 1
        self.last_reward_features = speeds[:, None]
        observations = np.column_stack([self._places, speeds])
        done = self._time >= HORIZON
        infos = [{"terminal_observation": row} if done else {} for row in observations]
        rewards = SpeedEnv.compute_rewards(self.tasks, self.last_reward_features)
        return observations, rewards, np.full(self.num_envs, done), infos

    def env_method(
        self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
    ) -> list[Any]:
        return [getattr(self._one, method_name)(*args, **kwargs)]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self._one, attr_name)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Any = None) -> list[bool]:
        return [False]

    def close(self) -> None:
        pass


class Blinded(gym.Wrapper):
    """Rewards are NaN, and the reward features are gone: what an adapter may see."""

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        observation, _, terminated, truncated, _ = self.env.step(action)
        return observation, float("nan"), terminated, truncated, {}


class SpeedModel(MetaModel):
    """The perfect model of :class:`SpeedEnv`: the first entry of z is the normal score of the
    speed, the others do nothing.

    S(z, z') = 2 g(z) v(z') - v(z')^2, which is g^2 less than -(g - v)^2: for every task it orders
    speeds as their returns do.
    """

    observation_space = SpeedEnv.observation_space
    action_space = SpeedEnv.action_space
    horizon = HORIZON
    task_latents: Any = None
    aggregate_to_prior_kl = 0.0
    seed = 0

    def __init__(self, latent_dim: int = 5, scale: float = 10.0, error: float = 0.05) -> None:
        self.latent_dim = latent_dim
        self.scale = scale
        self.predicted_rewards_error = error
        self.task_latents = np.random.default_rng(0).standard_normal((30, latent_dim))

    @staticmethod
    def speed(latents: np.ndarray) -> np.ndarray:
        return TOP_SPEED * ndtr(np.asarray(latents)[..., 0])

    def similarities(self, task_latents: np.ndarray, policy_latents: np.ndarray) -> np.ndarray:
        goal, speed = self.speed(task_latents), self.speed(policy_latents)
        reward_embedding = np.stack([goal, np.ones_like(goal)], axis=1)
        policy_embedding = np.stack([2.0 * speed, -(speed**2)], axis=1)
        return self.scale * reward_embedding @ policy_embedding.T

    def predicted_returns(
        self, latents: np.ndarray, trajectories: Sequence[Trajectory], max_steps: int | None = None
    ) -> np.ndarray:
        goals = self.speed(latents)
        columns = [
            -STEP_WEIGHT * np.abs(trajectory.observations[None, 1:, 1] - goals[:, None]).sum(axis=1)
            for trajectory in trajectories
        ]
        return np.stack(columns, axis=1)

    def sample_latents(self, n: int, rng: np.random.Generator, source: str = "prior") -> np.ndarray:
        if source == "prior":
            return rng.standard_normal((n, self.latent_dim))
        centres = self.task_latents[rng.integers(len(self.task_latents), size=n)]
        return centres + 0.1 * rng.standard_normal(centres.shape)

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        actions = 2.0 * self.speed(state) / TOP_SPEED - 1.0
        return np.clip(actions[..., None], -1.0, 1.0).astype(np.float32), state
