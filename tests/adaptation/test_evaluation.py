"""Evaluation against closed forms and brute force, and what ten answers reach on a family whose
limit is known.
"""

import itertools
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from scipy.stats import kendalltau
from stable_baselines3.common.vec_env import DummyVecEnv
from worlds import HORIZON, SpeedEnv, SpeedModel, SpeedVecEnv

from sb3_poem import Bayes, Paper
from sb3_poem.adaptation import (
    MistakeOracle,
    Preference,
    ReturnOracle,
    adapt_tasks,
    evaluate_adaptation,
    evaluate_episodes,
    known_task_return,
    property_one,
)
from sb3_poem.adaptation.evaluation import evaluation_seed
from sb3_poem.adaptation.known_task import preference_order, return_matrix
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.loading import load_model

MODEL = SpeedModel()
GOALS = np.linspace(0.05, 2.95, 30)[:, None]


def vec_env(n=10, **kwargs):
    return DummyVecEnv([lambda: SpeedEnv(**kwargs)] * n)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: property_one(np.zeros((2, 3)), np.zeros((3, 2))), "must have the same shape"),
        (
            lambda: (
                evaluate_episodes(MODEL, vec_env(1), np.zeros((2, 5)), np.zeros((3, 1))).returns
            ),
            "equally many rows",
        ),
        (
            lambda: (
                evaluate_episodes(MODEL, vec_env(1), np.zeros((2, 5)), np.ones((2, 1)), 0).returns
            ),
            "`n_episodes` must be",
        ),
        (lambda: known_task_return(MODEL, vec_env(1), GOALS, 0), "`n_latents` must be at least 1"),
        (
            lambda: known_task_return(MODEL, vec_env(1), GOALS[:, 0]),
            r"`tasks` must have shape \(n_tasks, 1\) with at least one task, but has shape \(",
        ),
        (
            lambda: known_task_return(MODEL, vec_env(1), GOALS, selection_episodes=0),
            "`selection_episodes` must be at least 1",
        ),
        (
            lambda: evaluate_adaptation(MODEL, vec_env(1), GOALS, record_at=()),
            "`record_at` must hold",
        ),
        (
            lambda: evaluate_adaptation(MODEL, vec_env(1), GOALS, record_at=2),
            "`record_at` must hold at least one whole number, but is 2",
        ),
        (
            lambda: evaluate_adaptation(MODEL, vec_env(1), GOALS, record_at=(-1, 2)),
            "`record_at` must be at least 0",
        ),
        (
            lambda: evaluate_adaptation(MODEL, vec_env(1), GOALS, record_at=(0, 2.5)),
            "`record_at` must be a whole number",
        ),
        (
            lambda: evaluate_adaptation(MODEL, vec_env(1), GOALS, n_episodes=2.5),
            "`n_episodes` must be a whole number",
        ),
    ],
)
def test_bad_arguments(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(
    "factory",
    [
        ReturnOracle(),
        MistakeOracle(0.1),
        "return",
        None,
        lambda left, right: Preference.LEFT,
        lambda task: None,
    ],
)
def test_an_oracle_in_place_of_what_makes_oracles(factory):
    with pytest.raises(
        TypeError,
        match=r"`oracle_factory` must be called as oracle_factory\(env=.*the class ReturnOracle",
    ):
        evaluate_adaptation(MODEL, vec_env(1), GOALS, factory)


def test_names_and_numbers_of_tasks_will_do():
    """Held-out tasks, which the seed draws: those of the command line, and the same for both
    functions.
    """
    result = evaluate_adaptation(
        "PointGoal", "poem/PointGoal-v0", 3, record_at=(0, 2), n_episodes=1, seed=4
    )
    env = make_task_vec_env("poem/PointGoal-v0", 4)
    np.testing.assert_array_equal(result.tasks, FamilyView(env).test_tasks(3, 4))
    model = load_model("PointGoal", "cpu")
    again = evaluate_adaptation(model, env, result.tasks, record_at=(0, 2), n_episodes=1, seed=4)
    np.testing.assert_allclose(again.returns, result.returns, atol=1e-4)
    known = known_task_return(
        "PointGoal",
        gym.make_vec("poem/PointGoal-v0", 4),
        n_latents=8,
        n_episodes=1,
        seed=4,
        limits=False,
    )
    assert known.tasks.shape == (30, 1)
    np.testing.assert_array_equal(known.tasks[:3], result.tasks)
    returns = evaluate_episodes(
        "PointGoal", gym.make("poem/PointGoal-v0"), result.latents[:, 1], result.tasks, 1, 7
    ).returns
    assert returns.shape == (3, 1)


@pytest.mark.parametrize("copies", [1, 4, 40])
def test_returns_are_the_true_ones(copies):
    latents = np.random.default_rng(0).standard_normal((6, 5))
    returns = evaluate_episodes(MODEL, vec_env(copies), latents, GOALS[:6], n_episodes=3).returns
    assert returns.shape == (6, 3)
    expected = -200 * np.abs(MODEL.speed(latents) - GOALS[:6, 0])
    np.testing.assert_allclose(returns, np.tile(expected[:, None], 3), rtol=1e-5)


def test_early_ends_count_up_to_the_end():
    latents = np.array([[0.0] * 5, [2.0, 0, 0, 0, 0]])
    returns = evaluate_episodes(
        MODEL, vec_env(3, end_at=1.5), latents, np.zeros((2, 1)), n_episodes=20
    ).returns
    steps = returns / (-10 * MODEL.speed(latents))[:, None]
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-4)  # whole steps
    assert steps.min() < HORIZON <= steps.max() + 1e-6


