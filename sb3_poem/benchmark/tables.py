"""Tables of a suite, as pure functions of what the store holds."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from sb3_poem.benchmark.methods import METHODS
from sb3_poem.benchmark.paper import paper_figure
from sb3_poem.benchmark.selection import Condition, Reference, Selection, Series
from sb3_poem.benchmark.statistics import Summary, summarise
from sb3_poem.benchmark.suites import EXACT, REVISION, Entry, OracleSpec


@dataclass(frozen=True)
class Row:
    """A method, or a yardstick, after some number of answers; what CSV and JSON hold.

    :param condition: What all methods had to spend.
    :param entry: The comparison.
    :param oracle: Who answered.
    :param method: The method; for a yardstick what it is.
    :param label: As in tables.
    :param kind: "method", "limit" or "known".
    :param queries: After how many answers; None for "known".
    :param snapshot: The share of the training after which; None: all.
    :param samples: Environment steps of the training, mean over seeds.
    :param n_seeds: How many seeds.
    :param mean: Mean over seeds.
    :param deviation: Standard deviation over seeds (n - 1).
    :param iqm: Interquartile mean over seeds and tasks.
    :param iqm_low: Of its 95 % interval.
    :param iqm_high: Of its 95 % interval.
    :param paper_mean: What the paper reports.
    :param paper_deviation: What the paper reports.
    :param task_error: Standard error over tasks of their returns, means over seeds.
    :param success_rate: Mean over seeds and tasks, where the family has successes.
    """

    suite: str
    family: str
    condition: str
    entry: str
    oracle: str
    method: str
    label: str
    kind: str
    queries: int | None
    snapshot: float | None
    samples: float | None
    n_seeds: int
    mean: float
    deviation: float | None = None
    iqm: float | None = None
    iqm_low: float | None = None
    iqm_high: float | None = None
    paper_mean: float | None = None
    paper_deviation: float | None = None
    task_error: float | None = None
    success_rate: float | None = None


@dataclass(frozen=True)
class Table:
    """A table to be printed.

    :param title: Above it.
    :param header: Names of the columns.
    :param rows: Cells.
    :param notes: Below it.
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()


def suite_rows(selection: Selection) -> list[Row]:
    """Everything of a suite in long form.

    :param selection: What there is.
    :return: The rows.
    """
    rows: list[Row] = []
    for condition in selection.conditions:
        references = selection.references(condition)
        for entry in selection.suite.entries:
            series = selection.series(entry, condition)
            for oracle in entry.oracles:
                some = [one for one in series if one.oracle == oracle]
                for one in some:
                    rows += _method_rows(selection.suite.name, condition, entry, one)
                variants = {METHODS[one.method].variant for one in some}
                own = [
                    reference
                    for reference in references
                    if METHODS[reference.method].variant in variants
                ]
                rows += _reference_rows(selection.suite.name, condition, entry, oracle, own)
    return rows


def suite_tables(selection: Selection) -> list[Table]:
    """A table for each family, comparison and oracle; and one of the models.

    :param selection: What there is.
    :return: The tables.
    """
    rows = suite_rows(selection)
    tables: list[Table] = []
    for condition in selection.conditions:
        for entry in selection.suite.entries:
            for oracle in entry.oracles:
                place = (str(condition), entry.name, oracle.label)
                some = [row for row in rows if (row.condition, row.entry, row.oracle) == place]
                if some:
                    tables.append(_comparison(condition, entry, oracle, some))
                if entry.by_task and any(row.success_rate is not None for row in some):
                    tables.append(_successes(condition, entry, some))
        models = _models(selection, condition)
        if models is not None:
            tables.append(models)
    return tables


def format_tables(title: str, tables: Sequence[Table], kind: str) -> str:
    """Tables as text.

    :param title: Of the whole.
    :param kind: "md" or "latex".
    :return: The text.
    :raises ValueError: If the format is neither.
    """
    if kind == "md":
        return "\n\n".join([f"# {title}", *map(_markdown, tables)]) + "\n"
    if kind == "latex":
        return (
            "\n\n".join([f"% {title}; needs \\usepackage{{booktabs}}", *map(_latex, tables)]) + "\n"
        )
    raise ValueError(f"`kind` must be 'md' or 'latex', but is {kind!r}")


