"""Small families and small models for the tests of the meta-training algorithms."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from poem_envs import TaskFamily
from sb3_poem.common.buffers import TaskBatch, TaskReplayBuffer
from sb3_poem.pearl_sac.pearl_sac import PEARLSAC
from sb3_poem.poem_sac.poem_sac import POEMSAC

POINT_GOAL = "poem/PointGoal-v0"
POINT_GOAL_STEPS = 25
N_TASKS = 12
EPOCH = N_TASKS * POINT_GOAL_STEPS  # steps

ARCH = {"pi": [32], "qf": [32], "encoder": [32], "decoder": [32], "embedding": [16]}
SMALL: dict[str, Any] = {
    "n_train_tasks": N_TASKS,
    "gradient_steps": 5,
    "batch_size": 16,
    "context_size": 25,
    "meta_batch_size": 6,
    "policy_kwargs": {"net_arch": ARCH},
    "seed": 0,
    "device": "cpu",
}

Model = TypeVar("Model", bound=PEARLSAC)


def small(algorithm: type[Model], env: Any = POINT_GOAL, **arguments: Any) -> Model:
    """A model that trains an epoch in a tenth of a second."""
    return algorithm("MlpPolicy", env, **{**SMALL, **arguments})


def experience_of(buffer: TaskReplayBuffer, task: int) -> TaskBatch:
    """All transitions of a task, in the order of their slots, each (1, count, ...)."""
    slots = th.arange(int(buffer.counts[task]), device=buffer.device)[None]
    return buffer.at(th.full_like(slots, task), slots)


class Walk(TaskFamily):
    """A point on the line; its task is where it should be. Rewards need the place and the effort.
    Further out than ``edge`` the episode ends.
    """

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = spaces.Box(
        np.array([-2.0], np.float32), np.array([4.0], np.float32)
    )  # not [-1, 1], and not symmetric
    task_space = spaces.Box(-1.0, 1.0, (1,), np.float64)
    reward_feature_dim = 2

    def __init__(self, edge: float = np.inf) -> None:
        super().__init__()
        self.edge = edge

    def _begin_episode(self, rng: np.random.Generator) -> np.ndarray:
        self._place, self._time = rng.normal(0.0, 0.1), 0
        return self._observation()

    def _observation(self) -> np.ndarray:
        return np.array([self._place, 0.1 * self._time])

    def _simulate(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        self._place += 0.1 * (float(action[0]) + self._wind())
        self._time += 1
        return (
            self._observation(),
            np.array([self._place, float(action[0])]),
            abs(self._place) > self.edge,
        )

    def _wind(self) -> float:
        return 0.0

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        return -np.abs(features[..., 0] - tasks[..., 0]) - 0.01 * features[..., 1] ** 2


class Unequal(Walk):
    """Tasks to the left pay a thousandth."""

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        return np.where(tasks[..., 0] < 0, 1e-3, 1.0) * super()._reward(tasks, features)


class TwoWalks(Walk):
    """A finite family: left or right."""

    all_tasks = np.array([[-1.0], [1.0]])


class WindyWalk(Walk):
    """Tasks differ in their dynamics too, so that rewards cannot be relabelled."""

    shared_dynamics = False

    def _wind(self) -> float:
        assert self._task is not None
        return float(self._task[0])


class OtherWalk(Walk):
    """Spaces as :class:`Walk`'s, but other tasks."""

    task_space = spaces.Box(-3.0, 3.0, (1,), np.float64)


class Shaped(Walk):
    """A walk that says how good it is to be somewhere, in a way that nobody would guess."""

    def _potential(self, tasks: np.ndarray, observations: np.ndarray) -> np.ndarray:
        return 3.0 * np.sin(observations[..., 0]) * tasks[..., 0] + 1.0


class Poisoned(gym.Wrapper):
    """Returns NaN once: in place of ``what``, at a step (from 0) of an episode (from 0)."""

    def __init__(self, env: gym.Env, what: str, episode: int, step: int) -> None:
        super().__init__(env)
        self.what, self.episode, self.at = what, episode, step
        self._episode, self._step = -1, -1

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self._episode, self._step = self._episode + 1, -1
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self._step += 1
        obs, reward, terminated, truncated, info = self.env.step(action)
        if (self._episode, self._step) == (self.episode, self.at):
            if self.what == "observations":
                obs = np.array([obs[0], np.nan])
            elif self.what == "rewards":
                reward = float("nan")
            else:
                info["reward_features"] = np.array([np.inf, 0.0])
        return obs, reward, terminated, truncated, info


def walks(n: int, family: type[Walk] = Walk, steps: int = 10, **kwargs: Any) -> DummyVecEnv:
    """Copies of a walk that is cut after some steps. Not registered."""
    return DummyVecEnv([lambda: gym.wrappers.TimeLimit(family(**kwargs), steps) for _ in range(n)])