def test_the_matrix_by_relabelling_is_that_by_rolling_out():
    latents = np.random.default_rng(1).standard_normal((4, 5))
    relabelled = return_matrix(MODEL, vec_env(5), GOALS[::10], latents, n_episodes=2)

    class OwnDynamics(SpeedEnv):
        shared_dynamics = False

    rolled_out = return_matrix(
        MODEL, DummyVecEnv([OwnDynamics] * 5), GOALS[::10], latents, n_episodes=2
    )
    expected = -200 * np.abs(GOALS[::10] - MODEL.speed(latents)[None, :])
    np.testing.assert_allclose(relabelled, expected, rtol=1e-4)
    np.testing.assert_allclose(rolled_out, expected, rtol=1e-4)


def test_known_task_return():
    known = known_task_return(MODEL, SpeedVecEnv(30), GOALS, n_latents=100, n_episodes=2)
    assert known.returns.shape == (30, 2)
    assert known.candidate_returns.shape == (30, 100)
    gaps = np.abs(MODEL.speed(known.latents) - GOALS[:, 0])
    np.testing.assert_allclose(known.returns[:, 0], -200 * gaps, atol=1e-3)
    tried = np.abs(MODEL.speed(known.candidate_latents)[None, :] - GOALS).min(axis=1)
    assert (gaps <= tried + 1e-6).all()  # refined it is as good as the best that was tried
    assert gaps.mean() < 0.5 * tried.mean()
    assert known.limit(0) < known.limit(1) < known.limit(3) <= known.limit(10) + 1e-9
    accuracy, tau = preference_order(MODEL, known)
    # This model's S keeps the order exactly; what is missing is the gap between a task and its best
    # candidate.
    assert 0.99 < accuracy <= 1.0
    assert 0.98 < tau <= 1.0


def test_known_task_return_of_policies_that_act_at_random():
    noisy, by_mode = (
        known_task_return(
            "PointGoal", "poem/PointGoal-v0", 2, 4, 2, deterministic=mode, limits=False
        )
        for mode in (False, True)
    )
    assert not np.array_equal(noisy.returns, by_mode.returns)
    assert not np.array_equal(noisy.candidate_returns, by_mode.candidate_returns)


def test_winners_are_measured_on_fresh_episodes():
    class Lucky(SpeedEnv):
        """Returns are luck, drawn at the reset."""

        def step(self, action):
            observation, reward, terminated, truncated, _ = super().step(action)
            return (
                observation,
                reward,
                terminated,
                truncated,
                {"reward_features": np.array([self._luck])},
            )

        def reset(self, **kwargs):
            result = super().reset(**kwargs)
            self._luck = self.np_random.normal()
            return result

        @staticmethod
        def compute_rewards(tasks, features):
            return features[..., 0] + 0.0 * tasks[..., 0]

    known = known_task_return(
        MODEL, DummyVecEnv([Lucky] * 10), GOALS[:3], n_latents=100, n_episodes=50, limits=False
    )
    assert known.candidate_returns.max() > 1.5 * HORIZON  # the best of a hundred draws
    assert abs(known.mean_return) < 0.5 * HORIZON
    env = DummyVecEnv([Lucky] * 10)
    several = [known_task_return(MODEL, env, GOALS[:3], 20, 1, seed) for seed in range(2)]
    best = np.mean([one.candidate_returns.max() for one in several])
    assert best > 1.2 * HORIZON
    assert np.mean([one.limit(10) for one in several]) < 0.6 * best  # nor does a limit live on luck


