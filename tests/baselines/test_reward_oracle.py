"""The reward oracle against the contexts of training, and on an encoder whose posterior is known."""

import numpy as np
import pytest
import torch as th
from meta_toys import small, walks
from stable_baselines3.common.vec_env import DummyVecEnv
from worlds import SpeedEnv, SpeedModel

from sb3_poem import PEARLSAC, POEMSAC, PreferenceAdapter, RewardOracle
from sb3_poem.adaptation import Preference, ReturnOracle, adapt_tasks


def sighted(model, env, **arguments):
    return PreferenceAdapter(model, env, rule=RewardOracle(), **arguments)


@pytest.fixture(scope="module")
def trained():
    return small(PEARLSAC, walks(5), horizon=10, n_train_tasks=5).learn(2 * 50)


def test_contexts_are_those_of_training(trained):
    # The rows that it makes of a trajectory equal those that training made of the same transitions.
    env = walks(1)
    adapter = sighted(trained, env, n_queries=1, seed=0)
    env.env_method("set_task", np.array([0.3]))
    query = adapter.ask()
    adapter.tell(Preference.EQUAL)
    rows = adapter.inference.transitions
    assert rows.shape == (20, 6)
    centre, deviation = trained.context_reward_statistics
    rewards = trained.epoch_context.rewards.numpy()
    assert (centre, deviation) == pytest.approx((rewards.mean(), rewards.std(ddof=1)), rel=1e-5)
    np.testing.assert_allclose(
        trained.epoch_context.transitions[..., -1].numpy(),
        (rewards - centre) / deviation,
        atol=1e-5,
    )
    features = query.left.reward_features
    true_rewards = -np.abs(features[:, 0] - 0.3) - 0.01 * features[:, 1] ** 2
    np.testing.assert_allclose(rows[:10, -1], (true_rewards - centre) / deviation, atol=1e-5)
    mean, std = trained.policy.obs_norm.mean.numpy(), trained.policy.obs_norm.std.numpy()
    np.testing.assert_allclose(
        rows[:10, :2], (query.left.observations[:-1] - mean) / std, atol=1e-4
    )
    np.testing.assert_allclose(
        rows[:10, 2], (query.left.actions[:, 0] - 1.0) / 3.0, atol=1e-5
    )  # from [-2, 4] to [-1, 1]
    with th.no_grad():
        expected, _ = trained.policy.encoder(th.as_tensor(rows)[None])
    np.testing.assert_allclose(adapter.policy().latent, expected[0].numpy(), atol=1e-5)


def test_before_any_rollout_it_is_the_prior(trained):
    adapter = sighted(trained, walks(1), seed=0)
    np.testing.assert_array_equal(adapter.policy().latent, np.zeros(5))
    draws = np.concatenate([adapter.inference.ask() for _ in range(2000)])
    np.testing.assert_allclose(draws.mean(axis=0), 0, atol=0.1)
    np.testing.assert_allclose(draws.std(axis=0), 1, atol=0.1)


def test_answers_do_not_matter_and_many_tasks_are_as_one(trained):
    task = np.array([0.5])
    latents = []
    for answer in ("left", "right"):
        env = walks(1)
        env.env_method("set_task", task)
        adapter = sighted(trained, env, n_queries=3, seed=4)
        while not adapter.done:
            adapter.ask()
            adapter.tell(answer)
        latents.append(adapter.policy().latent)
    np.testing.assert_array_equal(*latents)
    many = adapt_tasks(
        trained,
        walks(4),
        np.array([[-0.5], [0.5]]),
        ReturnOracle,
        n_queries=3,
        seed=3,
        rule=RewardOracle(),
    )
    np.testing.assert_allclose(many.latents[1, -1], latents[0], atol=1e-4)


