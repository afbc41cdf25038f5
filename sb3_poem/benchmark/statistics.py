"""Means over seeds, and interquartile means with bootstrap intervals by rliable."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from rliable import library, metrics
from scipy.stats import sem, trim_mean

BOOTSTRAP_SAMPLES = 2000


@dataclass(frozen=True)
class Summary:
    """What several seeds earned.

    :param n_seeds: How many.
    :param mean: Of the seeds' mean returns.
    :param deviation: Their standard deviation (n - 1); None for one seed.
    :param iqm: The interquartile mean over seeds and tasks.
    :param low: The lower end of its 95 % interval; None for one seed, and where none is wanted.
    :param high: The upper end.
    :param task_error: Standard error over tasks of their returns, means over seeds; None for one
        task.
    """

    n_seeds: int
    mean: float
    deviation: float | None
    iqm: float
    low: float | None
    high: float | None
    task_error: float | None


def summarise(returns: np.ndarray, intervals: bool = True) -> list[Summary]:
    """Summarise one method on one family after several numbers of answers.

    :param returns: (n_seeds, n_tasks, n_records) mean returns; column j is the same test task for
        all seeds.
    :param intervals: Whether intervals are wanted, which take about a second.
    :return: A summary for each record. The intervals are rliable's: percentiles of stratified
        bootstrap samples, which draw the seeds anew for every task.
    :raises ValueError: If the shape is wrong, or a value not finite.
    """
    returns = np.asarray(returns, dtype=np.float64)
    if returns.ndim != 3 or 0 in returns.shape or not np.isfinite(returns).all():
        raise ValueError(
            f"`returns` must be finite, (n_seeds, n_tasks, n_records), none 0, but has shape {returns.shape}"
        )
    seeds = returns.mean(axis=1)
    iqms = [float(metrics.aggregate_iqm(returns[:, :, i])) for i in range(returns.shape[2])]
    deviations = seeds.std(axis=0, ddof=1).tolist() if len(seeds) > 1 else [None] * len(iqms)
    low: list[float | None] = [None] * len(iqms)
    high = low
    if intervals and len(seeds) > 1:
        with _seeded(0):
            _, bounds = library.get_interval_estimates(
                {"method": returns}, _iqms, reps=BOOTSTRAP_SAMPLES
            )
        low, high = bounds["method"].tolist()
    tasks = returns.mean(axis=0)
    errors = sem(tasks).tolist() if len(tasks) > 1 else [None] * len(iqms)
    figures = zip(seeds.mean(axis=0).tolist(), deviations, iqms, low, high, errors, strict=True)
    return [Summary(len(returns), *figure) for figure in figures]


def _iqms(scores: np.ndarray) -> np.ndarray:
    """(n_seeds, n_tasks, n_records) -> (n_records,): rliable's interquartile mean of each record."""
    return trim_mean(scores.reshape(-1, scores.shape[2]), proportiontocut=0.25, axis=0)


@contextlib.contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """rliable draws from the global generator: seed it, so that a report is the same twice, and
    hand it back as it was.
    """
    state = np.random.get_state()  # noqa: NPY002
    np.random.seed(seed)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(state)  # noqa: NPY002
