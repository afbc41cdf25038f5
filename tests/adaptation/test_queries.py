"""Query rules against brute force, and the noise models against integration."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import norm

from sb3_poem.adaptation.noise import (
    BoltzmannNoise,
    ExactNoise,
    MistakeNoise,
    NoiseModel,
    People,
    noise_model_from_dict,
)
from sb3_poem.adaptation.queries import (
    best_pair,
    information_gains,
    most_telling_pair,
    most_telling_set,
    pair_differences,
    random_set,
    tolerance,
    worst_case_pair,
    worst_case_sizes,
)


def test_the_tolerance_widens_the_half_space():
    # eq. 9 literally: exp(S') / (exp(S') + exp(S'')) >= 1/2 - epsilon
    for epsilon in (0.0, 0.1, 0.3, 0.49):
        edge = -tolerance(epsilon)
        assert math.isclose(1.0 / (1.0 + math.exp(-edge)), 0.5 - epsilon, abs_tol=1e-12)
    assert tolerance(0.0) == 0.0


@given(
    seed=st.integers(0, 10_000),
    m=st.integers(1, 12),
    n=st.integers(2, 7),
    epsilon=st.sampled_from([0.0, 0.1, 0.4]),
)
@settings(max_examples=60)
def test_eq_10_against_brute_force(seed, m, n, epsilon):
    similarities = np.random.default_rng(seed).normal(size=(m, n))

    def survives(z, better, worse):
        odds = math.exp(similarities[z, better]) / (
            math.exp(similarities[z, better]) + math.exp(similarities[z, worse])
        )
        return odds >= 0.5 - epsilon

    sizes = [
        max(sum(survives(z, i, j) for z in range(m)), sum(survives(z, j, i) for z in range(m)))
        for i, j in itertools.combinations(range(n), 2)
    ]
    np.testing.assert_array_equal(worst_case_sizes(similarities, epsilon), sizes)
    pair = worst_case_pair(similarities, epsilon)
    assert pair == list(itertools.combinations(range(n), 2))[int(np.argmin(sizes))]
    weighted = worst_case_sizes(similarities, epsilon, np.full(m, 0.5))
    np.testing.assert_allclose(weighted, 0.5 * np.array(sizes))


def test_information_gain_is_the_mutual_information():
    rng = np.random.default_rng(0)
    probabilities, weights = rng.random((5, 3)), rng.dirichlet(np.ones(5))
    for question in range(3):
        joint = np.stack(
            [weights * probabilities[:, question], weights * (1 - probabilities[:, question])]
        )
        independent = joint.sum(axis=1, keepdims=True) * joint.sum(axis=0, keepdims=True)
        expected = np.sum(joint * np.log(joint / independent))
        assert math.isclose(
            information_gains(probabilities.T, weights)[question], expected, abs_tol=1e-12
        )
    assert information_gains(np.array([[1.0, 0.0]]), np.array([0.5, 0.5]))[0] == pytest.approx(
        math.log(2)
    )


def test_the_most_informative_pair_splits_and_can_be_told_apart():
    # Latents on a line, fitness -|goal - speed|. Speeds 0.50 and 0.52 halve the latents too, but
    # look the same.
    goals, speeds = np.linspace(0, 1, 101), np.array([0.0, 0.5, 0.52, 1.0])
    values = -np.abs(goals[:, None] - speeds[None, :])
    weights = np.full(101, 1 / 101)
    chances = ExactNoise().probability_left(pair_differences(values), 0.1, 1.0)
    assert best_pair(information_gains(chances, weights), 4) == (0, 3)
    gains = information_gains(np.full((1, 101), 0.5), weights)
    assert gains[0] == pytest.approx(0.0, abs=1e-12)  # two policies that do the same


@pytest.mark.parametrize("visible", [{}, {(0, 3): 0.0}, {(0, 3): 0.5}])
def test_what_people_can_hardly_see_costs_information(visible):
    goals, speeds = np.linspace(0, 1, 101), np.array([0.0, 0.5, 0.52, 1.0])
    values = -np.abs(goals[:, None] - speeds[None, :])
    weights, looked = np.full(101, 1 / 101), []
    noise = ExactNoise()

    def visibility(first, second):
        looked.append((first, second))
        return visible.get((first, second), 1.0)

    chances = noise.probability_left(pair_differences(values), 0.1, 1.0)
    gains = information_gains(chances, weights)
    pairs = list(itertools.combinations(range(4), 2))
    worth = [gain * visible.get(pair, 1.0) for gain, pair in zip(gains, pairs, strict=True)]
    assert best_pair(gains, 4, visibility) == pairs[int(np.argmax(worth))]
    assert looked[0] == (0, 3)
    assert (len(looked) == 1) == (not visible)  # a pair that is seen well needs no other
    assert len(looked) < 6  # none that could not be better


def test_the_most_telling_pair_is_that_of_the_most_mutual_information():
    rng = np.random.default_rng(1)
    differences = np.linspace(-8, 8, 2001)
    cuts = np.array([-3.0, -1.0, 1.0, 3.0])
    above = norm.sf((cuts[:, None] - differences) / 0.3)
    probabilities = -np.diff(np.vstack([np.ones(2001), above, np.zeros(2001)]), axis=0)
    for _ in range(5):
        values, weights = rng.normal(scale=2.0, size=(40, 6)).clip(-4, 4), rng.dirichlet([1] * 40)
        gains = {}
        for i, j in itertools.combinations(range(6), 2):
            places = np.rint((values[:, i] - values[:, j] + 8) / 0.008).astype(int)
            joint = weights * probabilities[:, places] + 1e-30  # (answers, latents)
            independent = joint.sum(axis=1, keepdims=True) * joint.sum(axis=0, keepdims=True)
            gains[i, j] = np.sum(joint * np.log(joint / independent))
        found = most_telling_pair(values, weights, differences, probabilities)
        assert gains[found] == pytest.approx(max(gains.values()), rel=1e-4)


@pytest.mark.parametrize("noise", [None, MistakeNoise(0.2), BoltzmannNoise(0.3)])
def test_people_answer_as_they_are_simulated(noise):
    people = People("graded", noise)
    assert people.log_prior.size == len(people)
    assert np.exp(people.log_prior).sum() == pytest.approx(1.0)
    g, d, spread = len(people) // 2 + 1, 9.0, 10.0
    said = people.probabilities(np.array([d, -d]), 1e-6, 1.0, spread)[:, :, g]
    np.testing.assert_allclose(said.sum(axis=0), 1.0)
    np.testing.assert_allclose(said[:, 0], said[::-1, 1])
    rng = np.random.default_rng(0)
    if isinstance(noise, BoltzmannNoise):
        perceived = d + rng.logistic(scale=1 / 0.3, size=100_000)
    else:
        perceived = d + spread * people.doubts[g] * rng.logistic(scale=1 / 1.702, size=100_000)
    perceived *= np.where(rng.random(100_000) < people.mistakes[g], -1.0, 1.0)
    counts = np.bincount(np.digitize(perceived, spread * people.thresholds[g]), minlength=5)
    np.testing.assert_allclose(said[:, 0], 0.99 * counts / 100_000 + 0.002, atol=0.006)


@pytest.mark.parametrize("noise", [None, MistakeNoise(0.2), BoltzmannNoise(0.3)])
def test_people_choose_the_best_as_they_are_simulated(noise):
    people, values, n = People("best-of-four", noise), np.array([3.0, -2.0, 5.0, 4.0]), 200_000
    differences = values[:1] - values[1:]
    said = people.probabilities(differences[None], 2.0, 1.0, 10.0)[::-1, 0]  # (5, G), EQUAL last
    np.testing.assert_allclose(said.sum(axis=0), 1.0)
    error = 1 / 0.3 * np.sqrt(1 + np.pi / 8 * 0.6**2)
    rng = np.random.default_rng(0)
    for g in range(len(people)):
        if not isinstance(noise, BoltzmannNoise):
            error = np.hypot(2.0, 10.0 * people.doubts[g]) / 1.702
        # Gumbel errors: who is ahead of all others, each handicapped by the width
        perceived = values + rng.gumbel(scale=error, size=(n, 4))
        ahead = np.sort(perceived)[:, -1] - np.sort(perceived)[:, -2]
        best = np.argmax(perceived, axis=1)
        wrong = rng.random(n) < people.mistakes[g]
        best[wrong] = (best[wrong] + rng.integers(1, 4, size=wrong.sum())) % 4
        if -people.thresholds[g, 0] == 0.0:
            counts = np.append(np.bincount(best, minlength=4), 0)
            np.testing.assert_allclose(said[:, g], 0.99 * counts / n + 0.002, atol=0.005)
        else:  # Luce's rule with a width is another family of errors, near this one
            assert abs(said[4, g] - np.mean(ahead < 10.0 * people.thresholds[g, -1])) < 0.06


@pytest.mark.parametrize("noise", [None, MistakeNoise(0.2), BoltzmannNoise(0.3)])
def test_the_best_of_two_is_a_pair(noise):
    two, pair = People("best-of-four", noise), People("pair", noise)
    np.testing.assert_array_equal(two.log_prior, pair.log_prior)
    about = np.linspace(-9, 9, 7), 2.0, 4.0, 10.0
    np.testing.assert_allclose(two.probabilities(*about), pair.probabilities(*about)[[1, 0, 2]])


def test_what_is_added_to_a_pair_adds_the_most_mutual_information():
    people, rng = People("best-of-four", MistakeNoise(0.1)), np.random.default_rng(2)
    values, weights = rng.normal(size=(30, 7)), rng.dirichlet([1] * 30)

    def said(differences):
        return people.probabilities(differences, 0.2, 1.0, 1e-9)[:, :, 0]

    def told(chosen):
        """Nats, of exact choice by Luce's rule, by hand."""
        odds = np.exp(1.702 / 0.2 * values[:, chosen])
        best = odds / odds.sum(axis=1, keepdims=True)
        best = 0.9 * best + 0.1 * (1 - best) / (len(chosen) - 1)
        p = np.column_stack([np.zeros(30), best]) * 0.99 + 0.01 / (len(chosen) + 1)
        joint, marginal = weights[:, None] * p, weights @ p
        return np.sum(joint * np.log(p / marginal))

    chosen = most_telling_set((2, 5), 4, values, weights, said)
    assert chosen[:2] == (2, 5)
    assert len(set(chosen)) == 4
    third = {j: told([2, 5, j]) for j in range(7) if j not in (2, 5)}
    assert chosen[2] == max(third, key=third.get)
    fourth = {j: told([*chosen[:3], j]) for j in third if j != chosen[2]}
    assert chosen[3] == max(fourth, key=fourth.get)


