"""Moving particles without losing the posterior: resampling, elliptical slice sampling of many at
once, and kernels.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

# A slice's reference Gaussian is this much wider than the particles, so that the ratio of target to
# reference does not grow in the tails.
WIDENING = 1.3
# A kernel's, as a share of the particles' spread.
WIDTH = 0.3


def systematic_resample(weights: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw n indices, ascending, with the given weights by one uniform number, which keeps the
    counts within one of n w_i.
    """
    positions = (rng.random() + np.arange(n)) / n
    cumulative = np.cumsum(weights)
    found = np.searchsorted(cumulative / cumulative[-1], positions, side="right")
    return np.minimum(found, len(weights) - 1)


class Gaussian(NamedTuple):
    """Mean (d,), and a lower-triangular factor (d, d) of the covariance."""

    mean: np.ndarray
    factor: np.ndarray


def fit_gaussian(particles: np.ndarray, weights: np.ndarray) -> Gaussian:
    """A Gaussian over weighted particles (n, d). As the covariance of fewer particles than
    dimensions is singular, it is shrunk towards its diagonal by as much as particles are missing.
    """
    mean = weights @ particles
    centred = particles - mean
    dim = particles.shape[1]
    effective = 1.0 / np.square(weights).sum()
    # Unbiased: what a fit loses of the spread, the next one would lose again, answer for answer.
    covariance = (weights[:, None] * centred).T @ centred / max(1.0 - 1.0 / effective, 0.1)
    shrinkage = (dim + 1.0) / (dim + 1.0 + effective)
    diagonal = np.diag(covariance)
    floor = 1e-8 + 1e-4 * diagonal.max()
    covariance = (1.0 - shrinkage) * covariance + np.diag(shrinkage * diagonal + floor)
    return Gaussian(mean, np.linalg.cholesky(covariance))


def kernel_neighbours(
    particles: np.ndarray,
    fitted: Gaussian,
    log_prior: Callable[[np.ndarray], np.ndarray] | None,
    rng: np.random.Generator,
) -> np.ndarray:
    """A neighbour of each particle (n, d), without a look at the likelihood.

    The kernel shrinks towards the mean as much as it spreads by the covariance, so that both stay
    (Liu & West 2001). Where the prior has holes, between the modes of a mixture say, no particles
    should lie there: a step is taken with the ratio of the prior's densities.

    :param log_prior: Maps (m, d) to (m,), up to a constant; None where the prior has no holes.
    """
    mean, noise = fitted.mean, rng.standard_normal(particles.shape) @ fitted.factor.T
    proposals = mean + np.sqrt(1.0 - WIDTH**2) * (particles - mean) + WIDTH * noise
    if log_prior is None:
        return proposals
    ratio = log_prior(proposals) - log_prior(particles)
    accepted = np.log(1.0 - rng.random(len(particles))) < ratio
    return np.where(accepted[:, None], proposals, particles)


def elliptical_slice_moves(
    particles: np.ndarray,
    log_likelihoods: np.ndarray,
    log_likelihood: Callable[[np.ndarray], np.ndarray],
    log_prior: Callable[[np.ndarray], np.ndarray],
    reference: Gaussian,
    tries: int,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """One elliptical slice move (Murray, Adams & MacKay 2010) of every particle (n, d), all
    together; returns them, and their log-likelihoods (n,).

    The ellipse belongs to a reference Gaussian that is fitted to the posterior, and the ratio of
    prior times likelihood to it is the slice's function (Nishihara, Murray & Adams 2014): so any
    prior density will do, and the first tries mostly hit. A particle that has not hit after the
    last try stays where it is, which leaves the posterior invariant too: the path to any point
    within the tries is as probable as its reverse.

    :param log_likelihoods: (n,) at the particles.
    :param tries: Bound on the evaluations per particle.
    """
    (n, dim), (mean, factor) = particles.shape, reference
    inverse = np.linalg.inv(factor)

    def log_ratio(latents: np.ndarray, likelihoods: np.ndarray) -> np.ndarray:
        of_reference = -0.5 * np.square((latents - mean) @ inverse.T).sum(axis=1)
        return likelihoods + log_prior(latents) - of_reference

    particles, log_likelihoods = particles.copy(), log_likelihoods.copy()
    centred = particles - mean
    auxiliary = rng.standard_normal((n, dim)) @ factor.T
    threshold = log_ratio(particles, log_likelihoods) + np.log(1.0 - rng.random(n))
    angle = np.asarray(rng.uniform(0.0, 2.0 * np.pi, size=n))
    lower, upper = angle - 2.0 * np.pi, angle.copy()
    active = np.arange(n)
    for _ in range(tries):
        cosine, sine = np.cos(angle[active])[:, None], np.sin(angle[active])[:, None]
        proposals = mean + centred[active] * cosine + auxiliary[active] * sine
        likelihoods = log_likelihood(proposals)
        hit = log_ratio(proposals, likelihoods) > threshold[active]
        particles[active[hit]], log_likelihoods[active[hit]] = proposals[hit], likelihoods[hit]
        active = active[~hit]
        if not len(active):
            break
        negative = angle[active] < 0
        lower[active[negative]] = angle[active[negative]]
        upper[active[~negative]] = angle[active[~negative]]
        angle[active] = lower[active] + rng.random(len(active)) * (upper[active] - lower[active])
    return particles, log_likelihoods
