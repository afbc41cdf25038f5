"""Which policies to compare next, by a matrix of similarities; nothing loops over pairs."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np

QUERY_RULES = ("worst-case", "information-gain", "random")

# Differences that are compared at a time: all pairs' of a thousand candidates would take gigabytes.
BLOCK_ENTRIES = 2**17
# Pairs that are looked at for one question: each is rolled out.
MOST_LOOKS = 6

#: The share in [0, 1] of what the answer about a pair of policies tells, given by their numbers,
#: that is left when a person has to see their difference.
Visibility = Callable[[int, int], float]


def tolerance(epsilon: float) -> float:
    """How far S(z, z') may fall below S(z, z'') while eq. 9 still holds: log((1 + 2 epsilon) / (1 -
    2 epsilon)) >= 0. (The appendix's proof has the opposite sign, which would exclude the truth.)
    """
    return float(np.log1p(2.0 * epsilon) - np.log1p(-2.0 * epsilon))


def worst_case_sizes(
    similarities: np.ndarray, epsilon: float, weights: np.ndarray | None = None
) -> np.ndarray:
    """For each pair of policies, the larger of the two sets of latents that may survive the answer
    (eq. 10's objective), (n (n - 1) / 2,) in the order of ``numpy.triu_indices(n, 1)``.

    :param similarities: (m, n) S(z_i, z_j) of m latents and n policies.
    :param weights: (m,) a latent's weight; None counts each as one.
    """
    first, second = _pairs(similarities.shape[1])
    rows, slack = _policy_rows(similarities), tolerance(epsilon)
    sizes = np.empty(len(first))
    if weights is None:
        weights = np.ones(len(similarities))
    block = max(1, BLOCK_ENTRIES // len(similarities))
    for start in range(0, len(first), block):
        some = slice(start, start + block)
        difference = rows[first[some]] - rows[second[some]]
        sizes[some] = np.maximum((difference >= -slack) @ weights, (difference <= slack) @ weights)
    return sizes


def worst_case_pair(
    similarities: np.ndarray, epsilon: float, weights: np.ndarray | None = None
) -> tuple[int, int]:
    """The first pair of policies after whose worse answer the fewest latents survive (eq. 10); for
    the arguments see :func:`worst_case_sizes`.
    """
    sizes = worst_case_sizes(similarities, epsilon, weights)
    return pair_at(int(np.argmin(sizes)), similarities.shape[1])


def information_gains(probabilities: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Expected information gain of questions, (pairs,) in nats: the entropy of the answer minus its
    mean entropy under each of m latents, whose ``weights`` (m,) sum to one and who say LEFT with
    these probabilities (pairs, m).
    """
    weights = weights.astype(probabilities.dtype, copy=False)
    return _entropy(probabilities @ weights) - _entropy(probabilities) @ weights


def most_telling_pair(
    values: np.ndarray,
    weights: np.ndarray,
    differences: np.ndarray,
    probabilities: np.ndarray,
    visibility: Visibility | None = None,
) -> tuple[int, int]:
    """As :func:`best_pair` of :func:`information_gains`, where an answer is one of several.

    :param values: (m, n) predicted fitness.
    :param weights: (m,) summing to one.
    :param differences: (t,) evenly spaced, ascending, over all that two values can differ by.
    :param probabilities: (answers, t) of each answer at these differences.
    """
    step = differences[1] - differences[0]
    places = pair_differences(values / step)
    places -= np.float32(differences[0] / step)
    nearest = np.rint(places, out=places).astype(np.intp).clip(0, len(differences) - 1)
    table, weights = probabilities.astype(np.float32), weights.astype(np.float32)
    gains = -(_self_information(table).sum(axis=0)[nearest] @ weights)
    for each in table:
        gains += _self_information(each[nearest] @ weights)
    return best_pair(gains, values.shape[1], visibility)


def most_telling_set(
    pair: tuple[int, int],
    size: int,
    values: np.ndarray,
    weights: np.ndarray,
    probabilities: Callable[[np.ndarray], np.ndarray],
) -> tuple[int, ...]:
    """A pair of n policies, and as many others as make ``size``: each time the one with which the
    answer to which is best is expected to tell most. For the arguments see
    :func:`most_telling_pair`.

    :param probabilities: Maps differences of the first one's value to others', (rows, others), to
        P(answer), (answers, rows).
    """
    chosen, (m, n) = list(pair), values.shape
    while len(chosen) < size:
        differences = np.empty((n, m, len(chosen)), dtype=np.float32)
        differences[:, :, :-1] = values[:, chosen[:1]] - values[:, chosen[1:]]
        differences[:, :, -1] = (values[:, chosen[:1]] - values).T
        said = probabilities(differences.reshape(n * m, -1)).reshape(-1, n, m)
        gains = (_self_information(said @ weights) - _self_information(said) @ weights).sum(axis=0)
        gains[chosen] = -np.inf
        chosen.append(int(np.argmax(gains)))
    return tuple(chosen)


def best_pair(gains: np.ndarray, n: int, visibility: Visibility | None = None) -> tuple[int, int]:
    """The pair of n policies with the highest gain (in the order of :func:`pair_differences`) times
    visibility (None is 1). The pairs of the highest gains are looked at in turn, at most six, and
    no further than another could still be better.
    """
    order = np.argsort(-gains, kind="stable")[:MOST_LOOKS] if visibility else [np.argmax(gains)]
    best, highest = pair_at(int(order[0]), n), -np.inf
    for index in order:
        if gains[index] <= highest:
            break
        pair = pair_at(int(index), n)
        worth = float(gains[index]) * (visibility(*pair) if visibility else 1.0)
        if worth > highest:
            best, highest = pair, worth
    return best


def random_set(n: int, size: int, rng: np.random.Generator) -> tuple[int, ...]:
    """Different ones of n policies, uniformly."""
    return tuple(map(int, rng.choice(n, size=size, replace=False)))


def pair_differences(values: np.ndarray) -> np.ndarray:
    """What each of m latents says of each pair of n policies: (n (n - 1) / 2, m) the first one's
    value (m, n) minus the second's, pairs in the order of ``numpy.triu_indices(n, 1)``.
    """
    first, second = _pairs(values.shape[1])
    rows = _policy_rows(values)
    return rows[first] - rows[second]


def pair_at(index: int, n: int) -> tuple[int, int]:
    """The policies of a pair, by its place in the order of :func:`pair_differences`."""
    first, second = _pairs(n)
    return int(first[index]), int(second[index])


def _policy_rows(values: np.ndarray) -> np.ndarray:
    # Whole rows are gathered several times as fast as columns; networks compute in float32, too.
    return np.ascontiguousarray(values.T, dtype=np.float32)


@lru_cache(maxsize=16)
def _pairs(n: int) -> tuple[np.ndarray, np.ndarray]:
    return np.triu_indices(n, 1)


def _self_information(probability: np.ndarray) -> np.ndarray:
    """-p log p."""
    return -probability * np.log(np.maximum(probability, np.finfo(probability.dtype).tiny))


def _entropy(probability: np.ndarray) -> np.ndarray:
    smallest = np.finfo(probability.dtype).eps
    p = np.clip(probability, smallest, 1.0 - smallest)
    q = 1.0 - p
    p *= np.log(p)
    q *= np.log(q)
    p += q
    return np.negative(p, out=p)
