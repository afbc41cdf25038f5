"""Which latent to act on, given a posterior."""

import numpy as np

from sb3_poem.adaptation.meta_model import HasSimilarity

DECISIONS = ("expected-fitness", "posterior-mean", "most-likely")

# How much fitter than the posterior mean's policy another one must look to be taken instead, in
# standard deviations of S over the prior's policies: the best-looking of hundreds is partly luck.
MEAN_ADVANTAGE = 0.1
# Options that look as fit as the best one to within this (root mean square over the posterior, same
# unit) are not told apart: at the far side of a cluster S may go on rising where returns fall.
ALIKE = 0.5


def decide(
    decision: str,
    model: HasSimilarity | None,
    particles: np.ndarray,
    weights: np.ndarray,
    training_latents: np.ndarray | None,
    reference: np.ndarray,
    has_holes: bool = False,
) -> np.ndarray:
    """The latent to act on, (d,), given particles (n, d) with weights (n,) that sum to one.

    - "expected-fitness": the posterior mean if its policy is nearly as fit as any, else the middle
      of those options that S does not tell from the fittest. Fitness is S(z, option), averaged over
      the posterior of z; options are the particles, the posterior mean and the training tasks'
      latents. (Fitness alone would run to extreme latents; the mean of two modes fits neither.)
    - "posterior-mean": the weighted mean of the particles.
    - "most-likely": the particle of the largest weight.

    :param model: None has "expected-fitness" mean the particle nearest to the posterior mean.
    :param training_latents: (N, d) or None.
    :param reference: (m, d) draws of the prior, whose policies give S its unit.
    :param has_holes: Whether no training has seen latents between parts of the prior: then the
        posterior mean is no option.
    """
    if decision == "most-likely":
        return particles[np.argmax(weights)].copy()
    mean = weights @ particles
    if decision == "posterior-mean":
        return mean
    if model is None:
        return particles[np.argmin(np.linalg.norm(particles - mean, axis=1))].copy()
    options = [particles]
    if not has_holes:
        options.append(mean[None, :])
    if training_latents is not None:
        options.append(np.asarray(training_latents, dtype=np.float64))
    stacked = np.concatenate(options)
    unit = model.similarities(particles, reference)
    scores = standard_scores(model.similarities(particles, stacked), unit)
    fitness = weights @ scores
    best = int(np.argmax(fitness))
    if not has_holes and fitness[best] <= fitness[len(particles)] + MEAN_ADVANTAGE:
        return mean
    shares = weights * _alike(scores, scores[:, best], weights)[: len(particles)]
    if not shares.any():
        return stacked[best].copy()
    middle = shares @ particles / shares.sum()
    # What is like the best at either end need not be so in the middle.
    of_middle = standard_scores(model.similarities(particles, middle[None, :]), unit)
    return middle if _alike(of_middle, scores[:, best], weights)[0] else stacked[best].copy()


def standard_scores(similarities: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """S(z_i, option), (n, options), in units in which that of the prior's policies, (n, m), has
    mean 0 and standard deviation 1 for all tasks: those of large norm would outvote others.
    """
    scale = reference.std(axis=1, keepdims=True)
    return (similarities - reference.mean(axis=1, keepdims=True)) / np.maximum(scale, 1e-12)


def _alike(scores: np.ndarray, best: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return weights @ np.square(scores - best[:, None]) <= ALIKE**2