def test_random_pairs_differ_and_cover():
    rng = np.random.default_rng(0)
    pairs = {random_set(3, 2, rng) for _ in range(100)}
    assert pairs == {(i, j) for i in range(3) for j in range(3) if i != j}


@pytest.mark.parametrize("error", [0.3, 2.0])
def test_exact_noise_averages_a_step_over_the_error(error):
    x = np.linspace(-6, 6, 25)
    probability = ExactNoise().probability_left(x, error, 1.0)
    np.testing.assert_allclose(
        probability, norm.cdf(x / error), atol=0.016
    )  # logistic for probit, and the lapse


@pytest.mark.parametrize(("beta", "magnitude"), [(0.7, 1.0), (None, 4.0)])
def test_boltzmann_noise_averages_a_logistic_over_the_error(beta, magnitude):
    slope = 1 / magnitude if beta is None else beta
    for difference in (-5.0, -0.5, 0.0, 2.0):
        expected, _ = quad(
            lambda d, centre=difference: norm.pdf(d, centre, 1.5) / (1 + math.exp(-slope * d)),
            -20,
            20,
        )
        value = BoltzmannNoise(beta).probability_left(np.array(difference), 1.5, magnitude)
        assert float(value) == pytest.approx(expected, abs=0.015)


def test_mistakes_bound_what_an_answer_says():
    probability = MistakeNoise(0.2).probability_left(np.array([-1e9, 0.0, 1e9]), 1.0, 1.0)
    np.testing.assert_allclose(probability, [0.2, 0.5, 0.8], atol=0.01)


