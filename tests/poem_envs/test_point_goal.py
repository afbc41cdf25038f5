"""PointGoal against its closed form."""

import gymnasium as gym
import numpy as np
import pytest

import poem_envs  # noqa: F401 (registers)


def test_moves_and_rewards():
    env = gym.make("poem/PointGoal-v0")
    position, _ = env.reset(seed=0, options={"task": [0.7]})
    goal = np.array([np.cos(0.7), np.sin(0.7)])
    for action in ([1.0, 0.5], [-0.2, 1.0], [0.0, 0.0]):
        expected = position + 0.05 * np.array(action)
        position, reward, *_, info = env.step(np.array(action, dtype=np.float32))
        assert position == pytest.approx(expected)
        assert np.array_equal(info["reward_features"], position)
        assert reward == pytest.approx(-np.linalg.norm(expected - goal))


def test_start():
    env = gym.make("poem/PointGoal-v0").unwrapped
    starts = np.array([env.reset(seed=seed)[0] for seed in range(2000)])
    assert starts.mean(axis=0) == pytest.approx(0.0, abs=0.002)
    assert starts.std(axis=0) == pytest.approx(0.02, rel=0.06)


def test_arguments():
    env = gym.make("poem/PointGoal-v0", step_length=0.5, reset_noise_scale=0.0)
    assert np.array_equal(env.reset(seed=0)[0], [0.0, 0.0])
    assert env.step(np.array([1.0, -1.0]))[0] == pytest.approx([0.5, -0.5])


def test_the_horizon_lets_every_goal_be_reached():
    env = gym.make("poem/PointGoal-v0", reset_noise_scale=0.0)
    for angle in np.linspace(0, np.pi, 7):
        position, _ = env.reset(options={"task": [angle]})
        goal, truncated, steps = np.array([np.cos(angle), np.sin(angle)]), False, 0
        while not truncated:
            action = np.clip((goal - position) / 0.05, -1, 1)
            position, reward, _, truncated, _ = env.step(action)
            steps += 1
        assert steps == 25
        assert reward == pytest.approx(0.0, abs=1e-9)
