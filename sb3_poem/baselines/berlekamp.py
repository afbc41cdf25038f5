"""Twenty questions with lies: how many ways there are for the answers still to come (Berlekamp
1968).
"""

from __future__ import annotations

from math import comb

import numpy as np


def berlekamp_volumes(contradictions: np.ndarray, n_left: int, budget: int) -> np.ndarray:
    """In how many ways the ``n_left`` answers to come (K - k) may lie without exceeding the budget
    (E), if a candidate is the truth that contradicts so many answers (m): sum over e = 0, ..., E -
    m of C(n_left, e); 0 where m exceeds E.
    """
    by_lies_left = np.cumsum([float(comb(n_left, lies)) for lies in range(budget + 1)])
    lies_left = budget - np.asarray(contradictions)
    return np.where(lies_left >= 0, by_lies_left[np.maximum(lies_left, 0)], 0.0)


def worst_case_volumes(
    differences: np.ndarray, contradictions: np.ndarray, n_left: int, budget: int
) -> np.ndarray:
    """(n_pairs,) the volume that the worse of two answers leaves, over all candidates, with
    ``n_left`` questions to come after it.

    :param differences: (n_candidates, n_pairs) predicted return of the left fragment minus that of
        the right one.
    """
    kept = berlekamp_volumes(contradictions, n_left, budget)
    lost = kept - berlekamp_volumes(contradictions + 1, n_left, budget)
    after_left = kept.sum() - lost @ (differences < 0)
    after_right = kept.sum() - lost @ (differences > 0)
    return np.maximum(after_left, after_right)


def n_distinguishable(n_queries: int, budget: int) -> int:
    """How many candidates so many answers with so many lies can tell apart at most (the
    sphere-packing bound): 2^K over the number of ways to lie, rounded down.
    """
    return 2**n_queries // sum(comb(n_queries, lies) for lies in range(budget + 1))