def format_rows(rows: Iterable[Row], kind: str) -> str:
    """Rows as text.

    :param kind: "csv" or "json".
    :return: The text.
    :raises ValueError: If the format is neither.
    """
    data = [asdict(row) for row in rows]
    if kind == "json":
        return json.dumps(data, indent=1) + "\n"
    if kind == "csv":
        text = io.StringIO()
        writer = csv.DictWriter(text, list(Row.__dataclass_fields__), lineterminator="\n")
        writer.writeheader()
        writer.writerows(data)
        return text.getvalue()
    raise ValueError(f"`kind` must be 'csv' or 'json', but is {kind!r}")


def _method_rows(suite: str, condition: Condition, entry: Entry, series: Series) -> list[Row]:
    definition = METHODS[series.method]
    rows = []
    intervals = series.snapshot is None and not entry.by_task
    summaries = summarise(series.returns, intervals)
    successes = series.success_rates or [None] * len(summaries)
    for queries, summary, success in zip(series.queries, summaries, successes, strict=True):
        # The paper's figures are of the whole training and of its own answers.
        final = series.snapshot is None and series.oracle == EXACT and entry.name == "methods"
        paper = paper_figure(condition.family, definition.paper_row, queries) if final else None
        rows.append(
            Row(
                suite,
                condition.family,
                str(condition),
                entry.name,
                series.oracle.label,
                series.method,
                series.label,
                "method",
                queries,
                series.snapshot,
                series.samples,
                summary.n_seeds,
                *_figures(summary),
                *(paper or (None, None)),
                summary.task_error,
                success,
            )
        )
    return rows


def _figures(summary: Summary) -> tuple[float, float | None, float, float | None, float | None]:
    return summary.mean, summary.deviation, summary.iqm, summary.low, summary.high


def _reference_rows(
    suite: str,
    condition: Condition,
    entry: Entry,
    oracle: OracleSpec,
    references: Sequence[Reference],
) -> list[Row]:
    rows = []
    for reference in references:
        place = (
            suite,
            condition.family,
            str(condition),
            entry.name,
            oracle.label,
            reference.method,
        )
        label = reference.label.replace("task known", "limit")
        for queries in entry.record_at:
            limits = reference.limits(queries, oracle)
            rows.append(
                Row(
                    *place,
                    label,
                    "limit",
                    queries,
                    None,
                    None,
                    len(limits),
                    float(limits.mean()),
                    _deviation(limits),
                )
            )
        known = reference.known
        mean, deviation = float(known.mean()), _deviation(known)
        facts = (*place, reference.label, "known", None, None, None, len(known), mean, deviation)
        rows.append(Row(*facts, success_rate=reference.success_rate))
    return rows


def _deviation(values: np.ndarray) -> float | None:
    return float(values.std(ddof=1)) if len(values) > 1 else None


def _comparison(
    condition: Condition, entry: Entry, oracle: OracleSpec, rows: Sequence[Row]
) -> Table:
    """Methods against numbers of answers: mean and deviation, interquartile mean and interval, the
    paper's figure.
    """
    queries = [k for k in entry.shown if k in entry.record_at]
    beside = "std. error over tasks" if entry.by_task else "IQM [95 %]"
    has_paper = any(row.paper_mean is not None for row in rows)
    header = ["method", "seeds"]
    for k in queries:
        after = f"{k} answer{'s' * (k != 1)}"
        header += [after, beside, *(["paper"] if has_paper else [])]
    body = []
    final = [row for row in rows if row.snapshot is None]
    for kind in ("method", "limit"):
        for label in dict.fromkeys(row.label for row in final if row.kind == kind):
            mine = {row.queries: row for row in final if row.label == label and row.kind == kind}
            cells = [label, str(next(iter(mine.values())).n_seeds)]
            for k in queries:
                row = mine.get(k)
                if row is None:
                    cells += ["", ""]
                else:
                    spread = _number(row.task_error) if entry.by_task else _interval(row)
                    cells += [_mean(row.mean, row.deviation), spread]
                if has_paper:
                    cells.append(
                        ""
                        if row is None or row.paper_mean is None
                        else _mean(row.paper_mean, row.paper_deviation)
                    )
            body.append(tuple(cells))
    known = [
        f"{row.label}: {_mean(row.mean, row.deviation)}" for row in final if row.kind == "known"
    ]
    also = (
        "standard error over tasks of their means over seeds"
        if entry.by_task
        else "interquartile mean over seeds and tasks with its bootstrap interval"
    )
    notes = [f"Mean and standard deviation over seeds; {also}."]
    notes += known
    if any(row.kind == "limit" for row in rows):
        notes.append(
            "A limit is the most that so many of these answers allow with those policies, chosen with the test tasks in "
            "sight; it does not bind the reward oracle, which sees more than answers."
        )
    return Table(
        f"{condition}; {entry.title.lower()}, {oracle.label}",
        tuple(header),
        tuple(body),
        tuple(notes),
    )


