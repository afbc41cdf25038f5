"""Which environments PEARLSAC and POEMSAC take, as SB3's SAC does."""

from __future__ import annotations

import functools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from meta_toys import (
    EPOCH,
    N_TASKS,
    POINT_GOAL,
    Walk,
    WindyWalk,
    assert_same_model,
    differing,
    experience_of,
    parameters,
    small,
    walks,
)
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

from poem_envs import TaskFamilyVector
from sb3_poem import PEARLSAC, POEMSAC, AdaptationEvalCallback
from sb3_poem.common.vec_env import TaskVecEnv, make_task_vec_env

OBS = np.random.default_rng(0).normal(size=(6, 2))


@pytest.mark.parametrize(
    "make_env",
    [
        pytest.param(lambda: POINT_GOAL, id="id"),
        pytest.param(lambda: gym.make(POINT_GOAL), id="single"),
        pytest.param(lambda: Monitor(gym.make(POINT_GOAL)), id="monitor"),
        pytest.param(lambda: make_vec_env(POINT_GOAL, 5), id="dummy"),
        pytest.param(
            lambda: VecMonitor(DummyVecEnv([functools.partial(gym.make, POINT_GOAL)] * 5)),
            id="vec-monitor",
        ),
        pytest.param(
            lambda: make_vec_env(POINT_GOAL, 5, vec_env_cls=TaskVecEnv), id="task-vec-env"
        ),
        pytest.param(lambda: make_task_vec_env(POINT_GOAL, 30), id="more-copies-than-tasks"),
    ],
)
def test_any_number_of_environments(make_env: Any) -> None:
    """Copies that do not divide the tasks: the last wave is filled up, and the steps count."""
    model = small(POEMSAC, make_env()).learn(1)
    n_envs = model.env.num_envs
    waves = -(-N_TASKS // n_envs)
    assert model.num_timesteps == waves * n_envs * 25
    assert model.n_envs == n_envs
    counts = model.replay_buffer.counts
    assert counts.sum() == model.num_timesteps
    assert counts.min() == 25 * (waves * n_envs // N_TASKS)
    assert len(model.ep_info_buffer) == min(100, waves * n_envs)
    assert model._n_updates == 5
    # the stored transitions are the tasks' own
    for task in range(N_TASKS):
        stored = experience_of(model.replay_buffer, task)
        expected = model.family.compute_rewards(
            model.train_tasks.tasks[task], stored.features.numpy()
        )
        np.testing.assert_allclose(stored.rewards.numpy(), expected, atol=1e-5)


def make_vec(n: int, **kwargs: Any) -> gym.vector.VectorEnv:
    return gym.make_vec(POINT_GOAL, n, **kwargs)


@pytest.mark.parametrize("mode", ["vector_entry_point", "sync"])
def test_gymnasiums_vectorised_environment(mode: str) -> None:
    """A family's own, and copies that are stepped one after another."""
    arguments = {"vectorization_mode": mode, "max_episode_steps": 5}
    model = small(POEMSAC, make_vec(3, step_length=0.2, **arguments)).learn(N_TASKS * 5)
    same = small(
        POEMSAC,
        make_vec_env(POINT_GOAL, 3, env_kwargs={"step_length": 0.2, "max_episode_steps": 5}),
    )
    assert_same_model(model, same.learn(N_TASKS * 5))
    assert isinstance(model.env, TaskVecEnv if mode == "vector_entry_point" else DummyVecEnv)
    assert model.horizon == 5
    assert model.env_kwargs["step_length"] == 0.2
    callback = AdaptationEvalCallback(n_tasks=2, record_at=(1,), n_episodes=1)
    model.learn(1, callback)  # makes copies of it
    model.set_env(make_vec(2, **arguments))
    assert model.n_envs == 2


def test_a_vectorised_environment_that_is_not_registered() -> None:
    env = TaskFamilyVector(Walk, num_envs=2, nthread=1, max_episode_steps=9)
    assert small(POEMSAC, env, horizon=9).learn(1).num_timesteps == N_TASKS * 9


@pytest.mark.parametrize(
    "make",
    [
        lambda: gym.make_vec("CartPole-v1", 2),
        lambda: gym.vector.AsyncVectorEnv([functools.partial(gym.make, POINT_GOAL)]),
        lambda: gym.wrappers.vector.RecordEpisodeStatistics(make_vec(2)),
    ],
    ids=["CartPoleVectorEnv", "AsyncVectorEnv", "RecordEpisodeStatistics"],
)
def test_other_vectorised_environments(make: Any, request: pytest.FixtureRequest) -> None:
    env = make()
    with pytest.raises(
        ValueError,
        match=rf"env is a {type(env).__name__}, but must be gym.make_vec\(id, n\) of a task family",
    ):
        small(POEMSAC, env)
    env.close()


@pytest.mark.parametrize(("family", "n_envs"), [(Walk, 5), (WindyWalk, 5)])
def test_an_epoch_has_as_many_steps_as_it_says(
    algorithm: type[PEARLSAC], family: type[Walk], n_envs: int
) -> None:
    model = small(algorithm, walks(n_envs, family), horizon=10, n_train_tasks=7)
    assert model.learn(1).num_timesteps == model.epoch_steps


def test_set_env_takes_an_id() -> None:
    model = small(POEMSAC, make_vec_env(POINT_GOAL, 2))
    model.set_env(POINT_GOAL)
    assert isinstance(model.env, TaskVecEnv)
    assert model.n_envs == 2
    with pytest.raises(TypeError, match="env is None, but must be an environment"):
        model.set_env(None)


def test_subprocesses() -> None:
    env = SubprocVecEnv([functools.partial(gym.make, POINT_GOAL)] * 2, start_method="fork")
    try:
        model = small(POEMSAC, env).learn(EPOCH)
        same = small(POEMSAC, DummyVecEnv([functools.partial(gym.make, POINT_GOAL)] * 2)).learn(
            EPOCH
        )
        assert not differing(parameters(model), parameters(same))
    finally:
        env.close()


def test_early_ends_and_unsymmetric_actions() -> None:
    model = small(POEMSAC, walks(4, edge=0.4), horizon=10).learn(240)
    assert model.num_timesteps == 240
    terminated = th.cat(
        [experience_of(model.replay_buffer, task).terminated for task in range(N_TASKS)], dim=1
    )
    assert 0 < terminated.sum() < terminated.numel()
    assert model._episode_num > 24
    actions, _ = model.predict(OBS, deterministic=False)
    assert (actions >= -2.0).all()
    assert (actions <= 4.0).all()


def test_the_toys_are_environments() -> None:
    check_env(Walk(edge=0.4))
