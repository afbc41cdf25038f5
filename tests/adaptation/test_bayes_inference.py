"""The Bayesian rule against the posterior on a grid."""

import math
from dataclasses import replace
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from scipy.special import ndtr, ndtri
from worlds import HORIZON, STEP_WEIGHT, TOP_SPEED, SpeedEnv, SpeedModel

from sb3_poem import set_task
from sb3_poem.adaptation import MistakeOracle, PreferenceAdapter, ReturnOracle
from sb3_poem.adaptation.bayes import (
    DECODED_STEPS,
    ERROR_CORRELATION,
    SIMILARITY_RESOLUTION,
    Bayes,
    fit_thinning,
)
from sb3_poem.adaptation.decisions import decide, standard_scores
from sb3_poem.adaptation.noise import LAPSE, BoltzmannNoise, ExactNoise, MistakeNoise
from sb3_poem.adaptation.paper import Paper
from sb3_poem.adaptation.particles import (
    elliptical_slice_moves,
    fit_gaussian,
    kernel_neighbours,
    systematic_resample,
)
from sb3_poem.adaptation.preference import ANSWERS as ANSWERS_OF
from sb3_poem.adaptation.preference import Preference, preference_log_likelihood
from sb3_poem.adaptation.priors import AggregatePrior, GaussianPrior
from sb3_poem.adaptation.rule import Setting
from sb3_poem.common.rollouts import rollout_latents
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.common.vec_env import make_task_vec_env

LEFT, RIGHT, EQUAL = Preference.LEFT, Preference.RIGHT, Preference.EQUAL


def at_speed(model, speed, latent=None):
    """An episode at a constant speed."""
    observations = np.column_stack([np.zeros(HORIZON + 1), np.full(HORIZON + 1, speed)])
    z = np.zeros(model.latent_dim) if latent is None else latent
    return Trajectory(observations, np.zeros((HORIZON, 1)), z)


def make(model=None, seed=0, library=None, **options):
    rule, model = Bayes(**options), model or SpeedModel()
    setting = Setting(library=library)
    rule.check(model, setting)
    return rule.start(model, np.random.default_rng(seed), setting)


