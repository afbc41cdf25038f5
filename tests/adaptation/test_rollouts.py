"""Rollouts in lockstep: what a rollout gives depends on its latent, task and seed alone."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper
from worlds import HORIZON, Blinded, SpeedEnv, SpeedModel, SpeedVecEnv

from sb3_poem import TaskVecEnv
from sb3_poem.adaptation import evaluate_episodes
from sb3_poem.common.rollouts import rollout_episodes, rollout_latents
from sb3_poem.common.vec_env import make_task_vec_env

MODEL = SpeedModel()


class Still:
    """A policy of PointGoal that does nothing."""

    horizon = 25

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 2), dtype=np.float32), state


def rollout_features(*arguments, **options):
    return [seen.reward_features for seen, _ in rollout_episodes(*arguments, **options)]


LATENTS = np.random.default_rng(0).standard_normal((7, 5))


def vec_env(n, **kwargs):
    return DummyVecEnv([lambda: SpeedEnv(**kwargs)] * n)


@pytest.mark.parametrize("copies", [1, 3, 7, 9])
def test_any_number_of_latents_against_any_number_of_copies(copies):
    trajectories = rollout_latents(MODEL, vec_env(copies), LATENTS, seed=5)
    assert len(trajectories) == 7
    for i, trajectory in enumerate(trajectories):
        # One environment by hand is the truth.
        env = SpeedEnv()
        observation, _ = env.reset(seed=5 + i)
        observations, features = [observation], []
        for _ in range(HORIZON):
            action, _ = MODEL.predict(observation, state=LATENTS[i])
            observation, _, _, _, info = env.step(action)
            observations.append(observation)
            features.append(info["reward_features"])
        np.testing.assert_array_equal(trajectory.observations, observations)
        np.testing.assert_array_equal(trajectory.reward_features, features)
        np.testing.assert_array_equal(trajectory.latent, LATENTS[i])
        assert trajectory.frames is None


def test_equal_seeds_start_alike_and_others_do_not():
    first, second, third = rollout_latents(MODEL, vec_env(2), LATENTS[:3], seed=[4, 4, 5])
    np.testing.assert_array_equal(first.observations[0], second.observations[0])
    assert first.observations[0, 0] != third.observations[0, 0]


def test_tasks_are_set_for_the_rollouts():
    env = vec_env(2)
    rollout_latents(MODEL, env, LATENTS[:4], np.array([[0.1], [0.2], [0.3], [0.4]]))
    np.testing.assert_allclose(np.ravel(env.get_attr("task")), [0.3, 0.4])


@pytest.mark.parametrize("kind", [DummyVecEnv, TaskVecEnv])
def test_a_task_that_was_chosen_for_the_next_reset_is_the_one_that_stays(kind):
    env = make_vec_env("poem/PointGoal-v0", 2, vec_env_cls=kind)
    for task in (0.3, 1.5, 2.8):
        for copy in range(2):
            env.env_method("set_task", np.array([task]), indices=[copy])
        for _ in range(2):
            rollout_latents(Still(), env, LATENTS[:3])
            np.testing.assert_array_equal(env.get_attr("task"), [[task], [task]])


@pytest.mark.parametrize("kind", [DummyVecEnv, TaskVecEnv])
def test_seeds_that_an_environment_was_made_with_do_not_reach_the_rollouts(kind):
    starts, tasks = [], []
    for seed in (None, None, 3, 3):  # make_vec_env seeds in any case, by chance if not told how
        env = make_vec_env("poem/PointGoal-v0", 1, vec_env_cls=kind, seed=seed)
        starts += [
            rollout_latents(Still(), env, LATENTS[:1], seed=[0])[0].observations[0]
            for _ in range(2)
        ]
        tasks.append(env.get_attr("task")[0])
    assert np.unique(starts, axis=0).shape == (1, 2)
    assert tasks[2] == tasks[3]
    assert tasks[0] != tasks[1]


@pytest.mark.parametrize("kind", [DummyVecEnv, TaskVecEnv])
def test_the_environments_own_seeds_choose_its_tasks(kind):
    single = gym.make("poem/PointGoal-v0")

    def task_of(seed):
        single.reset(seed=seed)
        return single.unwrapped.task.tolist()

    env = make_vec_env("poem/PointGoal-v0", 1, vec_env_cls=kind, seed=7)
    for rollout_seed, seed in enumerate((7, 5, 6)):  # the first when it is made, the others later
        if seed != 7:
            env.seed(seed)
        rollout_latents(Still(), env, LATENTS[:1], seed=rollout_seed)
        assert env.get_attr("task")[0].tolist() == task_of(seed)
    env.seed(11)
    env.reset()
    assert env.get_attr("task")[0].tolist() == task_of(11)


def test_only_the_first_episode_counts():
    # A fast policy runs out of the world early; its copy starts again, which must leave no trace.
    latents = np.zeros((2, 5))
    latents[:, 0] = [-3.0, 3.0]
    slow, fast = rollout_latents(MODEL, vec_env(2, end_at=2.0), latents, seed=[1, 1])
    assert len(slow) == HORIZON
    assert 1 <= len(fast) < HORIZON
    assert fast.observations[-1, 0] > 2.0
    assert np.all(fast.observations[:-1, 0] <= 2.0)
    features = rollout_features(MODEL, vec_env(3, end_at=2.0), latents, seed=[1, 1])
    np.testing.assert_array_equal(features[1], fast.reward_features)


def test_an_episode_without_end_is_cut():
    class Endless(SpeedEnv):
        def step(self, action):
            observation, reward, _, _, info = super().step(action)
            return observation, reward, False, False, info

    assert len(rollout_latents(MODEL, DummyVecEnv([Endless]), LATENTS[:1])[0]) == HORIZON
    assert len(rollout_latents(MODEL, DummyVecEnv([Endless]), LATENTS[:1], max_steps=50)[0]) == 50


def test_without_reward_features():
    env = DummyVecEnv([lambda: Blinded(SpeedEnv())])
    assert rollout_latents(MODEL, env, LATENTS[:1])[0].reward_features is None
    with pytest.raises(ValueError, match="reward_features"):
        evaluate_episodes(MODEL, env, LATENTS[:1], np.ones((1, 1)), 1)


class Square(SpeedEnv):
    """Its observations have rows and columns."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2, 1), np.float64)

    def reset(self, **arguments):
        observation, info = super().reset(**arguments)
        return observation[:, None], info

    def step(self, action):
        observation, *rest = super().step(action)
        return observation[:, None], *rest


