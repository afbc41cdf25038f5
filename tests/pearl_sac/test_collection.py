"""Collection against a plain loop over single environments, and relabelling against environments of
the other tasks.
"""

from __future__ import annotations

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from meta_toys import POINT_GOAL, Poisoned, Walk, walks
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_poem.common.buffers import Segment
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.random import Generators
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.pearl_sac.collector import CollectionStoppedError, EpochCollector, relabelled_returns
from sb3_poem.pearl_sac.train_tasks import TrainTasks


class RandomPolicy:
    """Acts at random; what a collector asks of a policy."""

    device = "cpu"

    def __init__(self, env: VecEnv) -> None:
        self.action_space, self.rng = env.action_space, np.random.default_rng(0)

    def acting_on(self, latents: np.ndarray):  # type: ignore[no-untyped-def]
        shape = (len(latents), *self.action_space.shape)
        return lambda obs, noise: self.rng.uniform(-1.0, 1.0, shape).astype(np.float32)

    def unscale_action(self, scaled: np.ndarray) -> np.ndarray:
        low, high = self.action_space.low, self.action_space.high
        return low + 0.5 * (scaled + 1.0) * (high - low)


def collect(
    env: VecEnv,
    tasks: np.ndarray,
    horizon: int | None = None,
    seed: int = 3,
    on_step=lambda _: True,
    policy: RandomPolicy | None = None,
) -> Segment:
    """A rollout of each task, the copies' seeds from ``seed`` on; it must be what is stored."""
    n, stored, generators = env.num_envs, [], Generators(0)
    generators.integer_seed = lambda: seed
    collector = EpochCollector(
        family=FamilyView.for_training(env, horizon),
        policy=policy or RandomPolicy(env),
        train_tasks=TrainTasks.of_prior(tasks, latent_dim=2),
        replay_buffer=SimpleNamespace(extend=stored.append),
        generators=generators,
        trajectories_per_task=1,
        explores=lambda: False,
        episode_count=lambda: 0,
        on_step=on_step,
    )
    segment = collector.roll_out(np.arange(n), np.arange(2.0 * n).reshape(n, 2))
    assert stored == [segment]
    return segment


def unscaled(segment: Segment, env: VecEnv) -> np.ndarray:
    low, high = env.action_space.low, env.action_space.high
    return low + 0.5 * (segment.actions + 1.0) * (high - low)


@pytest.mark.parametrize("edge", [np.inf, 0.35])
def test_a_segment_is_what_single_environments_give(edge: float) -> None:
    env, tasks = walks(3, steps=10, edge=edge), np.array([[-0.5], [0.0], [1.0]])
    segment = collect(env, tasks, horizon=25)
    assert segment.actions.min() < -0.9
    assert np.abs(segment.actions).max() <= 1.0
    ended_early = 0
    for copy, task in enumerate(tasks):
        single, actions = gym.wrappers.TimeLimit(Walk(edge=edge), 10), unscaled(segment, env)[copy]
        obs, _ = single.reset(seed=3 + copy, options={"task": task})
        first = True
        for step, action in enumerate(actions):
            np.testing.assert_allclose(segment.observations[copy, step], obs, atol=1e-6)
            obs, reward, terminated, truncated, info = single.step(action)
            np.testing.assert_allclose(segment.next_observations[copy, step], obs, atol=1e-6)
            assert segment.rewards[copy, step] == pytest.approx(reward, abs=1e-6)
            assert segment.terminated[copy, step] == terminated
            assert segment.first_episode[copy, step] == first
            np.testing.assert_allclose(
                segment.features[copy, step], info["reward_features"], atol=1e-12
            )
            ended_early += terminated
            if terminated or truncated:
                first = False
                obs, _ = single.reset()
    assert (ended_early > 0) == np.isfinite(edge)
    assert np.array_equal(segment.latents, np.arange(6.0).reshape(3, 2))
    assert segment.task_ids.tolist() == [0, 1, 2]


def test_the_vectorised_and_the_single_environment_give_the_same_segment() -> None:
    tasks = np.array([[0.1], [2.0], [3.0]])
    ours = collect(make_task_vec_env(POINT_GOAL, 3), tasks)
    theirs = collect(make_vec_env(POINT_GOAL, 3), tasks)
    for name in Segment.__dataclass_fields__:
        assert np.array_equal(getattr(ours, name), getattr(theirs, name)), name