def crowd(inference, speed):
    """Have most particles stand where the answers to come are likely: then none is moved, and the
    weights alone change.
    """
    inference.particles[len(inference.particles) // 3 :] = ndtri(speed / TOP_SPEED)
    return inference.particles.copy()


def logistic(x):
    return 1 / (1 + np.exp(-x))


ANSWERS = [(LEFT, 2.0, 1.0), (RIGHT, 2.6, 1.4), (EQUAL, 2.5, 1.3)]


@pytest.mark.parametrize(
    ("noise", "probability"),
    [
        (ExactNoise(), lambda d, m, e: LAPSE / 2 + (1 - LAPSE) * logistic(1.702 * d / e)),
        (
            MistakeNoise(0.1),
            lambda d, m, e: 0.1 + 0.8 * (LAPSE / 2 + (1 - LAPSE) * logistic(1.702 * d / e)),
        ),
        (
            BoltzmannNoise(),
            lambda d, m, e: (
                LAPSE / 2
                + (1 - LAPSE) * logistic(d / m / math.sqrt(1 + math.pi / 8 * (e / m) ** 2))
            ),
        ),
    ],
)
def test_the_decoders_likelihood_is_the_direct_formula(noise, probability):
    model = SpeedModel()
    inference = make(model, noise_model=noise, n_particles=50)
    particles = crowd(inference, 1.8)
    for preference, left, right in ANSWERS:
        inference.tell(preference, at_speed(model, left), at_speed(model, right))
    np.testing.assert_array_equal(inference.particles, particles)
    error = model.predicted_rewards_error * math.sqrt(2 * HORIZON * ERROR_CORRELATION)
    for z, weight in zip(inference.particles, inference.log_weights, strict=True):
        goal, expected = 3 * ndtr(z[0]), 0.0
        for preference, left, right in ANSWERS:
            r_left, r_right = (
                -STEP_WEIGHT * HORIZON * abs(speed - goal) for speed in (left, right)
            )
            p = probability(r_left - r_right, abs(r_left) + abs(r_right), error)
            expected += {
                LEFT: math.log(p),
                RIGHT: math.log(1 - p),
                EQUAL: 0.5 * math.log(p * (1 - p)),
            }[preference]
        assert weight == pytest.approx(expected, rel=1e-6)
    assert inference.weights.sum() == pytest.approx(1.0)


MUCH_LEFT, MUCH_RIGHT = Preference.MUCH_LEFT, Preference.MUCH_RIGHT


@pytest.mark.parametrize(
    ("question", "noise"), [("graded", "infer"), ("graded", MistakeNoise(0.1)), ("pair", "infer")]
)
@pytest.mark.parametrize("likelihood", ["decoder", "similarity"])
def test_latent_and_person_have_a_joint_posterior(question, noise, likelihood):
    """Against the sum over all people of the product of their answers' probabilities."""
    model = SpeedModel()
    options = {"question": question, "noise_model": noise, "likelihood": likelihood}
    inference = make(model, n_particles=30, **options)
    particles = crowd(inference, 1.95)
    strongest = MUCH_LEFT if question == "graded" else LEFT
    told = [(strongest, 1.9, 0.3), (RIGHT, 2.6, 1.4), (EQUAL, 2.5, 1.9), (LEFT, 1.5, 2.9)]
    shown = []
    for preference, *speeds in told:
        pair = [at_speed(model, v, np.full(5, ndtri(v / 3))) for v in speeds]
        inference.tell(preference, *pair)
        shown.append(pair)
    np.testing.assert_array_equal(inference.particles, particles)
    people, spread = inference.people, inference.scale[0]
    if likelihood == "decoder":
        cross, square = inference.calibration[:2]
        spread *= cross / square
    expected = np.zeros((30, len(people)))
    for i, z in enumerate(inference.particles):
        for (preference, *_), pair in zip(told, shown, strict=True):
            if likelihood == "decoder":
                left, right = model.predicted_returns(z[None], pair)[0]
                error = model.predicted_rewards_error * math.sqrt(2 * HORIZON * ERROR_CORRELATION)
            else:
                left, right = model.similarities(z[None], np.stack([t.latent for t in pair]))[0]
                error = inference.scale[1] * 1.702
            doubts = np.hypot(error, spread * people.doubts)

            def above(cut, difference=left - right, doubts=doubts):
                return logistic(1.702 * (difference - spread * cut) / doubts)

            equal = people.thresholds[:, people.thresholds.shape[1] // 2]
            much = people.thresholds[:, -1] if question == "graded" else np.inf
            of_left = above(equal) - above(much), 1 - above(-equal) - (1 - above(-much))
            straight, turned = {
                MUCH_LEFT: (above(much), 1 - above(-much)),
                LEFT: of_left,
                RIGHT: of_left[::-1],
                EQUAL: (above(-equal) - above(equal),) * 2,
            }[preference]
            p = (1 - people.mistakes) * straight + people.mistakes * turned
            kinds = 5 if question == "graded" else 3
            expected[i] += np.log((1 - LAPSE) * p + LAPSE / kinds)
    joint = np.exp(expected + people.log_prior)
    if likelihood == "similarity":
        weights = joint.sum(axis=1)
        np.testing.assert_allclose(inference.weights, weights / weights.sum(), rtol=5e-3)
        shares = joint.sum(axis=0) / joint.sum()
        np.testing.assert_allclose(inference.people_shares, shares, atol=1e-3)
    else:  # S was tied to returns anew by each answer, so the spread differed a little
        weights = joint.sum(axis=1)
        assert np.corrcoef(np.log(weights), inference.log_weights)[0, 1] > 0.98


@pytest.mark.parametrize("noise", [ExactNoise(), MistakeNoise(0.1), BoltzmannNoise()])
def test_the_best_of_four_on_point_goal_against_enumeration(noise):
    """The posterior over particles after each of three answers, from formulas alone."""
    task = np.array([2.0])  # the goal's angle
    env = gym.make("poem/PointGoal-v0")
    set_task(env, task)
    oracle = ReturnOracle(env, task, question="best-of-four")
    rule = Bayes(300, question="best-of-four", noise_model=noise)
    adapter = PreferenceAdapter("PointGoal", env, rule=rule, n_queries=3, seed=0)
    inference, model = adapter.inference, adapter.model
    inference._rejuvenate = lambda: None  # the weights alone
    widths = np.array([0.0, 0.12, 0.4])
    joint = np.tile(np.log([0.4, 0.4, 0.2]), (300, 1))
    while not adapter.done:
        query = adapter.ask()
        answer = oracle(*query.shown)
        best = ["first", "second", "third", "fourth"].index(answer.value)
        adapter.tell(answer)
        values = model.predicted_returns(inference.particles, query.shown)
        cross, square = inference.calibration[:2]
        spread = inference.scale[0] * cross / square
        error = model.predicted_rewards_error * math.sqrt(2 * 25 * ERROR_CORRELATION)
        if isinstance(noise, BoltzmannNoise):
            beta = 1 / (2 * np.abs(values).mean(axis=1, keepdims=True))
            slope = beta / np.sqrt(1 + np.pi / 8 * (beta * error) ** 2)
        else:
            slope = 1.702 / error
        odds = np.exp(slope * (values - values.max(axis=1, keepdims=True)))
        handicap = np.exp(slope * spread * widths)
        winner = np.stack([odds[:, i, None] for i in range(4)])  # (4, m, 1)
        p = winner / (winner + handicap * (odds.sum(axis=1)[None, :, None] - winner))
        rate = getattr(noise, "rate", 0.0)
        p = (1 - rate) * p[best] + rate / 3 * (p.sum(axis=0) - p[best])
        joint += np.log((1 - LAPSE) * p + LAPSE / 5)
        expected = np.exp(joint).sum(axis=1)
        np.testing.assert_allclose(inference.weights, expected / expected.sum(), rtol=0.02)
    goal = np.array([np.cos(task[0]), np.sin(task[0])])
    near = np.linalg.norm(_ends(model, inference.particles) - goal, axis=1) < 0.35
    grew = inference.weights[near].sum() / near.mean()
    assert grew > (1.05 if isinstance(noise, BoltzmannNoise) else 2.5)


def _ends(model, latents):
    """(m, 2) where PointGoal's policies come to."""
    env = make_task_vec_env("poem/PointGoal-v0", 50)
    clips = rollout_latents(model, env, latents, None, [0] * len(latents), True)
    return np.stack([clip.observations[-1] for clip in clips])


@pytest.mark.parametrize("question", ["pair", "graded", "best-of-four"])
def test_who_answers_is_found_out(question):
    kinds = {"graded": {"thresholds": (20.0, 200.0)}, "best-of-four": {"question": question}}
    told = kinds.get(question, {})

    def mistakes(oracle):
        rates = []
        for seed in range(2):
            rule = Bayes(50, question=question, noise_model="infer")
            env = SpeedEnv()
            adapter = PreferenceAdapter(
                SpeedModel(), env, rule=rule, n_queries=20, oracle=oracle(seed=seed), seed=seed
            )
            adapter.adapt()
            inference = adapter.inference
            rates.append(inference.people_shares @ inference.people.mistakes)
        return np.mean(rates)

    exact = mistakes(partial(ReturnOracle, **told))
    often = mistakes(partial(MistakeOracle, 0.25, **told))
    assert exact < 0.02 < 0.05 < often  # 0.05 before the first answer


@pytest.mark.parametrize(
    ("question", "noise"), [("graded", "infer"), ("pair", "infer"), ("pair", MistakeNoise(0.1))]
)
def test_the_probability_of_an_answer_given_the_others(question, noise):
    """Of one that was left out in truth."""
    answers = [(LEFT, 0.7, -0.4), (RIGHT, 0.2, 0.9), (EQUAL, 0.1, 0.8)]
    if question == "graded":
        answers[0] = (MUCH_LEFT, *answers[0][1:])

    def told(answers):
        options = {"question": question, "noise_model": noise, "likelihood": "similarity"}
        inference = make(n_particles=40, **options)
        particles = crowd(inference, 1.88)
        for preference, *sides in answers:
            inference.tell(preference, *(np.full(5, side) for side in sides))
        np.testing.assert_array_equal(inference.particles, particles)
        return inference

    found = told(answers).agreements()
    for i, (preference, *sides) in enumerate(answers):
        others = told(answers[:i] + answers[i + 1 :])
        if preference is EQUAL:
            assert found[i, 0] == 1.0
            continue
        side = (RIGHT, MUCH_RIGHT) if preference is RIGHT else (LEFT, MUCH_LEFT)
        expected = 0.0
        for each in side if others.people is None else (*side, EQUAL):
            if each not in ANSWERS_OF[question]:
                continue
            more = told([*answers[:i], *answers[i + 1 :], (each, *sides)])
            expected += others.weights @ np.exp(more.log_weights - others.log_weights)
        assert found[i, 0] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(("question", "seed", "wrong"), [("graded", 1, 3), ("pair", 2, 4)])
def test_what_the_other_answers_contradict_is_found_and_asked_again(question, seed, wrong):
    graded = question == "graded"
    env = SpeedEnv()
    oracle = ReturnOracle(env, thresholds=(20.0, 200.0) if graded else None)
    opposite = {LEFT: RIGHT, MUCH_LEFT: MUCH_RIGHT, RIGHT: LEFT, MUCH_RIGHT: MUCH_LEFT}
    for turned in (None, wrong):
        adapter = PreferenceAdapter(
            SpeedModel(), env, rule=Bayes(question=question, noise_model="infer"), seed=seed
        )
        assert adapter.contradicted is None
        for number in range(9):
            query = adapter.ask()
            answer = oracle(query.left, query.right)
            adapter.tell(opposite[answer] if number == turned else answer)
        assert adapter.contradicted == turned
    asked = adapter.answers[wrong]
    with pytest.raises(ValueError, match="from 0 to 8, but is 9"):
        adapter.ask_again(9)
    adapter.ask()
    again = adapter.ask_again(wrong)
    assert adapter.ask() is again
    np.testing.assert_array_equal(again.left.observations, asked.shown[0].observations)
    adapter.tell(oracle(again.left, again.right))
    assert adapter.contradicted is None
    kept = [adapter.answers[number].preference for number in (wrong, -1)]
    assert kept == [asked.preference, opposite[asked.preference]]  # the first stays
    with pytest.raises(RuntimeError, match="all 10 questions"):
        adapter.ask_again(wrong)


def test_fragments_of_one_policy_are_told_apart():
    """Their latents are the same, and what was asked about them is not asked twice."""
    oracle = ReturnOracle(SpeedEnv(), task=[1.5])
    source = PreferenceAdapter(SpeedModel(), SpeedEnv(), rule=Bayes(query_rule="random"), seed=3)
    source.adapt(oracle)
    seen = [item for answer in source.answers for item in answer.shown]
    library = [replace(item, latent=np.zeros(5)) for item in seen]
    rule = Bayes(noise_model="infer")
    adapter = PreferenceAdapter(SpeedModel(), SpeedEnv(), rule=rule, library=library, seed=0)
    for number in range(9):
        left, right = adapter.ask().shown
        adapter.tell(oracle(right, left) if number == 2 else oracle(left, right))
    assert adapter.contradicted == 2


def test_a_choice_that_the_others_contradict_is_found():
    env = SpeedEnv()
    oracle = ReturnOracle(env, question="best-of-four")
    for turned in (None, 3):
        rule = Bayes(question="best-of-four", noise_model="infer")
        adapter = PreferenceAdapter(SpeedModel(), env, rule=rule, seed=1)
        for number in range(8):
            shown = adapter.ask().shown
            worst = int(np.argmin([oracle.true_return(item) for item in shown]))
            wrong = ["first", "second", "third", "fourth"][worst]
            adapter.tell(wrong if number == turned else oracle(*shown))
        assert adapter.contradicted == turned
        agreements = adapter.inference.agreements()
        assert np.all((agreements >= 0) & (agreements <= 1))


def test_the_likelihood_from_s_is_the_direct_formula():
    model = SpeedModel()
    inference = make(model, likelihood="similarity", n_particles=50)
    particles = inference.particles.copy()
    s = model.similarities(particles, particles)
    spread = math.sqrt(
        np.mean([(row[i] - row[j]) ** 2 for row in s for i in range(50) for j in range(50)])
    )
    unit = max(1.0, SIMILARITY_RESOLUTION * spread / 1.702)
    left, right = np.full(5, -0.4), np.full(5, -1.7)
    expected = np.log(
        LAPSE / 2
        + (1 - LAPSE)
        * logistic((model.similarities(particles, np.stack([left, right])) @ [1, -1]) / unit)
    )
    inference.tell(LEFT, left, right)
    np.testing.assert_array_equal(inference.particles, particles)
    np.testing.assert_allclose(inference.log_weights, expected, rtol=1e-9)


def test_error_free_answers_do_not_care_for_the_scale_of_s():
    # Beyond the scale at which S's own odds are certain, a hundredfold S changes nothing.
    weights = []
    for scale in (100.0, 10_000.0):
        inference = make(SpeedModel(scale=scale), likelihood="similarity")
        inference.tell(LEFT, np.full(5, -0.4), np.full(5, -1.7))
        weights.append(inference.weights)
    assert np.ptp(weights[0]) > 0  # as none was moved
    np.testing.assert_allclose(weights[0], weights[1], rtol=1e-6)


def test_equal_is_neither_left_nor_right():
    log_left, log_right = np.log([[0.9], [0.5], [0.1]]), np.log([[0.1], [0.5], [0.9]])
    equal = preference_log_likelihood(log_left, log_right, [EQUAL])
    np.testing.assert_allclose(equal, np.log([0.3, 0.5, 0.3]))


@pytest.mark.parametrize("likelihood", ["decoder", "similarity"])
@pytest.mark.parametrize("candidates", ["prior", "aggregate"])
def test_the_posterior_agrees_with_a_grid(likelihood, candidates):
    """After several resamplings and moves the particles still follow the posterior, which a fine
    grid gives exactly.
    """
    model = SpeedModel(latent_dim=1, error=0.5)
    inference = make(model, likelihood=likelihood, candidates=candidates, n_particles=1500, seed=1)
    grid = np.linspace(-4, 4, 4001)[:, None]
    log_posterior = inference.prior.log_density(grid)
    answers = [(LEFT, 0.9, -0.6), (RIGHT, 1.8, 0.3), (LEFT, 0.8, 0.2), (RIGHT, 1.0, 0.45)]
    for preference, left, right in answers:
        pair = [np.array([left]), np.array([right])]
        if likelihood == "decoder":
            pair = [at_speed(model, model.speed(z), z) for z in pair]
        inference.tell(preference, *pair)
        if likelihood == "decoder":
            values = model.predicted_returns(grid, pair)
            slope = 1.702 / (0.5 * math.sqrt(2 * HORIZON * ERROR_CORRELATION))
        else:
            values, slope = model.similarities(grid, np.stack(pair)), 1 / inference.scale[1]
        better = values @ ([1, -1] if preference is LEFT else [-1, 1])
        log_posterior += np.log(LAPSE / 2 + (1 - LAPSE) * logistic(slope * better))
    posterior = np.exp(log_posterior - log_posterior.max())
    posterior /= posterior.sum()
    mean = posterior @ grid[:, 0]
    std = math.sqrt(posterior @ (grid[:, 0] - mean) ** 2)
    estimated = inference.weights @ inference.particles[:, 0]
    spread = math.sqrt(inference.weights @ (inference.particles[:, 0] - estimated) ** 2)
    assert estimated == pytest.approx(mean, abs=0.25 * std)
    assert spread == pytest.approx(std, rel=0.25)


def test_slice_moves_leave_the_posterior_as_it_is():
    # Prior N(0, 1), likelihood of x > 0.3 softened; start from exact draws by rejection, move
    # often, compare quantiles.
    rng = np.random.default_rng(0)

    def log_likelihood(z):
        return -np.logaddexp(0.0, -8.0 * (z[:, 0] - 0.3))

    draws = rng.standard_normal((40_000, 2))
    draws = draws[rng.random(len(draws)) < np.exp(log_likelihood(draws))][:8000]
    prior = GaussianPrior(2)
    fitted = fit_gaussian(draws, np.full(len(draws), 1 / len(draws)))
    moved, values = draws, log_likelihood(draws)
    for _ in range(8):
        moved, values = elliptical_slice_moves(
            moved, values, log_likelihood, prior.log_density, fitted, 2, rng
        )
    np.testing.assert_allclose(values, log_likelihood(moved))
    assert np.mean(np.any(moved != draws, axis=1)) > 0.95
    for axis in (0, 1):
        quantiles = np.linspace(0.05, 0.95, 10)
        np.testing.assert_allclose(
            np.quantile(moved[:, axis], quantiles),
            np.quantile(draws[:, axis], quantiles),
            atol=0.06,
        )


def test_kernel_neighbours_keep_mean_and_covariance_and_stay_where_the_prior_is():
    rng = np.random.default_rng(0)
    particles = rng.standard_normal((20_000, 2)) @ np.array([[1.0, 0.0], [0.8, 0.3]]).T + [
        2.0,
        -1.0,
    ]
    weights = np.full(len(particles), 1 / len(particles))
    fitted = fit_gaussian(particles, weights)
    neighbours = kernel_neighbours(particles, fitted, None, rng)
    assert np.all(np.any(neighbours != particles, axis=1))
    np.testing.assert_allclose(neighbours.mean(axis=0), particles.mean(axis=0), atol=0.02)
    np.testing.assert_allclose(np.cov(neighbours.T), np.cov(particles.T), atol=0.03)
    upper = kernel_neighbours(particles, fitted, lambda z: np.where(z[:, 0] > 1, 0.0, -1e9), rng)
    inside = particles[:, 0] > 1
    assert np.all(upper[inside, 0] > 1)


def test_resampling_keeps_counts_within_one():
    rng = np.random.default_rng(0)
    weights = rng.dirichlet(np.ones(7))
    counts = np.bincount(systematic_resample(weights, 100, rng), minlength=7)
    assert counts.sum() == 100
    assert np.all(np.abs(counts - 100 * weights) < 1)


@pytest.mark.parametrize("likelihood", ["similarity", "decoder"])
def test_many_answers_in_many_dimensions_do_not_thin_the_particles_out(likelihood):
    model = SpeedModel(latent_dim=32)
    inference = make(model, likelihood=likelihood)
    goal, rng = 2.2, np.random.default_rng(0)
    for _ in range(50):
        left, right = inference.ask()
        speeds = model.speed(left), model.speed(right)
        preference = LEFT if abs(speeds[0] - goal) < abs(speeds[1] - goal) else RIGHT
        if rng.random() < 0.1:
            preference = RIGHT if preference is LEFT else LEFT
        shown = [at_speed(model, s, z) for s, z in zip(speeds, (left, right), strict=True)]
        inference.tell(preference, *shown)
        assert np.all(np.isfinite(inference.particles))
        assert inference.effective_size >= 50
        assert len(np.unique(inference.particles, axis=0)) >= 50
    assert model.speed(inference.estimate()) == pytest.approx(goal, abs=0.3)
    if (
        likelihood == "similarity"
    ):  # where all particles move, directions that no answer speaks of keep the prior's spread
        assert 0.6 < inference.particles[:, 1:].std(axis=0).mean() < 1.4


class SignOf:
    """Forwards or backwards: the middle fits neither."""

    def similarities(self, tasks, policies):
        return np.sign(tasks[:, :1]) * np.where(
            np.abs(policies[:, 0]) > 0.5, np.sign(policies[:, 0]), 0.0
        )


class ProductOf:
    """A policy looks the fitter the more extreme it is."""

    def similarities(self, tasks, policies):
        return tasks[:, :1] * policies[:, 0]


class EitherOf:
    """Two kinds of policy are as good as each other, and what lies between them is not."""

    def similarities(self, tasks, policies):
        return np.repeat(-np.abs(np.abs(policies[:, 0]) - 2.0)[None, :], len(tasks), axis=0)


class NearestTo:
    """A policy that lies between all others looks best by far."""

    def similarities(self, tasks, policies):
        return np.repeat(-np.abs(policies[:, 0] - 0.8)[None, :], len(tasks), axis=0)


TWO_CLUSTERS = np.concatenate([np.linspace(-2.4, -1.6, 30), np.linspace(1.6, 2.4, 30)])[:, None]


def test_the_decision_is_between_the_modes_only_if_that_is_fit():
    particles = np.array([[-1.0]] * 30 + [[1.0]] * 70)
    weights = np.full(100, 0.01)
    assert decide("posterior-mean", SignOf(), particles, weights, None, TWO_CLUSTERS)[
        0
    ] == pytest.approx(0.4)
    assert decide(
        "expected-fitness", SignOf(), particles, weights, np.array([[0.2]]), TWO_CLUSTERS
    )[0] == pytest.approx(1.0)
    assert (
        decide("most-likely", SignOf(), particles, np.arange(100) / 4950, None, TWO_CLUSTERS)[0]
        == 1.0
    )


def test_the_decision_is_the_middle_of_what_looks_alike():
    cluster = TWO_CLUSTERS[30:]
    weights = np.full(30, 1 / 30)
    assert decide("expected-fitness", ProductOf(), cluster, weights, None, TWO_CLUSTERS)[
        0
    ] == pytest.approx(2.0)
    lopsided = np.r_[np.full(30, 0.3 / 30), np.full(30, 0.7 / 30)]
    assert decide("expected-fitness", ProductOf(), TWO_CLUSTERS, lopsided, None, TWO_CLUSTERS)[
        0
    ] == pytest.approx(2.0)


def test_the_decision_is_not_between_policies_that_are_alike_where_the_middle_is_not():
    weights = np.full(60, 1 / 60)
    reference = np.linspace(-4.0, 4.0, 101)[:, None]
    chosen = decide("expected-fitness", EitherOf(), TWO_CLUSTERS, weights, None, reference)
    assert abs(chosen[0]) == pytest.approx(2.0, abs=0.02)


def test_a_mean_in_a_hole_of_the_prior_is_not_acted_on():
    lopsided = np.r_[
        np.full(30, 0.3 / 30), np.full(30, 0.7 / 30)
    ]  # S thinks as much of their mean, 0.8, as of 2
    args = "expected-fitness", SignOf(), TWO_CLUSTERS, lopsided, None, TWO_CLUSTERS
    assert decide(*args)[0] == pytest.approx(0.8)
    assert decide(*args, has_holes=True)[0] == pytest.approx(2.0)
    args = "expected-fitness", NearestTo(), TWO_CLUSTERS, lopsided, None, TWO_CLUSTERS
    assert decide(*args)[0] == pytest.approx(0.8)
    assert 1.6 <= decide(*args, has_holes=True)[0] <= 2.4


def test_a_training_task_that_fits_best_by_far_is_the_decision():
    particles, weights = np.linspace(0.9, 1.1, 20)[:, None], np.full(20, 0.05)
    chosen = decide(
        "expected-fitness", ProductOf(), particles, weights, np.array([[5.0], [-5.0]]), TWO_CLUSTERS
    )
    assert chosen[0] == 5.0


def test_fitness_is_in_standard_scores_of_the_reference():
    similarities, reference = (
        np.array([[1.0, 4.0], [50.0, 20.0]]),
        np.array([[1.0, 2.0, 6.0], [50.0, 20.0, 20.0]]),
    )
    expected = [
        [(x - np.mean(row)) / np.std(row) for x in line]
        for line, row in zip(similarities, reference, strict=True)
    ]
    np.testing.assert_allclose(standard_scores(similarities, reference), expected)


def test_the_aggregate_prior_is_the_mixture_that_it_says():
    rng = np.random.default_rng(0)
    prior = AggregatePrior(rng.normal(size=(20, 2)))
    z = rng.normal(size=(4, 2))
    direct = [
        math.log(
            np.sum([math.exp(-0.5 * np.sum((x - c) ** 2) / prior.width**2) for c in prior.centres])
        )
        for x in z
    ]
    np.testing.assert_allclose(prior.log_density(z), direct)
    assert prior.sample(5, rng).shape == (5, 2)


def test_balanced_draws_follow_the_prior_more_evenly():
    rng = np.random.default_rng(0)
    gaussian = GaussianPrior(3)
    draws = gaussian.balanced_sample(5000, rng)
    np.testing.assert_allclose(draws.mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.cov(draws.T), np.eye(3), atol=0.1)
    assert gaussian.balanced_sample(7, rng).shape == (7, 3)
    aggregate = AggregatePrior(100.0 * np.arange(6.0)[:, None])
    aggregate.width = 0.1
    counts = np.bincount(
        np.round(aggregate.balanced_sample(15, rng)[:, 0] / 100).astype(int), minlength=6
    )
    assert set(counts) == {2, 3}


def test_candidates_by_default_come_from_where_the_policy_was_trained():
    def prior(model, rule):
        return rule.start(model, np.random.default_rng(0), Setting()).prior

    near, far = SpeedModel(), SpeedModel()
    near.aggregate_to_prior_kl, far.aggregate_to_prior_kl = 0.05, 2.0
    assert isinstance(prior(near, Bayes()), GaussianPrior)
    assert isinstance(prior(far, Bayes()), AggregatePrior)
    assert isinstance(prior(far, Bayes(candidates="prior")), GaussianPrior)
    assert isinstance(prior(far, Paper()), GaussianPrior)  # Algorithm 2 as it is


def test_a_library_is_asked_about_without_similarity():
    class DecoderOnly(SpeedModel):
        similarities = None  # as PEARLSAC: there is none

    model = DecoderOnly(latent_dim=1)
    library = [at_speed(model, speed) for speed in np.linspace(0, 3, 13)]
    inference = make(model, library=library, decision="posterior-mean")
    goal = 2.05
    for _ in range(8):
        left, right = inference.ask()
        speeds = [shown.observations[1, 1] for shown in (left, right)]
        inference.tell(
            LEFT if abs(speeds[0] - goal) < abs(speeds[1] - goal) else RIGHT,
            left,
            right,
        )
    assert model.speed(inference.estimate()) == pytest.approx(goal, abs=0.15)


def test_a_snapshot_continues_exactly():
    model = SpeedModel()
    first, second = make(model, seed=1), make(model, seed=2)
    for _ in range(3):
        left, right = first.ask()
        first.tell(
            LEFT,
            at_speed(model, model.speed(left), left),
            at_speed(model, model.speed(right), right),
        )
    second.restore(first.snapshot(), first.answers)
    np.testing.assert_array_equal(first.estimate(), second.estimate())
    np.testing.assert_array_equal(first.ask(), second.ask())
    with pytest.raises(ValueError, match="snapshot of BayesInference"):
        first.restore({**first.snapshot(), "arrays": {}}, [])


class NoDecoder(SpeedModel):
    predicted_returns = None


class Untrained(SpeedModel):
    predicted_rewards_error = float("nan")

    def __init__(self):
        super().__init__()
        del self.predicted_rewards_error


def test_the_likelihood_follows_what_the_model_has():
    assert make().likelihood == "decoder"
    assert make(NoDecoder()).likelihood == "similarity"


@pytest.mark.parametrize(
    ("model", "arguments", "message"),
    [
        (SpeedModel(), {"likelihood": "exact"}, "`likelihood` must be one of .*, but is 'exact'"),
        (SpeedModel(), {"decision": "best"}, "`decision` must be one of .*, but is 'best'"),
        (NoDecoder(), {"likelihood": "decoder"}, "needs a model with `predicted_returns`"),
        (
            SpeedModel(error=float("nan")),
            {"likelihood": "decoder"},
            "finite `predicted_rewards_error`, which is nan",
        ),
        (
            SpeedModel(),
            {"likelihood": "similarity", "noise_model": BoltzmannNoise(2.0)},
            "fixed beta",
        ),
        (SpeedModel(), {"library": []}, "`library` must hold at least 2"),
        (SpeedModel(), {"library": [1, 2], "query_rule": "worst-case"}, "worst-case"),
        (NoDecoder(), {"library": [1, 2]}, "`library` needs a model with a reward decoder"),
    ],
)
def test_bad_options(model, arguments, message):
    with pytest.raises(ValueError, match=message):
        make(model, **arguments)


def test_the_decoder_needs_trajectories_and_s_latents():
    with pytest.raises(ValueError, match="needs the trajectories"):
        make().tell(LEFT, np.zeros(5), np.ones(5))
    inference = make(likelihood="similarity")
    inference.tell(LEFT, np.zeros(5), np.ones(5))
    assert inference.contradicted() is None


class Misled(SpeedModel):
    """From some steps alone it takes the left trajectories for better than they are, by as much for
    every latent.
    """

    def predicted_returns(self, latents, trajectories, max_steps=None):
        returns = super().predicted_returns(latents, trajectories)
        if max_steps is not None and len(trajectories[0]) > max_steps:
            returns[:, ::2] += 30.0
        return returns


def test_what_some_steps_alone_mislead_to_is_put_right():
    steps = 2 * DECODED_STEPS
    left, right = (
        Trajectory(
            np.column_stack([np.zeros(steps + 1), np.full(steps + 1, v)]),
            np.zeros((steps, 1)),
            np.zeros(5),
        )
        for v in (1.0, 1.04)
    )
    truth, misled = make(SpeedModel()), make(Misled())
    for inference in (truth, misled):
        inference.tell(RIGHT, left, right)
    np.testing.assert_allclose(misled.particles, truth.particles)
    np.testing.assert_allclose(misled.weights, truth.weights)
    restored = make(Misled(), seed=1)  # which must know it, too, when particles are weighed again
    restored.restore(misled.snapshot(), misled.answers)
    for inference in (truth, misled, restored):
        inference.tell(RIGHT, left, right)
        np.testing.assert_allclose(inference.particles, truth.particles)
        np.testing.assert_allclose(inference.agreements(), truth.agreements())
    prior = make()
    assert (
        SpeedModel.speed(truth.estimate()) > SpeedModel.speed(prior.estimate()) + 0.2
    )  # it says something


def test_thinning_is_a_line_and_what_is_off_it():
    thin = np.linspace(-100.0, 100.0, 8)
    signs = np.array([1.0, -1.0, -1.0, 1.0, 1.0, -1.0, -1.0, 1.0])  # orthogonal to a line
    intercept, slope, error = fit_thinning(thin, thin + 7.0 + 0.01 * thin + 2.0 * signs)
    assert intercept == pytest.approx(7.0)
    assert slope == pytest.approx(0.01, rel=0.02)
    assert error == pytest.approx(2.0, rel=0.01)
    # differences that hardly vary tell no slope
    assert abs(fit_thinning(thin / 1e4, thin / 1e4 + 20.0 * signs + thin)[1]) < 0.01