def apart(model: Model) -> Model:
    """A model that is told that its tasks differ in their dynamics: policies are run on them."""
    model.family.shared_dynamics = False
    return model


def parameters(model: PEARLSAC) -> dict[str, th.Tensor]:
    """Copies of all that training changes in the networks and their optimisers."""
    result = {f"policy.{name}": value.clone() for name, value in model.policy.state_dict().items()}
    optimizers = {
        "optimizer": model.policy.optimizer,
        "ent_coef_optimizer": model.ent_coef_optimizer,
    }
    for name, optimizer in optimizers.items():
        if optimizer is not None:
            for index, state in optimizer.state_dict()["state"].items():
                result |= {
                    f"{name}.{index}.{key}": th.as_tensor(value).clone()
                    for key, value in state.items()
                }
    if model.log_ent_coef is not None:
        result["log_ent_coef"] = model.log_ent_coef.detach().clone()
    return result


def differing(first: Mapping[str, th.Tensor], second: Mapping[str, th.Tensor]) -> list[str]:
    """Names under which two sets of parameters differ in any bit; NaN equals itself."""
    names = first.keys() | second.keys()
    return sorted(
        name
        for name in names
        if name not in first
        or name not in second
        or not th.equal(first[name].nan_to_num(1e30), second[name].nan_to_num(1e30))
    )


#: Trains on PointGoal in a quarter of a minute.
LEARN: dict[str, Any] = {
    "n_train_tasks": 20,
    "gradient_steps": 100,
    "batch_size": 32,
    "meta_batch_size": 10,
    "context_size": 25,
    "learning_rate": 3e-3,
    "gamma": 0.9,
    "tau": 0.03,
    "ent_coef": "auto_0.1",
    "kl_coef": 0.1,
    "relabel_fraction": 0.5,
    "precision": "fp32",
    "policy_kwargs": {
        "net_arch": {
            "pi": [64, 64],
            "qf": [64, 64],
            "encoder": [64, 64],
            "decoder": [64],
            "embedding": [32],
        }
    },
    "seed": 1,
    "device": "cpu",
}
LEARN_EPOCH = 20 * POINT_GOAL_STEPS


class Interrupt(BaseCallback):
    """Sends this process a signal, as Ctrl-C does, once so many environment steps are done."""

    def __init__(self, at: int, number: int = signal.SIGINT, times: int = 1) -> None:
        super().__init__()
        self.at, self.number, self.times = at, number, times

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            for _ in range(self.times):
                os.kill(os.getpid(), self.number)
        return True


def point_goal_bounds(tasks: np.ndarray) -> tuple[float, float]:
    """Mean returns on PointGoal that no policy can exceed: one that does not know the task, and one
    that does.

    After t steps each coordinate is within 0.05 t of the start. The best that a policy can do that
    is the same for all tasks is to be, at each t, at the reachable point of the smallest mean
    distance; one that knows its task is at the nearest.

    :param tasks: (n, 1) angles
    """
    goals = np.concatenate([np.cos(tasks), np.sin(tasks)], axis=1)
    reach = 0.05 * np.arange(1, POINT_GOAL_STEPS + 1)
    known = -sum(np.linalg.norm(np.maximum(np.abs(goals) - r, 0.0), axis=1).mean() for r in reach)
    places = np.stack(np.meshgrid(np.linspace(-1, 1, 81), np.linspace(0, 1, 41)), axis=-1).reshape(
        -1, 2
    )
    distances = np.linalg.norm(places[:, None, :] - goals, axis=2).mean(axis=1)
    blind = -sum(distances[np.abs(places).max(axis=1) <= r + 1e-9].min() for r in reach)
    return float(blind), float(known)


def assert_same_model(one: PEARLSAC, two: PEARLSAC) -> None:
    """The same weights, tasks, latents, counters, actions and, of POEM, similarities."""
    assert not differing(parameters(one), parameters(two))
    for name, value in vars(one.train_tasks).items():
        assert np.array_equal(value, getattr(two.train_tasks, name)), name
    for name in (
        "num_timesteps",
        "epoch",
        "env_id",
        "horizon",
        "predicted_rewards_error",
        "seed",
        "_n_updates",
    ):
        assert getattr(one, name) == getattr(two, name), name
    latents, obs = (
        np.random.default_rng(1).normal(size=(6, 5)),
        np.random.default_rng(0).normal(size=(6, 2)),
    )
    assert np.array_equal(
        one.predict(obs, latents, deterministic=True)[0],
        two.predict(obs, latents, deterministic=True)[0],
    )
    if isinstance(one, POEMSAC):
        assert np.array_equal(
            one.similarities(latents, latents), two.similarities(latents, latents)
        )
    for source in ("prior", "aggregate"):
        draws = [model.sample_latents(9, np.random.default_rng(4), source) for model in (one, two)]
        assert np.array_equal(*draws)