def test_the_state_resumes_after_saving_the_model(trained, tmp_path):
    env = walks(1)
    env.env_method("set_task", np.array([0.5]))
    adapter = sighted(trained, env, n_queries=3, seed=0, oracle=ReturnOracle())
    adapter.ask()
    adapter.tell("left")
    trained.save(tmp_path / "model.zip")
    model = PEARLSAC.load(tmp_path / "model.zip", device="cpu")
    resumed = PreferenceAdapter.from_json(adapter.to_json(), model, env, oracle=ReturnOracle(env))
    np.testing.assert_allclose(resumed.adapt().latent, adapter.adapt().latent, atol=1e-5)


class RewardEncoder(th.nn.Module):
    """The Gaussian whose mean is the mean standardised reward of the context, and whose variance
    falls as 1 / n.
    """

    def forward(self, context):
        mean = context[..., -1].mean(dim=1, keepdim=True).expand(-1, 5)
        return mean, th.full_like(mean, 1.0 / context.shape[1])


def test_the_posterior_is_that_of_all_rewarded_trajectories(trained, monkeypatch):
    monkeypatch.setattr(trained.policy, "encoder", RewardEncoder())
    env = walks(1)
    env.env_method("set_task", np.array([-0.5]))
    adapter = sighted(trained, env, n_queries=10, seed=1)
    centre, deviation = trained.context_reward_statistics
    rewards = []
    for k in range(1, 11):
        query = adapter.ask()
        for shown in (query.left, query.right):
            features = shown.reward_features
            rewards.append(
                (-np.abs(features[:, 0] + 0.5) - 0.01 * features[:, 1] ** 2 - centre) / deviation
            )
        adapter.tell("equal")
        # A context has no more than context_size transitions, as in training.
        n = min(20 * k, trained.context_size)
        np.testing.assert_allclose(adapter.inference.variance, 1 / n, rtol=1e-5)
        assert len(adapter.inference.transitions) == 20 * k
        if 20 * k % n == 0:  # all that there are fill contexts, and none is left out
            np.testing.assert_allclose(adapter.policy().latent, np.mean(rewards), rtol=1e-4)
    assert n == trained.context_size == 25


def test_it_may_begin_with_the_training_tasks_latents(trained):
    adapter = PreferenceAdapter(trained, walks(1), rule=RewardOracle(candidates="aggregate"))
    draws = np.concatenate([adapter.inference.ask() for _ in range(4000)])
    own = trained.sample_latents(20_000, np.random.default_rng(0), source="aggregate")
    assert np.abs(own.mean(axis=0)).max() + np.abs(own.std(axis=0) - 1).max() > 0.1  # not N(0, I)
    np.testing.assert_allclose(draws.mean(axis=0), own.mean(axis=0), atol=0.25)
    np.testing.assert_allclose(draws.std(axis=0), own.std(axis=0), rtol=0.2)
    with pytest.raises(ValueError, match="`candidates` must be one of"):
        RewardOracle(candidates="posterior")


def test_what_will_not_do(trained):
    untrained = small(PEARLSAC, walks(2), horizon=10, n_train_tasks=2)
    with pytest.raises(ValueError, match="train it for an epoch first"):
        sighted(untrained, walks(1))
    poem = small(POEMSAC, walks(2), horizon=10, n_train_tasks=2)
    with pytest.raises(ValueError, match="this POEMSAC's context also holds values"):
        sighted(poem, walks(1))
    with pytest.raises(ValueError, match="needs a context encoder, which SpeedModel does not have"):
        sighted(SpeedModel(), SpeedEnv())
    with pytest.raises(ValueError, match="`n_queries` must be at least 1"):
        sighted(trained, walks(1), n_queries=0)
    with pytest.raises(ValueError, match="needs the trajectories"):
        sighted(trained, walks(1)).inference.tell(Preference.LEFT, np.zeros(5), np.zeros(5))
    with pytest.raises(ValueError, match="`library` must be None"):
        adapt_tasks(
            trained,
            walks(1),
            np.zeros((1, 1)),
            ReturnOracle,
            rule=RewardOracle(),
            library=[],
        )

    class NoFamily(SpeedEnv):
        observation_space = trained.observation_space
        action_space = trained.action_space
        shared_dynamics = property()

    with pytest.raises(ValueError, match="is no task family"):
        sighted(trained, DummyVecEnv([NoFamily]))
