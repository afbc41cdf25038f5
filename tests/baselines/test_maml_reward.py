"""MAML-reward's policy: SAC on a reward that is known, within the budget, and reproducible."""

import copy

import numpy as np
import pytest
import torch as th
from meta_toys import WindyWalk, small, walks
from worlds import SpeedEnv, SpeedModel

from sb3_poem import PEARLSAC, MAMLReward, PreferenceAdapter
from sb3_poem.adaptation import AdaptedPolicy, Preference, ReturnOracle, adapt_tasks
from sb3_poem.baselines import MAMLRewardModel, MetaReward
from sb3_poem.common.rollouts import rollout_latents

FAST = MAMLReward(gradient_steps=5, batch_size=16)


@pytest.fixture(scope="module")
def trained():
    return small(PEARLSAC, walks(5), horizon=10, n_train_tasks=5, learning_starts=10**6).learn(
        2 * 50
    )


@pytest.fixture
def model(trained):
    return MAMLRewardModel(MetaReward(trained.policy, (8,)), trained)


def test_it_learns_a_reward_that_it_is_told(trained, model, monkeypatch):
    # The adapted reward is replaced by the true one, "as far to the right as can be"; what is left
    # is SAC.
    monkeypatch.setattr(
        MetaReward, "rewards", lambda self, parameters, trajectory: trajectory.observations[1:, 0]
    )
    rule = MAMLReward(gradient_steps=80, batch_size=64, learning_rate=3e-3, gamma=0.9)
    adapted = adapt_tasks(
        model,
        walks(2),
        np.ones((1, 1)),
        ReturnOracle,
        n_queries=4,
        record_at=(0, 4),
        rule=rule,
    )
    before, after = (
        t.observations[-1, 0] for t in rollout_latents(model, walks(2), adapted.latents[0])
    )
    # The furthest that ten steps can go is 4, from a start near 0.
    assert after > 3.0 > before


def test_pairs_differ_and_the_budget_is_kept(model):
    adapter = PreferenceAdapter(
        model, walks(1), n_queries=2, seed=0, oracle=lambda left, right: "left", rule=FAST
    )
    query = adapter.ask()
    assert np.abs(query.left.actions - query.right.actions).max() > 0.01
    adapter.adapt()
    assert adapter.inference.sac.replay_buffer.size() == 2 * 2 * 10
    assert adapter.done


def test_the_state_resumes_and_the_generators_stay(model):
    env = walks(1)
    adapter = PreferenceAdapter(
        model, env, n_queries=3, seed=0, oracle=lambda left, right: "left", rule=FAST
    )
    adapter.ask()
    states = np.random.get_state()[1].copy(), th.random.get_rng_state()  # noqa: NPY002
    adapter.tell("left")
    np.testing.assert_array_equal(np.random.get_state()[1], states[0])  # noqa: NPY002
    assert th.equal(th.random.get_rng_state(), states[1])
    resumed = PreferenceAdapter.from_json(
        adapter.to_json(), model, env, oracle=lambda left, right: "left"
    )
    obs = np.random.default_rng(0).normal(size=(6, 2))
    first, second = (one.adapt().predict(obs)[0] for one in (adapter, resumed))
    np.testing.assert_allclose(first, second, atol=1e-5)
    start = PreferenceAdapter(model, env, n_queries=3, seed=0, rule=FAST).policy().predict(obs)[0]
    assert np.abs(first - start).max() > 1e-3


def test_answers_that_are_taken_back_and_given_again_keep_nothing_more(model):
    adapter = PreferenceAdapter(model, walks(1), n_queries=3, seed=0, rule=FAST)
    adapter.ask()
    adapter.tell("left")
    told, kept = adapter.policy(), len(model.actors)
    for _ in range(2):
        adapter.undo()
        adapter.tell("left")
    assert len(model.actors) == kept
    np.testing.assert_array_equal(adapter.policy().latent, told.latent)


def test_a_pending_question_is_shown_again_by_a_model_that_was_made_anew(model, monkeypatch):
    shown = PreferenceAdapter(model, walks(1), n_queries=3, seed=0, rule=FAST)
    first = shown.ask()
    shown.tell("left")
    query = shown.ask()
    monkeypatch.setattr(
        "sb3_poem.adaptation.adapter.PreferenceAdapter._needs_frames", property(lambda self: True)
    )
    monkeypatch.setattr(
        "sb3_poem.adaptation.adapter.rollout_latents",
        lambda *a, frames, **k: rollout_latents(*a, **k),
    )
    resumed = PreferenceAdapter.from_json(
        shown.to_json(), MAMLRewardModel(model.reward, model), walks(1)
    )
    again = resumed.ask()
    np.testing.assert_array_equal(again.left.actions, query.left.actions)
    np.testing.assert_array_equal(again.right.actions, query.right.actions)
    np.testing.assert_array_equal(resumed.ask_again(0).left.actions, first.left.actions)


def test_another_reward_does_not_go_on_where_this_one_stood(model):
    begun = PreferenceAdapter(model, walks(1), n_queries=3, seed=0, rule=FAST)
    assert (
        repr(begun)
        == "PreferenceAdapter(MAMLRewardModel, MAMLReward(gradient_steps=5, batch_size=16), 0 of 3 answers)"
    )
    reward = copy.deepcopy(model.reward)
    other = MAMLRewardModel(reward, model)
    assert other.digest == model.digest
    reward.parameters = {name: value + 0.1 for name, value in reward.parameters.items()}
    with pytest.raises(
        ValueError, match="saved with a model of other weights than this MAMLRewardModel"
    ):
        PreferenceAdapter.from_json(begun.to_json(), other, walks(1))


def test_what_will_not_do(trained, model):
    with pytest.raises(
        ValueError, match="`model` must be a MAMLRewardModel, but is of type SpeedModel"
    ):
        PreferenceAdapter(SpeedModel(), SpeedEnv(), rule=FAST)
    with pytest.raises(ValueError, match="a family whose tasks share their dynamics"):
        PreferenceAdapter(model, walks(1, WindyWalk), rule=FAST)
    with pytest.raises(TypeError, match="a policy of MAMLRewardModel has no file"):
        AdaptedPolicy(model, np.zeros(2)).to_bytes()
    with pytest.raises(ValueError, match="`gradient_steps` must be at least 1, but is 0"):
        MAMLReward(gradient_steps=0)
    with pytest.raises(ValueError, match=r"`gamma` must be at most 1, but is 1.5"):
        MAMLReward(gamma=1.5)
    with pytest.raises(ValueError, match="`learning_rate` must be above 0, but is"):
        MAMLReward(learning_rate=0.0)
    with pytest.raises(ValueError, match="`library` must be None"):
        adapt_tasks(model, walks(1), np.zeros((1, 1)), ReturnOracle, rule=FAST, library=[])
    inference = PreferenceAdapter(model, walks(1), rule=FAST).inference
    with pytest.raises(ValueError, match="needs the trajectories"):
        inference.tell(Preference.LEFT, *inference.ask())
    assert inference.answers == []
