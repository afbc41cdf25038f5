"""The particles of the Bayesian rule follow the posterior, and begin as the prior."""

import math

import numpy as np
import pytest
from bayes_world import LEFT, RIGHT, at_speed, logistic, make
from worlds import HORIZON, SpeedModel

from sb3_poem.adaptation.bayes import (
    ERROR_CORRELATION,
    Bayes,
)
from sb3_poem.adaptation.noise import LAPSE
from sb3_poem.adaptation.paper import Paper
from sb3_poem.adaptation.particles import (
    elliptical_slice_moves,
    fit_gaussian,
    kernel_neighbours,
    systematic_resample,
)
from sb3_poem.adaptation.priors import AggregatePrior, GaussianPrior
from sb3_poem.adaptation.rule import Setting


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
    for _ in range(30):
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