@pytest.mark.parametrize(
    "noise", [ExactNoise(), MistakeNoise(0.1), BoltzmannNoise(), BoltzmannNoise(2.0)]
)
def test_noise_models_survive_json_and_never_say_never(noise):
    assert noise_model_from_dict(noise.to_dict()) == noise
    probability = noise.probability_left(np.array([-np.inf, -1e300, 0.0, 1e300, np.inf]), 0.0, 0.0)
    assert np.all((probability > 0) & (probability < 1))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: MistakeNoise(0.6), "`rate` must be at most"),
        (lambda: BoltzmannNoise(0.0), "`beta` must be above 0"),
        (lambda: BoltzmannNoise(float("nan")), "`beta` must be a finite number"),
        (
            lambda: noise_model_from_dict({"kind": "gaussian"}),
            "unknown noise model 'gaussian'; known are",
        ),
    ],
)
def test_bad_noise_models(make, message):
    with pytest.raises(ValueError, match=message):
        make()


class Step(NoiseModel):
    def probability_above(self, difference, error, magnitude):
        return difference > 0


def test_a_noise_model_may_say_never_or_always():
    probability = Step().probability_left(np.array([-1.0, 1.0]), 1.0, 1.0)
    np.testing.assert_allclose(probability, [0.005, 0.995])


def test_whole_numbers_are_as_good_as_real_ones() -> None:
    difference = np.array([-3, 0, 5])
    expected = ExactNoise().probability_left(difference.astype(np.float64), 2.0, 1.0)
    np.testing.assert_allclose(ExactNoise().probability_left(difference, 2.0, 1.0), expected)
    assert expected[0] < 0.5 < expected[2]