def _successes(condition: Condition, entry: Entry, rows: Sequence[Row]) -> Table:
    """Success rates against numbers of answers."""
    body = []
    for label in dict.fromkeys(row.label for row in rows if row.kind == "method"):
        mine = {row.queries: row.success_rate for row in rows if row.label == label}
        body.append((label, *(f"{mine[k]:.2f}" for k in entry.shown)))
    notes = [f"{row.label}: {row.success_rate:.2f}" for row in rows if row.kind == "known"]
    header = ("method", *(f"{k} answer{'s' * (k != 1)}" for k in entry.shown))
    return Table(f"{condition}; success rates", header, tuple(body), tuple(notes))


def _models(selection: Selection, condition: Condition) -> Table | None:
    """How the models were trained, and how well they order policies."""
    references = selection.references(condition)
    records = [(one.method, record) for one in references for record in one.records]
    if not records:
        return None
    columns: dict[str, list[str]] = {
        "model": [METHODS[method].variant for method, _ in records],
        "seed": [str(record.seed) for _, record in records],
    }
    results = [record.result for _, record in records]
    models = [record.provenance["model"] for _, record in records]
    columns["source"] = [model["source"] for model in models]
    for name, key in (("samples", "training_samples"), ("updates", "updates")):
        columns[name] = [f"{result[key]:,}" for result in results]
    columns["seconds"] = [_seconds(result["training_seconds"]) for result in results]
    processor = [_seconds(result.get("training_cpu_seconds")) for result in results]
    if any(processor):
        columns["CPU seconds"] = processor
    for name, key in (
        ("preference accuracy", "preference_accuracy"),
        ("Kendall's tau", "kendall_tau"),
    ):
        orders = [result.get(key) for result in results]
        columns[name] = ["" if order is None else f"{order:.3f}" for order in orders]
    commits = [model.get("commit") or model.get("card", {}).get("commit", "") for model in models]
    columns["commit"] = list(map(str, commits))
    machines = sorted({record.provenance["machine"] for _, record in records})
    return Table(
        f"{condition.family}: the models"
        + (
            f", revision {condition.revision} of the code" if condition.revision != REVISION else ""
        ),
        tuple(columns),
        tuple(zip(*columns.values(), strict=True)),
        (f"Measured on: {'; '.join(machines)}.",),
    )


def _seconds(value: float | None) -> str:
    return "" if value is None else f"{value:,.0f}"


def _number(value: float | None) -> str:
    return "" if value is None else _mean(value, None)


def _mean(mean: float, deviation: float | None) -> str:
    digits = 0 if abs(mean) >= 1000 else 1
    return f"{mean:,.{digits}f}" + ("" if deviation is None else f" ± {deviation:,.{digits}f}")


def _interval(row: Row) -> str:
    if row.iqm is None:
        return ""
    digits = 0 if abs(row.iqm) >= 1000 else 1
    text = f"{row.iqm:,.{digits}f}"
    return (
        text
        if row.iqm_low is None
        else f"{text} [{row.iqm_low:,.{digits}f}, {row.iqm_high:,.{digits}f}]"
    )


def _markdown(table: Table) -> str:
    right = ["---"] + ["---:"] * (len(table.header) - 1)
    lines = ["| " + " | ".join(cells) + " |" for cells in (table.header, right, *table.rows)]
    return "\n\n".join([f"## {table.title}", "\n".join(lines), *table.notes])


def _latex(table: Table) -> str:
    escape = str.maketrans({"%": r"\%", "_": r"\_", "&": r"\&", "±": r"$\pm$", "#": r"\#"})
    lines = [r"\begin{table}", r"\centering", rf"\caption{{{table.title.translate(escape)}}}"]
    lines += [rf"\begin{{tabular}}{{l{'r' * (len(table.header) - 1)}}}", r"\toprule"]
    lines += [" & ".join(cell.translate(escape) for cell in table.header) + r" \\", r"\midrule"]
    lines += [" & ".join(cell.translate(escape) for cell in row) + r" \\" for row in table.rows]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table}"])
