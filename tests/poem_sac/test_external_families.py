"""POEMSAC on the families of Meta-World and gymnasium-robotics, briefly."""

import numpy as np
import pytest

from sb3_poem import POEMSAC
from sb3_poem.adaptation import evaluate_episodes
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.pearl_sac.collector import EpochCollector

HORIZON = 8
SMALL = {"net_arch": {"pi": [16], "qf": [16], "encoder": [16], "decoder": [16], "embedding": [8]}}


def make_model(env_id, n_tasks=4, n_envs=4, **env_kwargs):
    env = make_task_vec_env(env_id, n_envs, nthread=1, max_episode_steps=HORIZON, **env_kwargs)
    options = {
        "batch_size": 8,
        "context_size": 8,
        "meta_batch_size": 4,
        "gradient_steps": 2,
        "policy_kwargs": SMALL,
    }
    return POEMSAC("MlpPolicy", env, n_train_tasks=n_tasks, seed=0, **options)


@pytest.mark.parametrize(
    "env_id",
    [pytest.param("poem/MetaWorldML1-v0", marks=pytest.mark.metaworld), "poem/FetchReach-v0"],
)
def test_preferences_are_relabelled_where_dynamics_are_shared(env_id):
    model = make_model(env_id).learn(2 * 4 * HORIZON)
    assert model.num_timesteps == 2 * 4 * HORIZON
    assert model._n_updates > 0
    assert np.isfinite(model.epoch_context.returns.numpy()).all()


@pytest.mark.metaworld
def test_preferences_of_ml10_are_measured_by_rollouts_that_count(monkeypatch):
    """An epoch runs four tasks, and the twelve pairs of the one group, each once; its returns are
    theirs.
    """
    model = make_model("poem/MetaWorldML10-v0")
    returns: dict[tuple[int, int], float] = {}
    collected = EpochCollector.roll_out
    latents: list[np.ndarray] = []

    def record(self, task_ids, given_latents):
        segment = collected(self, task_ids, given_latents)
        if not latents:
            latents.extend(given_latents)  # the epoch's own, one a task
        for row, task in enumerate(task_ids):
            policy = next(
                j for j, latent in enumerate(latents) if np.array_equal(latent, given_latents[row])
            )
            assert (int(task), policy) not in returns, "a pair was measured twice in an epoch"
            returns[int(task), policy] = segment.rewards[row].sum()
        return segment

    monkeypatch.setattr(EpochCollector, "roll_out", record)
    model.learn(16 * HORIZON)
    assert model.num_timesteps == 16 * HORIZON
    expected = np.array([[returns[i, j] for j in range(4)] for i in range(4)])
    assert model.epoch_context.returns.numpy() == pytest.approx(expected, rel=1e-5)


@pytest.mark.metaworld
def test_what_a_deterministic_rollout_measures_is_what_a_single_environment_gives():
    """Returns and successes of one latent in tasks with different dynamics, against a loop over one
    environment.
    """
    import gymnasium as gym

    model = make_model("poem/MetaWorldML10-v0")
    tasks = model.train_tasks.tasks[:3]
    latents = np.random.default_rng(0).standard_normal((3, model.latent_dim))
    outcomes = evaluate_episodes(model, model.env, latents, tasks, n_episodes=1, seed=5)
    env = gym.make("poem/MetaWorldML10-v0", max_episode_steps=HORIZON)
    for i in range(3):
        observation, _ = env.reset(seed=5 + i, options={"task": tasks[i]})
        total, successes, truncated = 0.0, [], False
        while not truncated:
            action, _ = model.predict(
                observation[None], state=latents[i : i + 1], deterministic=True
            )
            observation, reward, _, truncated, info = env.step(action[0])
            total += reward
            successes.append(info["success"])
        assert outcomes.returns[i, 0] == pytest.approx(total, rel=1e-5)
        assert outcomes.successes[i, 0] == any(successes)
