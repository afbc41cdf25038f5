"""What ``sb3-poem adapt`` says: the table, the JSON and the plot."""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.stats import sem

from sb3_poem.adaptation import AdaptationEvaluation, KnownTaskReturn
from sb3_poem.adaptation.preference import BEST_OF_FOUR
from sb3_poem.adaptation.state import write_json_atomically
from sb3_poem.benchmark.provenance import versions
from sb3_poem.plotting import plot_returns

TABLE_WIDTH = 76


@dataclass(frozen=True)
class Report:
    """The outcome of adapting a model, JSON-ready ``settings``; incomplete without ``known``."""

    title: str
    settings: dict[str, Any]
    evaluation: AdaptationEvaluation
    known: KnownTaskReturn | None

    @property
    def limits(self) -> list[float] | None:
        """What k exact answers allow among the policies that were tried, (n_records,)."""
        if self.known is None:
            return None
        kinds = self._kinds_of_answers
        return [self.known.limit(n, n_answers=kinds) for n in self.evaluation.record_at]

    @property
    def _kinds_of_answers(self) -> int:
        return {"graded": 5, BEST_OF_FOUR: 4}.get(self.settings.get("question", "pair"), 2)

    def table(self) -> Table:
        """Return, its standard error over tasks, limit and success rate after each answer."""
        known, limits = self.known, self.limits
        rates = self.evaluation.success_rates
        look: dict[str, Any] = {"caption_justify": "left", "min_width": TABLE_WIDTH}
        table = Table(title=self.title, caption=self._caption(), **look)
        names = ["answers", "return", "std. error", "limit"]
        for name in names if rates is None else [*names, "success rate"]:
            table.add_column(name, justify="right")
        for row, (n, mean, error) in enumerate(_means(self.evaluation)):
            limit = "" if limits is None else f"{limits[row]:.1f}"
            rate = [] if rates is None else [f"{rates[row]:.2f}"]
            spread = "" if np.isnan(error) else f"{error:.1f}"
            table.add_row(str(n), f"{mean:.1f}", spread, limit, *rate)
        if known is not None:
            table.add_section()
            rate = [] if known.success_rate is None else [f"{known.success_rate:.2f}"]
            table.add_row("task known", f"{known.mean_return:.1f}", "", "", *rate)
        return table

    def _caption(self) -> str | None:
        if self.known is None:
            return None
        n, episodes = len(self.known.candidate_latents), self.known.returns.shape[1]
        return (
            f"task known: the best of {n} policies for each task, refined, and measured anew on "
            f"{episodes} episodes.\n"
            f"limit: the best {self._kinds_of_answers}^answers of those {n}, chosen on other tasks "
            "where dynamics are shared, and measured anew: what error-free answers can name of "
            "these policies, no bound for methods with others."
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready: every task's return after every answer, limits, and how it came about."""
        return {
            "command": " ".join(sys.orig_argv),
            "versions": versions(),
            **self.settings,
            **self.evaluation.to_dict(),
            **self._known_to_dict(),
        }

    def _known_to_dict(self) -> dict[str, Any]:
        if self.known is None:
            return {}
        rate = self.known.success_rate
        return {
            "limit": self.limits,
            "known_task_return": self.known.mean_return,
            "known_task_returns": self.known.returns.mean(axis=1).tolist(),
            **({} if rate is None else {"known_task_success_rate": rate}),
        }

    def write(self, console: Console, json_file: Path | None, plot_file: Path | None) -> None:
        """Print the table, and write what was asked for: :meth:`to_dict`, and a plot."""
        console.print(self.table())
        if json_file is not None:
            write_json_atomically(json_file, self.to_dict())
            console.print(f"Wrote {json_file}")
        if plot_file is not None:
            known = None if self.known is None else self.known.mean_return
            earned = (self.evaluation.record_at, self.evaluation.task_returns)
            plot_returns(*earned, self.limits, known, title=self.title, path=plot_file)
            console.print(f"Wrote {plot_file}")


def row_text(evaluation: AdaptationEvaluation) -> str:
    """The last row of what was measured so far, in a line."""
    n, mean, error = list(_means(evaluation))[-1]
    text = f"after {n} answer{'s' * (n != 1)}: return {mean:.1f}"
    if not np.isnan(error):
        text += f", std. error {error:.1f}"
    rates = evaluation.success_rates
    return text if rates is None else f"{text}, success rate {rates[-1]:.2f}"


def _means(evaluation: AdaptationEvaluation) -> Iterator[tuple[int, float, float]]:
    """Number of answers, mean return over tasks, its standard error (NaN for one task)."""
    returns = evaluation.task_returns
    nothing = np.full(returns.shape[1], np.nan)
    errors = sem(returns) if len(returns) > 1 else nothing
    return zip(evaluation.record_at, returns.mean(axis=0), errors, strict=True)