def test_a_false_step_ends_the_collection() -> None:
    env, seen = walks(2), []

    def on_step(step_locals: dict) -> bool:
        seen.append(sorted(step_locals["infos"][0])[0])
        return len(seen) < 4

    with pytest.raises(CollectionStoppedError):
        collect(env, np.zeros((2, 1)), horizon=10, on_step=on_step)
    assert len(seen) == 4


@pytest.mark.parametrize("what", ["observations", "rewards", "reward features"])
def test_poison_is_named(what: str) -> None:
    """The second copy fails at step 4 of its second episode."""
    env = DummyVecEnv(
        [
            lambda: gym.wrappers.TimeLimit(Walk(), 6),
            lambda: Poisoned(gym.wrappers.TimeLimit(Walk(), 6), what, episode=1, step=4),
        ]
    )
    with pytest.raises(
        ValueError,
        match=rf"returned {what} that are NaN or infinite: copy 1, training task 1, episode 1, "
        r"step 10: .*Training stops",
    ):
        collect(env, np.zeros((2, 1)), horizon=20)


def test_actions_that_are_not_finite_do_not_reach_the_environment() -> None:
    class Broken(RandomPolicy):
        def acting_on(self, latents: np.ndarray):  # type: ignore[no-untyped-def]
            return lambda obs, noise: np.array([[0.0], [np.nan]], dtype=np.float32)

    env = walks(2)
    with pytest.raises(
        ValueError,
        match=r"actions \(of the policy\) that are NaN or infinite: copy 1, training task 1",
    ):
        collect(env, np.zeros((2, 1)), horizon=10, policy=Broken(env))


# ---------------------------------------------------------------- relabelling


def true_returns(
    env: gym.Env, tasks: np.ndarray, actions: np.ndarray, seeds: list[int]
) -> np.ndarray:
    """(tasks, trajectories): what the first episode earns when each task is stepped."""
    returns = np.zeros((len(tasks), len(actions)))
    for i, task in enumerate(tasks):
        for j, trajectory in enumerate(actions):
            env.reset(seed=seeds[j], options={"task": task})
            for action in trajectory:
                _, reward, terminated, truncated, _ = env.step(action)
                returns[i, j] += reward
                if terminated or truncated:
                    break
    env.close()
    return returns


@pytest.mark.parametrize(
    ("env_id", "steps"), [(POINT_GOAL, 25), ("poem/AntVel-v0", 60), ("poem/HumanoidDir2D-v0", 60)]
)
def test_relabelled_returns_are_what_the_other_tasks_environments_return(
    env_id: str, steps: int
) -> None:
    kwargs = {"max_episode_steps": steps}
    env = make_task_vec_env(env_id, 3, **kwargs)
    tasks = FamilyView(env).sample_tasks(3, np.random.default_rng(0))
    segment = collect(env, tasks, seed=11)
    relabelled = relabelled_returns(
        FamilyView(env).compute_rewards, tasks, segment.features, segment.first_episode
    )
    truth = true_returns(gym.make(env_id, **kwargs), tasks, unscaled(segment, env), [11, 12, 13])
    assert segment.first_episode.all() == (env_id == POINT_GOAL)  # the others fall
    assert np.ptp(truth, axis=0).min() > 1e-3  # the tasks do differ
    np.testing.assert_allclose(relabelled, truth, rtol=1e-6, atol=1e-6)
    own = (segment.rewards * segment.first_episode).sum(axis=1)
    np.testing.assert_allclose(np.diagonal(relabelled), own, rtol=1e-6, atol=1e-6)


def test_relabelling_counts_the_marked_steps_only() -> None:
    env, tasks = walks(3, steps=8, edge=0.35), np.array([[-1.0], [0.0], [1.0]])
    segment = collect(env, tasks, horizon=8)
    assert (~segment.first_episode).any()
    rewards_of = FamilyView(env).compute_rewards
    relabelled = relabelled_returns(rewards_of, tasks, segment.features, segment.first_episode)
    truth = true_returns(
        gym.wrappers.TimeLimit(Walk(edge=0.35), 8), tasks, unscaled(segment, env), [3, 4, 5]
    )
    np.testing.assert_allclose(relabelled, truth, rtol=1e-6)
