"""The most that k answers, or so many bits about the task, can give."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb
from typing import Self

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import entr, softmax

from sb3_poem.adaptation.noise import BoltzmannNoise, ExactNoise, MistakeNoise, NoiseModel
from sb3_poem.common.checks import check_number, check_whole

# Up to this many codebooks are tried one by one; beyond, greedy choice and swaps.
EXACT_CODEBOOKS = 5000
MAX_SWAP_ROUNDS = 50
MAX_ITERATIONS = 1000
TOLERANCE = 1e-4  # nats
CHANNEL_INPUTS, CHANNEL_OUTPUTS = 81, 400
#: Of the rate-distortion curve: the worth of the whole range of returns, in nats
SLOPES = np.geomspace(0.1, 1e4, 25)
#: Policies of a codebook up to which the order of tasks is made use of
ORDERED_POLICIES = 32


@dataclass(frozen=True)
class AnswerLimits:
    """What the best choice of some policies earns after k answers, where the choice is made on
    other tasks and scored on the test tasks by fresh episodes.

    k exact answers tell 2^k policies apart: the *codebook* of 2^k is that which is best for the
    other tasks, and each test task gets the best of it. Answers with errors tell less: then
    policies are chosen as rate-distortion theory says (Shannon 1959), with the marginal that is
    best for the other tasks at that many bits. A method with other policies may earn more.

    >>> limits = AnswerLimits((-9.0, -5.0, -3.0), bits=(0.0, 2.0), returns=(-9.0, -3.0), spread=9.0)
    >>> limits.after(1), limits.after(10)
    (-5.0, -3.0)

    :param codebooks: Mean return after 0, 1, 2, ... exact answers, until all policies are in.
    :param bits: Ascending from 0, and ``returns``, the mean returns when so much is told; empty if
        that was not measured.
    :param spread: The largest difference of two policies' returns on a task.
    """

    codebooks: tuple[float, ...]
    bits: tuple[float, ...]
    returns: tuple[float, ...]
    spread: float

    @classmethod
    def measure(
        cls,
        others: np.ndarray,
        chosen: np.ndarray,
        fresh: np.ndarray,
        *,
        ordered: bool = False,
        erring: bool = True,
    ) -> Self:
        """From returns of the same policies.

        :param others: (n_others, n_policies), on which codebooks are chosen.
        :param chosen: (n_tasks, n_policies), by which each test task's policy is chosen.
        :param fresh: (n_tasks, n_policies), of other episodes, which score it.
        :param ordered: See :func:`best_codebook`.
        :param erring: Whether to measure what answers with errors allow, too, which takes longest.
        """
        others, chosen, fresh = (check_returns(returns) for returns in (others, chosen, fresh))
        n_policies, every = others.shape[1], np.arange(len(chosen))
        codebooks = []
        for k in range((n_policies - 1).bit_length() + 1):
            book = best_codebook(others, 2**k, ordered=ordered and 2**k <= ORDERED_POLICIES)
            picks = book[np.argmax(chosen[:, book], axis=1)]
            codebooks.append(float(fresh[every, picks].mean()))
        bits, returns = [0.0] * erring, codebooks[:1] * erring
        marginal = None
        for slope in SLOPES[: len(SLOPES) * erring] / max(float(np.ptp(others)), 1e-12):
            marginal, _ = _best_marginal(others, slope, marginal)
            told = softmax(slope * others + np.log(marginal), axis=1)  # p(j | i)
            logs = np.log(np.maximum(told, 1e-300) / np.maximum(marginal, 1e-300))
            rate = float((told * logs).sum(axis=1).mean() / np.log(2.0))
            if rate > bits[-1]:
                bits.append(rate)
                scored = softmax(slope * chosen + np.log(marginal), axis=1) * fresh
                returns.append(float(scored.sum(axis=1).mean()))
        spread = float(np.ptp(chosen, axis=1).max())
        return cls(tuple(codebooks), tuple(bits), tuple(returns), spread)

    def after(self, k: int, noise_model: NoiseModel | None = None, n_answers: int = 2) -> float:
        """Mean return after k answers.

        :param noise_model: How the oracle errs; None is an oracle that does not.
        :param n_answers: See :func:`information_limit`. Between two powers of 2 the codebooks'
            returns are interpolated.
        """
        check_whole("k", k, 0)
        capacity = answer_capacity(noise_model, self.spread, n_answers)
        most = k * np.log2(n_answers)
        exact = float(np.interp(most, range(len(self.codebooks)), self.codebooks))
        if capacity == np.log2(n_answers):
            return exact
        if not self.bits:
            raise ValueError("limits of answers with errors were not measured: limits=True does")
        return min(exact, float(np.interp(k * capacity, self.bits, self.returns)))


def information_limit(
    returns: np.ndarray,
    k: int,
    *,
    noise_model: NoiseModel | None = None,
    ordered: bool = False,
    n_answers: int = 2,
) -> float:
    """The highest mean return that any method can reach with these policies and k answers.

    k answers of m kinds tell at most m^k policies apart, so the best choice of those bounds it
    (:func:`best_codebook`); answers of an oracle that errs tell less than log2(m) bits each, so
    :func:`rate_distortion_limit` does. For a bound on the family take a dense grid of tasks: with
    30 of them it ends at the known-task return after five answers to pairs.

    >>> speeds = np.linspace(0, 3, 61)
    >>> returns = -np.abs(speeds[:, None] - speeds)  # of policies that run at some speed
    >>> [round(information_limit(returns, k, ordered=True), 2) for k in range(4)]
    [-0.76, -0.38, -0.19, -0.1]

    :param returns: (n_tasks, n_policies) return of each policy on each task (J).
    :param noise_model: How the oracle errs; None is an oracle that does not.
    :param n_answers: Kinds of answers to a question: 2 where left or right is better, 3 with EQUAL
        beside them, 4 where one of four is best, 5 where questions are graded.
    :raises ValueError: If an argument is out of its range, or the noise model of an unknown kind.
    """
    check_whole("k", k, 0)
    returns = check_returns(returns)
    capacity = answer_capacity(noise_model, float(np.ptp(returns, axis=1).max()), n_answers)
    size = int(n_answers) ** min(int(k), 63)  # NumPy's whole numbers would overflow
    if size >= min(returns.shape):
        limit = float(returns.max(axis=1).mean())
    else:
        limit = _value(returns, best_codebook(returns, size, ordered=ordered))
    if capacity == np.log2(n_answers):
        return limit
    return min(limit, rate_distortion_limit(returns, k * capacity))


def best_codebook(returns: np.ndarray, size: int, *, ordered: bool = False) -> np.ndarray:
    """The set of policies of a given size with the highest mean over tasks of the best return
    (k-medoids on the matrix): (min(size, n_policies),) indices, ascending. Where not all sets can
    be tried it is found by greedy choice and swaps, and may lie slightly below the optimum.

    >>> places = np.arange(6)
    >>> best_codebook(-np.abs(places[:, None] - places), 2, ordered=True)
    array([1, 4])

    :param ordered: Whether the rows are in the order of a one-dimensional task parameter: then all
        ways to cut the line into ``size`` intervals, one policy each, are looked at, too. That is
        exact if of any two policies the one is better up to some task and the other from there on.
    """
    returns = check_returns(returns)
    check_whole("size", size, 1)
    n_policies = returns.shape[1]
    if size >= n_policies:
        return np.arange(n_policies)
    if comb(n_policies, size) <= EXACT_CODEBOOKS:
        books = np.array(list(combinations(range(n_policies), size)))
        return books[np.argmax(returns[:, books].max(axis=2).mean(axis=0))]
    found = [_swap(returns, _greedy(returns, size))]
    if ordered:
        # Two intervals may share a policy: others are added, the best first.
        found.append(_greedy(returns, size, best_intervals(returns, size)))
    return np.sort(max(found, key=lambda book: _value(returns, book)))


def best_intervals(returns: np.ndarray, size: int) -> np.ndarray:
    """The policies of the best cut of ordered tasks into at most ``size`` intervals, by dynamic
    programming: their indices, ascending and each once.
    """
    n_tasks = len(returns)
    sums = np.concatenate([np.zeros((1, returns.shape[1])), np.cumsum(returns, axis=0)])
    # worth[s, t] is what the best policy for the tasks s, ..., t - 1 earns on them.
    worth = np.full((n_tasks + 1, n_tasks + 1), -np.inf)
    for start in range(n_tasks):
        worth[start, start + 1 :] = (sums[start + 1 :] - sums[start]).max(axis=1)
    best = np.full(n_tasks + 1, -np.inf)
    best[0] = 0.0
    cuts: list[np.ndarray] = []
    for _ in range(min(size, n_tasks)):
        totals = best[:, None] + worth
        cuts.append(np.argmax(totals, axis=0))
        best = totals.max(axis=0)
    chosen, end = set(), n_tasks
    for cut in reversed(cuts):
        start = int(cut[end])
        chosen.add(int(np.argmax(sums[end] - sums[start])))
        end = start
    return np.array(sorted(chosen))


def answer_capacity(noise: NoiseModel | None, spread: float, n_answers: int = 2) -> float:
    """The most that one answer can tell, whatever is asked: bits, in [0, log2(n_answers)].

    Left or right are a binary symmetric channel at the smallest probability of a mistake: of the
    probabilities that questions bring about only the extremes matter, and asking in the light of
    earlier answers adds nothing (Cover & Thomas, Elements of Information Theory, 7.12). Of more
    answers a mistake exchanges each with its opposite, a sum of such channels (problem 7.28); a
    Boltzmann oracle's grades tell no more than the difference that it perceives. Where one of four
    is best the channel is symmetric (7.2.1): r answers are probable, and 4 - r are not.

    >>> from sb3_poem.adaptation import MistakeNoise
    >>> round(answer_capacity(MistakeNoise(0.1), spread=1.0), 2)  # a tenth is wrong
    0.53

    :param spread: The largest difference of returns that a question can show: with a fixed
        ``beta`` an answer is the surer the larger it is.
    :param n_answers: See :func:`information_limit`, and for ``noise``.
    """
    check_whole("n_answers", n_answers, 2)
    if noise is None or isinstance(noise, ExactNoise):
        return float(np.log2(n_answers))
    if isinstance(noise, MistakeNoise):
        mistake = noise.rate
        rows = [[1.0 - mistake, *[mistake / 3] * 3]]
    elif isinstance(noise, BoltzmannNoise):
        # The paper's exponent, |R_left - R_right| / (|R_left| + |R_right|), is at most 1, and of
        # four, |R_i - R_j| / (2 mean |R|), at most 2.
        exponent = (1.0 + (n_answers == 4)) if noise.beta is None else noise.beta * spread
        if n_answers not in (2, 4):
            return min(float(np.log2(n_answers)), _logistic_capacity(exponent))
        mistake = float(0.5 * (1.0 - np.tanh(0.5 * exponent)))
        odds = np.exp(min(exponent, 700.0))
        rows = [[*[odds] * r, *[1.0] * (4 - r)] for r in (1, 2, 3)]
    else:
        known, name = "ExactNoise, MistakeNoise or BoltzmannNoise", type(noise).__name__
        raise ValueError(f"`noise_model` must be {known}, but is of type {name}")
    if n_answers == 4:
        said = np.array(rows) / np.sum(rows, axis=1, keepdims=True)
        return float(2.0 - entr(said).sum(axis=1).min() / np.log(2.0))
    told = 1.0 - float(entr([mistake, 1.0 - mistake]).sum()) / np.log(2.0)
    return float(np.log2(n_answers // 2 * 2.0**told + n_answers % 2))


def rate_distortion_limit(returns: np.ndarray, bits: float) -> float:
    """An upper bound on the mean return of any method that learns at most so many bits about which
    of the tasks it is: max E[J] over all ways p(j | i) to choose policies with mutual information
    I(i; j) <= bits, tasks being equally likely (Shannon 1959). It is the value of the dual problem,
    with the bound that holds at every iterate (Csiszar 1974): never too low.

    >>> rate_distortion_limit(np.eye(2), bits=1.0), rate_distortion_limit(np.eye(2), bits=0.0)
    (1.0, 0.5)

    :param returns: (n_tasks, n_policies), finite.
    """
    check_number("bits", bits, 0.0)
    returns = check_returns(returns)
    best = float(returns.max(axis=1).mean())
    scale = float(np.ptp(returns))
    if scale == 0.0 or bits >= np.log2(len(returns)):
        return best
    if bits == 0.0:
        return float(returns.mean(axis=0).max())
    scaled, nats = (returns - returns.max()) / scale, bits * np.log(2.0)

    def bound(log_slope: float) -> float:
        slope = float(np.exp(log_slope))
        return (nats + _best_marginal(scaled, slope)[1]) / slope

    # The dual is convex in 1 / slope, hence unimodal in its logarithm.
    bounds, options = (np.log(1e-2), np.log(1e5)), {"xatol": 1e-2}
    found = minimize_scalar(bound, bounds=bounds, method="bounded", options=options)
    return min(best, float(returns.max() + scale * found.fun))


def _value(returns: np.ndarray, book: np.ndarray) -> float:
    return float(returns[:, book].max(axis=1).mean())


def _greedy(returns: np.ndarray, size: int, first: Sequence[int] | np.ndarray = ()) -> np.ndarray:
    chosen = [int(policy) for policy in first]
    best = returns[:, chosen].max(axis=1, initial=-np.inf)
    for _ in range(size - len(chosen)):
        gains = np.maximum(returns, best[:, None]).mean(axis=0)
        gains[chosen] = -np.inf
        chosen.append(int(np.argmax(gains)))
        best = np.maximum(best, returns[:, chosen[-1]])
    return np.array(chosen)


def _swap(returns: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Replace one policy at a time by the best other one, as long as that helps."""
    chosen, value = chosen.copy(), _value(returns, chosen)
    for _ in range(MAX_SWAP_ROUNDS):
        before = value
        for position in range(len(chosen)):
            rest = returns[:, np.delete(chosen, position)].max(axis=1, initial=-np.inf)
            values = np.maximum(returns, rest[:, None]).mean(axis=0)
            candidate = int(np.argmax(values))
            if values[candidate] > value + 1e-12 * max(1.0, abs(value)):
                chosen[position], value = candidate, float(values[candidate])
        if value == before:
            break
    return chosen


