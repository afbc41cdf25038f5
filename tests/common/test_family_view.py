"""What an environment must be to meta-train on it."""

from __future__ import annotations

import functools

import gymnasium as gym
import numpy as np
import pytest
from meta_toys import POINT_GOAL, OtherWalk, TwoWalks, Walk, WindyWalk, walks
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

from poem_envs import GoalFamily
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.vec_env import make_task_vec_env


def test_reads_a_family() -> None:
    family = FamilyView.for_training(make_vec_env(POINT_GOAL, 2))
    assert (family.env_id, family.horizon, family.num_envs) == (POINT_GOAL, 25, 2)
    assert (family.task_dim, family.reward_feature_dim, family.shared_dynamics) == (1, 2, True)
    assert family.all_tasks is None
    assert FamilyView.for_training(walks(1, TwoWalks), 10).all_tasks.tolist() == [[-1.0], [1.0]]
    assert not FamilyView.for_training(walks(1, WindyWalk), 10).shared_dynamics


@pytest.mark.parametrize(
    "wrap", [lambda env: env, VecMonitor, lambda env: VecMonitor(VecMonitor(env))]
)
@pytest.mark.parametrize(
    "make", [lambda: make_vec_env(POINT_GOAL, 3), lambda: make_task_vec_env(POINT_GOAL, 3)]
)
def test_tasks_reach_the_copies_and_features_come_back(make, wrap) -> None:  # type: ignore[no-untyped-def]
    env = wrap(make())
    family, tasks = FamilyView.for_training(env), np.array([[0.5], [1.0], [3.0]])
    first = family.reset(tasks, seed=4)
    assert np.array_equal(env.get_attr("task"), tasks)
    _, rewards, _, infos = env.step(np.ones((3, 2), dtype=np.float32))
    features = family.features_of(infos)
    goals = np.stack([np.cos(tasks[:, 0]), np.sin(tasks[:, 0])], axis=1)
    np.testing.assert_allclose(rewards, -np.linalg.norm(features - goals, axis=1), rtol=1e-6)
    np.testing.assert_allclose(family.compute_rewards(tasks, features), rewards, rtol=1e-6)
    assert np.array_equal(family.reset(tasks, seed=4), first)
    assert not np.array_equal(family.reset(tasks, seed=5), first)


def test_tasks_come_from_the_generator_that_is_given() -> None:
    family, own = FamilyView(make_vec_env(POINT_GOAL, 1)), gym.make(POINT_GOAL).unwrapped
    drawn = (each.sample_tasks(4, np.random.default_rng(0)) for each in (family, own))
    assert np.array_equal(*drawn)


def test_how_an_environment_is_drawn_is_no_argument_of_the_family() -> None:
    drawn = {"render_quality": "fast", "camera_name": "track", "max_geom": 2000}
    env = make_task_vec_env("poem/HalfCheetahVel-v0", 1, ctrl_cost_weight=0.0, **drawn)
    assert FamilyView(env).env_kwargs == {"ctrl_cost_weight": 0.0}


# ---------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    "vec_env_class", [DummyVecEnv, functools.partial(SubprocVecEnv, start_method="fork")]
)
def test_an_environment_that_is_no_family(vec_env_class) -> None:  # type: ignore[no-untyped-def]
    env = vec_env_class([functools.partial(gym.make, "Pendulum-v1")])
    try:
        with pytest.raises(
            ValueError, match=r"env <.*<Pendulum-v1>.*> is no task family.*TaskFamily.*GoalFamily"
        ):
            FamilyView.for_training(env)
    finally:
        env.close()


def test_the_horizon_must_be_known_and_agree() -> None:
    with pytest.raises(
        ValueError, match=r"horizon is unknown: .*max_episode_steps, or pass horizon"
    ):
        FamilyView.for_training(DummyVecEnv([Walk]))
    assert FamilyView.for_training(DummyVecEnv([Walk]), 10).horizon == 10
    assert FamilyView.for_training(walks(1)).horizon == 10  # its TimeLimit's
    with pytest.raises(
        ValueError,
        match="horizon is 30, but the environment ends episodes after 25 steps; they must agree",
    ):
        FamilyView.for_training(make_vec_env(POINT_GOAL, 1), 30)
    assert FamilyView.for_training(make_vec_env(POINT_GOAL, 1), 25).horizon == 25


def test_the_horizon_of_a_goal_family_is_that_of_its_environment() -> None:
    family = GoalFamily("gymnasium_robotics:FetchReach-v4")
    assert FamilyView.for_training(DummyVecEnv([lambda: family])).horizon == 50


@pytest.mark.parametrize("horizon", [0, -5])
def test_the_horizon_must_be_positive(horizon: int) -> None:
    with pytest.raises(ValueError, match=rf"`horizon` must be at least 1.*{horizon}"):
        FamilyView.for_training(walks(1), horizon)


def test_another_family_is_told_apart() -> None:
    family = FamilyView.for_training(walks(1), 10)
    family.check_same_family(Walk.task_space, 2)
    with pytest.raises(
        ValueError, match=r"trained for tasks in .*Pass an environment of the model's own family"
    ):
        family.check_same_family(OtherWalk.task_space, 2)
    with pytest.raises(ValueError, match="own family"):
        family.check_same_family(Walk.task_space, 3)
