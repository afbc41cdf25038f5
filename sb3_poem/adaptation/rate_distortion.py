"""What so many bits about the task can be worth: the rate-distortion bound, and the bits in an
oracle's answers.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar

from sb3_poem.adaptation.noise import BoltzmannNoise, ExactNoise, MistakeNoise, NoiseModel

MAX_ITERATIONS = 1000
TOLERANCE = 1e-4  # nats


def answer_capacity(noise: NoiseModel | None, returns: np.ndarray) -> float:
    """The most that one answer (left or right) can tell, whatever is asked: bits, in [0, 1].

    It is the capacity of the binary symmetric channel at the oracle's smallest probability of a
    mistake. Of the probabilities of LEFT that questions can bring about only the extremes matter,
    since the information is convex in them; and asking in the light of earlier answers adds nothing
    (Cover & Thomas, Elements of Information Theory, 7.12).

    :param noise: How the oracle errs; None is an oracle that does not.
    :param returns: (n_tasks, n_policies). With a fixed ``beta`` an answer is the surer the larger
        the difference of returns, and no question is supposed to show a larger one than there is
        between two policies here.
    """
    if noise is None or isinstance(noise, ExactNoise):
        return 1.0
    if isinstance(noise, MistakeNoise):
        mistake = noise.rate
    elif isinstance(noise, BoltzmannNoise):
        # The paper's exponent, |R_left - R_right| / (|R_left| + |R_right|), is at most 1.
        exponent = 1.0 if noise.beta is None else noise.beta * float(np.ptp(returns, axis=1).max())
        mistake = float(0.5 * (1.0 - np.tanh(0.5 * exponent)))
    else:
        known, name = "ExactNoise, MistakeNoise or BoltzmannNoise", type(noise).__name__
        raise ValueError(f"`noise_model` must be {known}, but is of type {name}")
    return 1.0 - _binary_entropy(mistake)


def rate_distortion_limit(returns: np.ndarray, bits: float) -> float:
    """An upper bound on the mean return of any method that learns at most so many bits about which
    of the tasks it is.

    It is max E[J] over all ways p(j | i) to choose policies with mutual information I(i; j) <=
    bits, tasks being equally likely (Shannon 1959), found by the algorithm of Blahut and Arimoto.
    What is returned is the value of the dual problem, with the bound that holds at every iterate
    (Csiszar 1974): where iterations are stopped early it is too high, never too low.

    :param returns: (n_tasks, n_policies), finite.
    """
    if not bits >= 0:
        raise ValueError(f"`bits` must not be negative, but is {bits}")
    best = float(returns.max(axis=1).mean())
    scale = float(np.ptp(returns))
    if scale == 0.0 or bits >= np.log2(len(returns)):
        return best
    if bits == 0.0:
        return float(returns.mean(axis=0).max())
    scaled, nats = (returns - returns.max()) / scale, bits * np.log(2.0)

    def bound(log_slope: float) -> float:
        slope = float(np.exp(log_slope))
        return (nats + _log_partition(scaled, slope)) / slope

    # The dual is convex in 1 / slope, hence unimodal in its logarithm.
    bounds, options = (np.log(1e-2), np.log(1e5)), {"xatol": 1e-2}
    found = minimize_scalar(bound, bounds=bounds, method="bounded", options=options)
    return min(best, float(returns.max() + scale * found.fun))


def _log_partition(returns: np.ndarray, slope: float) -> float:
    """An upper bound, tight within ``TOLERANCE``, on the maximum over p(j | i) of slope E[J] - I(i;
    j).
    """
    best = returns.max(axis=1, keepdims=True)
    kernel = np.exp(slope * (returns - best))
    marginal = np.full(returns.shape[1], 1.0 / returns.shape[1])
    smallest = np.inf
    for _ in range(MAX_ITERATIONS):
        z = kernel @ marginal
        growth = (1.0 / z) @ kernel / len(z)
        excess = float(np.log(growth.max()))
        smallest = min(smallest, float(np.log(z).mean()) + excess)
        if excess < TOLERANCE:
            break
        # No policy may vanish for good by rounding: its task would then have none.
        marginal = np.maximum(marginal * growth, 1e-200)
    return smallest + slope * float(best.mean())


def _binary_entropy(p: float) -> float:
    """Bits."""
    return 0.0 if p in (0.0, 1.0) else float(-p * np.log2(p) - (1.0 - p) * np.log2(1.0 - p))
