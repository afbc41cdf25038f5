"""``predict`` and the policy: SB3's face, with a latent as the state."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch as th
from meta_toys import EPOCH, POINT_GOAL, small, walks
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_poem import PEARLSAC, POEMSAC, AdaptationEvalCallback, PreferenceAdapter, ReturnOracle
from sb3_poem.poem_sac.policies import POEMPolicy

OBS = np.random.default_rng(0).normal(size=(6, 2))


def test_predict_takes_latents_as_state(poem: POEMSAC) -> None:
    latents = np.random.default_rng(1).normal(size=(6, 5))
    actions, state = poem.predict(OBS, state=latents, deterministic=True)
    assert actions.shape == (6, 2)
    assert np.array_equal(state, latents)
    for index in range(6):  # one by one, with a single observation
        action, state = poem.predict(OBS[index], state=latents[index], deterministic=True)
        assert action.shape == (2,)
        np.testing.assert_allclose(action, actions[index], atol=1e-6)
        assert np.array_equal(state, latents[index : index + 1])
        again, _ = poem.predict(
            OBS[index], state=state, deterministic=True
        )  # the state that came back
        assert np.array_equal(again, action)
    assert np.ptp(actions, axis=0).min() > 1e-4


def test_predict_with_one_latent_for_all_and_with_none(poem: POEMSAC) -> None:
    latent = np.random.default_rng(1).normal(size=5)
    for_all, state = poem.predict(OBS, state=latent, deterministic=True)
    expected, _ = poem.predict(OBS, state=np.tile(latent, (6, 1)), deterministic=True)
    np.testing.assert_allclose(for_all, expected, atol=1e-6)
    assert state.shape == (6, 5)
    nothing, state = poem.predict(OBS, deterministic=True)
    prior_mean, _ = poem.predict(OBS, state=np.zeros((6, 5)), deterministic=True)
    np.testing.assert_allclose(nothing, prior_mean, atol=1e-6)
    assert np.array_equal(state, np.zeros((6, 5)))


def test_a_latent_that_is_missing_is_told_once() -> None:
    model = small(POEMSAC)
    told = "without a latent.*PreferenceAdapter.*AdaptationEvalCallback"
    with pytest.warns(UserWarning, match=told) as warned:
        evaluate_policy(model, make_vec_env(POINT_GOAL, 1), n_eval_episodes=2)
    assert len(warned) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.predict(OBS)


def test_what_tells_the_task_is_not_warned_of() -> None:
    model = small(POEMSAC)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.predict(OBS, state=np.zeros(5))
        model.learn(EPOCH, AdaptationEvalCallback(n_tasks=2, record_at=(1,), n_episodes=1))
        env = make_vec_env(POINT_GOAL, 1)
        policy = PreferenceAdapter(model, env, oracle=ReturnOracle(), n_queries=2, seed=0).adapt()
        evaluate_policy(policy, env, n_eval_episodes=1)


def test_predict_is_the_actor(trained: PEARLSAC) -> None:
    """Against the networks put together by hand."""
    latents = np.random.default_rng(1).normal(size=(6, 5))
    policy = trained.policy
    obs = ((th.as_tensor(OBS).float() - policy.obs_norm.mean) / policy.obs_norm.std).clamp(-10, 10)
    embedding = th.as_tensor(latents).float()
    if isinstance(policy, POEMPolicy):
        embedding = policy.policy_mapping(embedding)
    mean = policy.actor.mlp(th.cat([obs, embedding], dim=1))[:, :2]
    actions, _ = trained.predict(OBS, state=latents, deterministic=True)
    np.testing.assert_allclose(actions, th.tanh(mean).detach().numpy(), atol=1e-6)


def test_actions_are_scaled_to_the_environment() -> None:
    model = small(POEMSAC, walks(2), horizon=10)
    latents = np.random.default_rng(1).normal(size=(6, 5))
    actions, _ = model.predict(OBS, state=latents, deterministic=True)
    scaled = model.policy.acting_on(latents)(OBS, None)
    np.testing.assert_allclose(actions, -2.0 + 3.0 * (scaled + 1.0), atol=1e-5)
    np.testing.assert_allclose(model.policy.scale_action(actions), scaled, atol=1e-6)


def test_predict_without_determinism_explores(poem: POEMSAC) -> None:
    many = np.tile(OBS[0], (200, 1))
    th.manual_seed(0)
    actions, _ = poem.predict(many, deterministic=False)
    assert actions.std(axis=0).min() > 0.05
    assert np.abs(actions).max() <= 1.0
    th.manual_seed(0)
    assert np.array_equal(poem.predict(many, deterministic=False)[0], actions)


@pytest.mark.parametrize(
    ("obs", "state", "message"),
    [
        (OBS, np.zeros(4), r"state has shape \(4,\), but a latent is \(5,\), or \(6, 5\)"),
        (OBS, np.zeros((5, 5)), r"state has shape \(5, 5\)"),
        (OBS, np.zeros((6, 4)), r"state has shape \(6, 4\)"),
        (OBS, np.zeros((1, 6, 5)), r"state has shape"),
        (OBS[0], np.zeros((2, 5)), r"state has shape \(2, 5\)"),
        (OBS[:, :1], None, r"observation has shape \(6, 1\), but the policy takes \(2,\)"),
        (np.zeros(3), None, r"observation has shape \(3,\)"),
        (np.where(np.eye(6, 2, -3), np.nan, OBS), None, "observation 3 holds NaN or infinity"),
        (np.where(np.eye(6, 2, -4), np.inf, OBS), None, "observation 4 holds NaN or infinity"),
        (OBS, np.full(5, np.nan), "state .*NaN"),
        (OBS, np.where(np.eye(6, 5, -2), np.nan, 0.0), "state .*NaN"),
    ],
)
def test_predict_refuses(
    poem: POEMSAC, obs: np.ndarray, state: np.ndarray | None, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        poem.predict(obs, state=state)


def test_policy_forward_is_predict_at_the_priors_mean(poem: POEMSAC) -> None:
    scaled = poem.policy(th.as_tensor(OBS), deterministic=True)
    np.testing.assert_allclose(scaled.numpy(), poem.predict(OBS, deterministic=True)[0], atol=1e-6)
