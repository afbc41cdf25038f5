"""Figures of what adaptation earned."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_returns(
    queries: Sequence[int],
    returns: np.ndarray,
    limit: Sequence[float] | np.ndarray | None = None,
    known_task: float | None = None,
    title: str | None = None,
    label: str = "adapted policy",
    path: str | Path | None = None,
) -> "Figure":
    """Return against the number of preference queries, beside what could be reached.

    >>> returns = np.array([[-4.0, -2.0, -1.0], [-5.0, -2.5, -1.0]])  # of two tasks
    >>> figure = plot_returns([0, 5, 10], returns, limit=[-4.0, -1.5, -0.9], path="returns.png")

    :param queries: (n_records,) the numbers of answers after which the policy was evaluated
    :param returns: (n_tasks, n_records) every test task's return; the band is the standard error
        over tasks
    :param limit: (n_records,) the best that so many error-free answers allow
        (:func:`information_limit`)
    :param known_task: The return of the best policy for each task, had the task been known
    :param label: Of the adapted policy's line
    :param path: Where to save the figure; the suffix names the format
    :raises ValueError: If the shapes do not fit
    """
    # the object interface: a figure of pyplot would stay in its list, and choose a window system
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    returns, n = np.asarray(returns, dtype=np.float64), len(queries)
    if returns.ndim != 2 or returns.shape[1] != n or len(returns) == 0:
        needed = f"(n_tasks, {n}), one column per entry of queries"
        raise ValueError(f"returns must be {needed}, got {returns.shape}")
    if limit is not None and len(limit) != n:
        raise ValueError(f"limit needs one value per entry of queries ({n}), got {len(limit)}")
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()

    mean = returns.mean(axis=0)
    axes.plot(queries, mean, marker="o", color="C0", label=label, zorder=3)
    if len(returns) > 1:
        error = returns.std(axis=0, ddof=1) / np.sqrt(len(returns))
        axes.fill_between(queries, mean - error, mean + error, color="C0", alpha=0.2, linewidth=0)
    if limit is not None:
        words = "limit of so many answers"
        axes.plot(queries, limit, linestyle="--", marker=".", color="C3", label=words)
    if known_task is not None:
        axes.axhline(known_task, linestyle=":", color="0.3", label="task known")

    axes.set_xlabel("preference queries answered")
    axes.set_ylabel("return per episode")
    axes.set_xticks(list(queries))
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="lower right")
    if title is not None:
        axes.set_title(title)

    if path is not None:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)
    return figure