def check_returns(returns: np.ndarray, axes: str = "(n_tasks, n_policies)") -> np.ndarray:
    """Returns of these two axes as float64; a ``ValueError`` if they are not finite, or none."""
    returns = np.asarray(returns, dtype=np.float64)
    if returns.ndim != 2 or 0 in returns.shape or not np.isfinite(returns).all():
        shape = f"but has shape {returns.shape}"
        raise ValueError(f"`returns` must be finite, {axes}, neither 0, {shape}")
    return returns


def _best_marginal(
    returns: np.ndarray, slope: float, marginal: np.ndarray | None = None
) -> tuple[np.ndarray, float]:
    """(n_policies,) how often each policy is taken at the maximum of slope E[J] - I(i; j) over
    p(j | i), and an upper bound on it, by the algorithm of Blahut and Arimoto.
    """
    best = returns.max(axis=1, keepdims=True)
    kernel = np.exp(slope * (returns - best))
    if marginal is None:
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
    return marginal, smallest + slope * float(best.mean())


def _logistic_capacity(amplitude: float) -> float:
    """Bits, an upper bound: what a number in [-amplitude, amplitude] with a logistic error of scale
    1 can tell, by the algorithm of Blahut and Arimoto.
    """
    inputs = np.linspace(-amplitude, amplitude, CHANNEL_INPUTS)
    edges = np.linspace(-amplitude - 12.0, amplitude + 12.0, CHANNEL_OUTPUTS - 1)
    below = 1.0 / (1.0 + np.exp(inputs[:, None] - edges))
    channel = np.diff(below, prepend=0.0, append=1.0, axis=1)  # (inputs, outputs)
    certainty = np.sum(channel * np.log(channel), axis=1)
    shares = np.full(CHANNEL_INPUTS, 1.0 / CHANNEL_INPUTS)
    for _ in range(MAX_ITERATIONS):
        told = certainty - channel @ np.log(shares @ channel)
        if told.max() - shares @ told < TOLERANCE:
            break
        shares = shares * np.exp(told - told.max())
        shares /= shares.sum()
    return float(told.max() / np.log(2.0))
