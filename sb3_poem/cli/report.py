"""What ``sb3-poem adapt`` says: the table, the JSON and the plot."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Column, Table
from scipy.stats import sem

from sb3_poem.adaptation import AdaptationEvaluation, KnownTaskReturn
from sb3_poem.adaptation.preference import BEST_OF_FOUR
from sb3_poem.benchmark.provenance import versions
from sb3_poem.cli.needs import say
from sb3_poem.cli.subject import after
from sb3_poem.common.files import write_json_atomically
from sb3_poem.plotting import plot_returns

HEADER = ("answers", "return", "std. error", "limit", "success rate")
TABLE_WIDTH = 76
#: Answers that tell policies apart, of questions that have more than two
KINDS_OF_ANSWERS = {"graded": 5, BEST_OF_FOUR: 4}


def write_report(
    title: str,
    settings: dict[str, Any],
    evaluation: AdaptationEvaluation,
    known: KnownTaskReturn | None,
    json_file: Path | None,
    plot_file: Path | None,
) -> None:
    """Print the table of what adapting earned, and write JSON and plot; without ``known`` it was
    interrupted.
    """
    limits, best = None, None
    kinds = KINDS_OF_ANSWERS.get(settings.get("question", "pair"), 2)
    facts = {"command": shlex.join(sys.orig_argv), "versions": versions(), **settings}
    facts |= evaluation.to_dict()
    if known is not None:
        limits = [known.limit(n, n_answers=kinds) for n in evaluation.record_at]
        best = known.mean_return
        facts |= {"limit": limits, "known_task_return": best}
        facts["known_task_returns"] = known.returns.mean(axis=1).tolist()
        if known.success_rate is not None:
            facts["known_task_success_rate"] = known.success_rate
    Console().print(_table(title, evaluation, known, limits, kinds))
    if json_file is not None:
        write_json_atomically(json_file, facts)
        say(f"Wrote {json_file}")
    if plot_file is not None:
        earned = (evaluation.record_at, evaluation.task_returns, limits)
        plot_returns(*earned, best, title=title, path=plot_file)
        say(f"Wrote {plot_file}")


def _table(
    title: str,
    evaluation: AdaptationEvaluation,
    known: KnownTaskReturn | None,
    limits: Sequence[float] | None,
    kinds: int,
) -> Table:
    rates, caption = evaluation.success_rates, None
    if known is not None:
        n, episodes = len(known.candidate_latents), known.returns.shape[1]
        caption = (
            f"task known: the best of {n} policies for each task, refined, and measured anew on "
            f"{episodes} episodes.\n"
            f"limit: the best {kinds}^answers of those {n}, chosen on other tasks where dynamics "
            "are shared, and measured anew: what error-free answers can name of these policies, "
            "no bound for methods with others."
        )
    names = HEADER[:-1] if rates is None else HEADER
    columns = [Column(name, justify="right") for name in names]
    look: dict[str, Any] = {"caption_justify": "left", "min_width": TABLE_WIDTH}
    table = Table(*columns, title=title, caption=caption, **look)
    missing: Any = [None] * len(evaluation.record_at)
    means = (evaluation.record_at, evaluation.mean_returns, standard_errors(evaluation))
    beside = (limits or missing, missing if rates is None else rates)
    rows: list[tuple[Any, ...]] = list(zip(*means, *beside, strict=True))
    if known is not None:
        rows.append(("task known", known.mean_return, np.nan, None, known.success_rate))
    for n, mean, error, limit, rate in rows:
        cells = [str(n), f"{mean:.1f}", "" if np.isnan(error) else f"{error:.1f}"]
        cells += ["" if limit is None else f"{limit:.1f}", "" if rate is None else f"{rate:.2f}"]
        table.add_row(*cells[: len(names)], end_section=n == evaluation.record_at[-1])
    return table


def row_text(evaluation: AdaptationEvaluation) -> str:
    """The last row of what was measured so far, in a line."""
    error, rates = standard_errors(evaluation)[-1], evaluation.success_rates
    text = f"{after(evaluation.record_at[-1])}: return {evaluation.mean_returns[-1]:.1f}"
    if not np.isnan(error):
        text += f", std. error {error:.1f}"
    return text if rates is None else f"{text}, success rate {rates[-1]:.2f}"


def standard_errors(evaluation: AdaptationEvaluation) -> np.ndarray:
    """(n_records,) of the mean return over tasks; NaN for one task."""
    returns = evaluation.task_returns
    return sem(returns) if len(returns) > 1 else np.full(returns.shape[1], np.nan)