def test_property_one_against_scipy():
    rng = np.random.default_rng(0)
    returns = np.round(rng.normal(size=(5, 8)), 1)
    similarities = returns + 0.5 * rng.normal(size=(5, 8))
    right = total = 0
    for s, j in zip(similarities, returns, strict=True):
        for a, b in itertools.combinations(range(8), 2):
            if j[a] != j[b]:
                total += 1
                right += (s[a] > s[b]) == (j[a] > j[b])
    accuracy, tau = property_one(similarities, returns)
    assert accuracy == pytest.approx(right / total)
    assert tau == pytest.approx(
        np.mean([kendalltau(s, j).statistic for s, j in zip(similarities, returns, strict=True)])
    )
    assert property_one(np.zeros((2, 3)), returns[:2, :3])[0] == 0.5
    assert np.isnan(property_one(np.zeros((2, 3)), np.zeros((2, 3)))[0])


@pytest.mark.parametrize("likelihood", ["decoder", "similarity"])
def test_the_bayesian_rule_is_near_the_information_limit(likelihood):
    record_at = (0, 1, 2, 3, 5, 10)
    result = evaluate_adaptation(
        MODEL,
        SpeedVecEnv(60),
        GOALS,
        ReturnOracle,
        record_at=record_at,
        n_episodes=1,
        seed=1,
        rule=Bayes(likelihood=likelihood),
    )
    assert result.returns.shape == (30, 6, 1)
    for k in record_at:
        limit = -150 / 2**k
        assert limit - 12 <= result.after(k) <= limit + 8  # thirty tasks are not the whole line
    data = result.to_dict()
    assert data["queries"] == list(record_at)
    np.testing.assert_allclose(np.mean(data["task_returns"], axis=0), data["mean_return"])
    assert len(data["answers"][0]) == 10
    with pytest.raises(ValueError, match="not after 4"):
        result.after(4)


def test_random_answers_find_nothing():
    class Coin:
        def __init__(self, env, task, seed):
            self.rng = np.random.default_rng(seed)

        def __call__(self, left, right):
            return (Preference.LEFT, Preference.RIGHT)[self.rng.integers(2)]

    result = evaluate_adaptation(
        MODEL, SpeedVecEnv(30), GOALS[::2], Coin, record_at=(2, 5), n_episodes=1, seed=1
    )
    # Without information about the goal -150 is the best there is, by always going at 1.5.
    assert np.all(result.mean_returns < -130)


def test_mistakes_cost_less_under_the_bayesian_rule_than_under_the_papers():
    returns = {}
    for name, rule in {"bayes": Bayes(), "paper": Paper()}.items():
        result = evaluate_adaptation(
            MODEL,
            SpeedVecEnv(20),
            GOALS[::3],
            partial(MistakeOracle, 0.1),
            record_at=(10,),
            seed=1,
            rule=rule,
        )
        returns[name] = result.after(10)
    assert returns["bayes"] > returns["paper"]
    assert returns["bayes"] > -35


def test_evaluation_is_reproducible():
    runs = [
        evaluate_adaptation(
            MODEL, SpeedVecEnv(n), GOALS[:3], record_at=(2,), n_episodes=2, seed=4
        ).returns
        for n in (3, 3, 7)
    ]
    np.testing.assert_array_equal(runs[0], runs[1])
    np.testing.assert_allclose(runs[0], runs[2], rtol=1e-6)


def test_each_measurement_is_told_as_it_comes_and_changes_nothing():
    tasks, told = GOALS[::12], []
    measured = evaluate_adaptation(
        MODEL, vec_env(4), tasks, record_at=(0, 1, 3), n_episodes=2, on_record=told.append
    )
    assert [one.record_at for one in told] == [(0,), (0, 1), (0, 1, 3)]
    assert [len(one.preferences[0]) for one in told] == [0, 1, 3]
    adapted = adapt_tasks(MODEL, vec_env(4), tasks, ReturnOracle, n_queries=3, record_at=(0, 1, 3))
    np.testing.assert_array_equal(measured.latents, adapted.latents)
    assert measured.preferences == adapted.preferences
    for n, one in enumerate(told, 1):
        np.testing.assert_array_equal(one.returns, measured.returns[:, :n])
        alone = evaluate_episodes(
            MODEL, vec_env(4), adapted.latents[:, n - 1], tasks, 2, evaluation_seed(0)
        ).returns
        np.testing.assert_array_equal(one.returns[:, -1], alone)
