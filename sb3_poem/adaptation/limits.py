"""The most that k answers can give."""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np

# Up to this many codebooks are tried one by one; beyond, greedy choice and swaps.
EXACT_CODEBOOKS = 5000
MAX_SWAP_ROUNDS = 50


def information_limit(returns: np.ndarray, k: int) -> float:
    """
    The highest mean return that any method can reach with k binary answers.

    k answers tell at most 2^k tasks apart, so a method ends in one of at most 2^k policies; the best choice of those and,
    for every task, the best of them, bounds it. Found exactly where all codebooks can be tried (or where there is one
    policy for each task), else as a k-medoids optimum by greedy choice and swaps, which may lie slightly below the true
    bound.

    The bound holds for the tasks that are given: with 30 test tasks it ends at the known-task return after five
    answers. For a bound on the family take a dense grid of tasks.

    :param returns: (n_tasks, n_policies) return of each policy on each task.
    :param k: Number of answers.
    :return: The mean return over the tasks.
    :raises ValueError: If the matrix is empty or not finite, or k is negative.
    """
    if k < 0:
        raise ValueError(f"`k` must not be negative, but is {k}")
    returns = _check_returns(returns)
    n_tasks, n_policies = returns.shape
    if k >= 63 or 2**k >= min(n_tasks, n_policies):
        return float(returns.max(axis=1).mean())
    return float(returns[:, best_codebook(returns, 2**k)].max(axis=1).mean())


def best_codebook(returns: np.ndarray, size: int) -> np.ndarray:
    """
    The set of policies of a given size with the highest mean over tasks of the best return.

    :param returns: (n_tasks, n_policies).
    :param size: How many policies, at least 1.
    :return: (min(size, n_policies),) policy indices, ascending.
    :raises ValueError: If the matrix is empty or not finite, or the size is below 1.
    """
    returns = _check_returns(returns)
    if size < 1:
        raise ValueError(f"`size` must be at least 1, but is {size}")
    n_policies = returns.shape[1]
    if size >= n_policies:
        return np.arange(n_policies)
    if comb(n_policies, size) <= EXACT_CODEBOOKS:
        books = np.array(list(combinations(range(n_policies), size)))
        return books[np.argmax(returns[:, books].max(axis=2).mean(axis=0))]
    return np.sort(_swap(returns, _greedy(returns, size)))


def _greedy(returns: np.ndarray, size: int) -> np.ndarray:
    best = np.full(len(returns), -np.inf)
    chosen: list[int] = []
    for _ in range(size):
        gains = np.maximum(returns, best[:, None]).mean(axis=0)
        gains[chosen] = -np.inf
        chosen.append(int(np.argmax(gains)))
        best = np.maximum(best, returns[:, chosen[-1]])
    return np.array(chosen)


def _swap(returns: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Replace one policy at a time by the best other one, as long as that helps."""
    chosen = chosen.copy()
    value = returns[:, chosen].max(axis=1).mean()
    for _ in range(MAX_SWAP_ROUNDS):
        improved = False
        for position in range(len(chosen)):
            others = np.delete(chosen, position)
            rest = returns[:, others].max(axis=1) if len(others) else np.full(len(returns), -np.inf)
            values = np.maximum(returns, rest[:, None]).mean(axis=0)
            candidate = int(np.argmax(values))
            if values[candidate] > value + 1e-12 * max(1.0, abs(value)):
                chosen[position], value, improved = candidate, values[candidate], True
        if not improved:
            break
    return chosen


def _check_returns(returns: np.ndarray) -> np.ndarray:
    returns = np.asarray(returns, dtype=np.float64)
    if returns.ndim != 2 or 0 in returns.shape:
        raise ValueError(f"`returns` must have shape (n_tasks, n_policies), neither 0, but has shape {returns.shape}")
    if not np.isfinite(returns).all():
        raise ValueError("`returns` must be finite")
    return returns
