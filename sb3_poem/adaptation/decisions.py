"""Which latent to act on, given a posterior."""

from __future__ import annotations

from typing import Any

import numpy as np

DECISIONS = ("expected-fitness", "posterior-mean", "most-likely")

# How much fitter than the posterior mean's policy another one must look, in standard deviations of fitness over the
# options, to be taken instead of it. S is an estimate, and the best-looking of hundreds of options is partly luck; the
# mean is not chosen by it.
MEAN_ADVANTAGE = 0.1


def decide(
    decision: str, model: Any | None, particles: np.ndarray, weights: np.ndarray, training_latents: np.ndarray | None
) -> np.ndarray:
    """
    The latent to act on.

    - "expected-fitness": the option whose policy has the highest fitness S(z, option), averaged over the posterior of z.
      Options are the posterior mean, the particles and the training tasks' latents. Highest likelihood would run to
      extreme latents, as the likelihood grows with their norm; and the mean of two separate modes fits neither.
      S is standardised for each z, since tasks of large norm would outvote the others.
    - "posterior-mean": the weighted mean of the particles.
    - "most-likely": the particle of the largest weight.

    :param decision: One of these.
    :param model: A model with ``similarity``; None leaves only the other two, and "expected-fitness" then means the particle
        nearest to the posterior mean, which lies within a mode.
    :param particles: (n, d).
    :param weights: (n,) summing to one.
    :param training_latents: (N, d) or None.
    :return: (d,).
    :raises ValueError: If the decision is unknown.
    """
    if decision not in DECISIONS:
        raise ValueError(f"`decision` must be one of {DECISIONS}, but is {decision!r}")
    if decision == "most-likely":
        return particles[np.argmax(weights)].copy()
    mean = weights @ particles
    if decision == "posterior-mean":
        return mean
    if model is None:
        return particles[np.argmin(np.linalg.norm(particles - mean, axis=1))].copy()
    options = [mean[None, :], particles]
    if training_latents is not None:
        options.append(np.asarray(training_latents, dtype=np.float64))
    stacked = np.concatenate(options)
    fitness = expected_fitness(model.similarity(particles, stacked), weights)
    best = int(np.argmax(fitness))
    return (stacked[best] if fitness[best] > fitness[0] + MEAN_ADVANTAGE else mean).copy()


def expected_fitness(similarities: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """
    Mean standardised similarity of each option.

    :param similarities: (n, options) S(z_i, option).
    :param weights: (n,) summing to one.
    :return: (options,).
    """
    centred = similarities - similarities.mean(axis=1, keepdims=True)
    scale = centred.std(axis=1, keepdims=True)
    return weights @ (centred / np.maximum(scale, 1e-12))
