"""What ``sb3-poem adapt`` says: the table, the JSON and the plot."""

import platform
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from sb3_poem.adaptation import AdaptationEvaluation, KnownTaskReturn
from sb3_poem.adaptation.state import write_json_atomically
from sb3_poem.plotting import plot_returns

VERSIONED = ("sb3_poem", "stable_baselines3", "torch", "gymnasium", "mujoco", "numpy")


@dataclass(frozen=True)
class Report:
    """
    The outcome of adapting a model.

    :param title: of the table and the plot
    :param settings: JSON-ready: the model, the environment, who answered and how it was asked
    :param evaluation: returns after numbers of answers
    :param known: returns if the tasks were known
    """

    title: str
    settings: dict[str, Any]
    evaluation: AdaptationEvaluation
    known: KnownTaskReturn

    @property
    def limits(self) -> list[float]:
        """The most that any method can earn from so many error-free answers on these tasks, (n_records,)."""
        return [self.known.limit(n) for n in self.evaluation.record_at]

    def table(self) -> Table:
        """Return, its standard error over tasks, the limit and, where a family has it, the success rate after each answer."""
        table = Table(title=self.title, caption="limit: the most that any method can earn from so many error-free answers")
        rates = self.evaluation.success_rates
        for name in ("answers", "return", "std. error", "limit", *(() if rates is None else ("success rate",))):
            table.add_column(name, justify="right")
        returns = self.evaluation.task_returns
        errors = returns.std(axis=0, ddof=1) / np.sqrt(len(returns)) if len(returns) > 1 else np.full(returns.shape[1], np.nan)
        means = returns.mean(axis=0)
        for row, (n, mean, error, limit) in enumerate(zip(self.evaluation.record_at, means, errors, self.limits, strict=True)):
            rate = [] if rates is None else [f"{rates[row]:.2f}"]
            table.add_row(str(n), f"{mean:.1f}", "" if np.isnan(error) else f"{error:.1f}", f"{limit:.1f}", *rate)
        table.add_section()
        rate = [] if self.known.success_rate is None else [f"{self.known.success_rate:.2f}"]
        table.add_row("task known", f"{self.known.mean_return:.1f}", "", "", *rate)
        return table

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready: every task's return after every answer, the limit, the known-task return, and how it came about."""
        return {
            "command": " ".join(sys.orig_argv),
            "versions": {"python": platform.python_version(), **{name: version(name) for name in VERSIONED}},
            **self.settings,
            **self.evaluation.to_dict(),
            "limit": self.limits,
            "known_task_return": self.known.mean_return,
            "known_task_returns": self.known.returns.mean(axis=1).tolist(),
            **({} if self.known.success_rate is None else {"known_task_success_rate": self.known.success_rate}),
        }

    def write(self, console: Console, json_file: Path | None, plot_file: Path | None) -> None:
        """
        Print the table and write the files that were asked for.

        :param console: where to print
        :param json_file: for :meth:`to_dict`
        :param plot_file: for the return against the number of answers
        """
        console.print(self.table())
        if json_file is not None:
            write_json_atomically(json_file, self.to_dict())
            console.print(f"Wrote {json_file}")
        if plot_file is not None:
            evaluation = self.evaluation
            plot_returns(
                evaluation.record_at,
                evaluation.task_returns,
                self.limits,
                self.known.mean_return,
                title=self.title,
                path=plot_file,
            )
            console.print(f"Wrote {plot_file}")


def describe_task(task: Sequence[float] | np.ndarray) -> str:
    """A task's numbers in one line."""
    return ", ".join(f"{value:.3g}" for value in task)