def test_observations_of_any_shape_are_flat_up_to_the_last():
    seen, expected = (
        rollout_latents(MODEL, DummyVecEnv([kind]), LATENTS[:1])[0].observations
        for kind in (Square, SpeedEnv)
    )
    np.testing.assert_array_equal(seen, expected)


class FastFeatures(VecEnvWrapper):
    """As TaskVecEnv: the features as one array, and none in the infos."""

    def __init__(self, venv: VecEnv):
        super().__init__(venv)
        self.last_reward_features = None

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        observations, rewards, dones, infos = self.venv.step_wait()
        self.last_reward_features = np.stack([info.pop("reward_features") for info in infos])
        return observations, rewards, dones, infos


def test_features_as_one_array():
    fast = rollout_features(MODEL, FastFeatures(vec_env(3)), LATENTS)
    np.testing.assert_array_equal(fast, rollout_features(MODEL, vec_env(3), LATENTS))
    in_arrays = rollout_latents(MODEL, SpeedVecEnv(3), LATENTS, seed=3)
    for trajectory, expected in zip(
        in_arrays, rollout_latents(MODEL, vec_env(3), LATENTS, seed=3), strict=True
    ):
        np.testing.assert_array_equal(trajectory.observations, expected.observations)
        np.testing.assert_array_equal(trajectory.reward_features, expected.reward_features)


class DrawsItsTask(SpeedEnv):
    """As poem_envs' families: a reset with a seed draws the task, until one is set."""

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self._next_task = np.random.default_rng(seed).uniform(0, 3, size=1)
        return super().reset(seed=seed, options=options)


def test_the_environments_own_task_stays():
    env = DrawsItsTask()
    env.reset(seed=3)
    task = env.task.copy()
    venv = DummyVecEnv([lambda: env])
    trajectories = rollout_latents(MODEL, venv, LATENTS, seed=5)
    np.testing.assert_array_equal(env.task, task)
    for expected, trajectory in zip(
        rollout_latents(MODEL, vec_env(7), LATENTS, seed=5), trajectories, strict=True
    ):
        np.testing.assert_array_equal(trajectory.observations, expected.observations)


def test_the_task_of_a_vectorised_family_stays():
    env = make_task_vec_env("poem/PointGoal-v0", 2)
    env.seed(3)
    env.reset()
    tasks = env.tasks.copy()

    class Still:
        horizon = 25

        def predict(self, observations, state, deterministic):
            return np.zeros((len(observations), 2), np.float32), state

    trajectories = rollout_latents(Still(), env, LATENTS[:3], seed=[8, 8, 9])
    np.testing.assert_array_equal(env.tasks, tasks)
    np.testing.assert_array_equal(trajectories[0].observations, trajectories[1].observations)
    assert trajectories[0].reward_features.shape == (25, 2)
    single = DummyVecEnv([lambda: gym.make("poem/PointGoal-v0")])
    expected = rollout_latents(Still(), single, LATENTS[:1], seed=[8])[0]
    np.testing.assert_array_equal(trajectories[0].observations, expected.observations)


def test_frames():
    frames = rollout_latents(MODEL, vec_env(1, render_mode="rgb_array"), LATENTS[:2], frames=True)[
        1
    ].frames
    assert (
        len(frames) == HORIZON
    )  # the reset and every step but the last, after which the next episode has begun
    assert frames[0].shape == (16, 16, 3)
    third = rollout_latents(MODEL, vec_env(1, render_mode="rgb_array"), LATENTS[:2], frames=3)[
        1
    ].frames
    np.testing.assert_array_equal(third, frames[::3])
    with pytest.raises(ValueError, match="render_mode"):
        rollout_latents(MODEL, vec_env(1), LATENTS[:1], frames=True)
    with pytest.raises(ValueError, match="frames"):
        rollout_latents(MODEL, vec_env(1, render_mode="rgb_array"), LATENTS[:1], frames=-1)


def test_stochastic_actions_are_reproducible_and_leave_torch_alone():
    class Noisy(SpeedModel):
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            actions, state = super().predict(observation, state)
            noise = 0.0 if deterministic else 0.1 * torch.randn(actions.shape).numpy()
            return np.clip(actions + noise, -1, 1), state

    state = torch.get_rng_state()
    first, second = (
        rollout_latents(Noisy(), vec_env(3), LATENTS, seed=2, deterministic=False) for _ in range(2)
    )
    assert torch.equal(torch.get_rng_state(), state)
    np.testing.assert_array_equal(first[4].actions, second[4].actions)
    assert not np.array_equal(
        first[0].actions, rollout_latents(Noisy(), vec_env(3), LATENTS, seed=2)[0].actions
    )


@pytest.mark.parametrize("culprit", ["observation", "action"])
def test_an_episode_that_is_not_finite_is_named(culprit):
    class BrokenEnv(SpeedEnv):
        def step(self, action):
            observation, *rest = super().step(action)
            return (
                observation * np.nan if self._time == 4 and observation[1] > 1.5 else observation
            ), *rest

    class BrokenModel(SpeedModel):
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            actions, state = super().predict(observation, state)
            return np.where(observation[:, 1:] > 1.5, np.nan, actions), state

    latents = np.zeros((5, 5))
    latents[:, 0] = [-1.0, -1.0, -1.0, 1.0, -1.0]
    env, model = (
        (DummyVecEnv([BrokenEnv] * 2), MODEL)
        if culprit == "observation"
        else (vec_env(2), BrokenModel())
    )
    with pytest.raises(ValueError, match=f"an {culprit} of episode 3 at step"):
        rollout_latents(model, env, latents)


@pytest.mark.parametrize(
    ("latents", "arguments", "message"),
    [
        (np.zeros(5), {}, "`latents` must have shape"),
        (np.full((2, 5), np.nan), {}, "`latents` must be finite"),
        (np.zeros((2, 5)), {"tasks": np.zeros((3, 1))}, "`tasks` must have shape"),
        (np.zeros((2, 5)), {"seed": [1]}, "`seed` must be one integer"),
        (np.zeros((2, 5)), {"max_steps": 0}, "`max_steps` must be at least 1"),
    ],
)
def test_bad_arguments(latents, arguments, message):
    with pytest.raises(ValueError, match=message):
        rollout_latents(MODEL, vec_env(1), latents, **arguments)
