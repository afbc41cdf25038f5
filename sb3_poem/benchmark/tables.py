"""Tables of a suite, and its report: pure functions of what the store holds."""

import csv
import io
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_poem.benchmark.figures import write_figures
from sb3_poem.benchmark.methods import METHODS
from sb3_poem.benchmark.results import Condition, Selection, Series, summarise
from sb3_poem.benchmark.store import Store
from sb3_poem.benchmark.suites import EXACT, SUITES, Entry, OracleSpec, family_label

SUFFIX = {"md": ".md", "latex": ".tex", "csv": ".csv", "json": ".json"}
#: Table 3 of Xu & Zhu (ICML 2025): family -> row -> [mean, standard deviation] after 1, 5 and 10
#: queries
TABLE_3: dict[str, dict[str, list[list[int]]]] = json.loads(
    Path(__file__).with_name("paper_table3.json").read_text()
)
QUERIES = (1, 5, 10)


@dataclass(frozen=True, kw_only=True)
class Row:
    """A method, or a yardstick, after some number of answers; what CSV and JSON hold.

    :param kind: "method", "limit", "known", or "difference": what ``method`` earns more than
        ``against``, see :class:`Comparison`
    :param queries: After how many answers; None for "known"
    :param snapshot: The share of the training after which; None: all
    :param samples: Environment steps of the training, mean over seeds
    """

    suite: str
    family: str
    condition: str
    entry: str
    oracle: str
    method: str
    label: str
    kind: str
    queries: int | None = None
    snapshot: float | None = None
    samples: float | None = None
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
    against: str | None = None
    low: float | None = None
    high: float | None = None
    probability: float | None = None
    probability_low: float | None = None
    probability_high: float | None = None
    claim: str | None = None


@dataclass(frozen=True)
class Table:
    """A table to be printed: title, names of the columns, cells, and notes below."""

    title: str
    header: Sequence[str]
    rows: Sequence[tuple[str, ...]]
    notes: Sequence[str] = ()


def make_report(
    store: Store,
    suites: Sequence[str] | None = None,
    families: Sequence[str] | None = None,
    kind: str = "md",
    out: Path | None = None,
    seeds: Sequence[int] | None = None,
) -> tuple[str, list[Path]]:
    """Tables as text and, in the folder ``out``, written with the figures beside them. None takes
    all suites of which there is something, all families and all seeds.

    :param kind: "md", "latex", "csv" or "json".
    :raises ValueError: If the store holds nothing of what is asked for.
    """
    records = [record for record in store.records() if seeds is None or record.seed in seeds]
    narrowed = [*(families or []), *(f"seed {seed}" for seed in seeds or [])]
    texts: list[str] = []
    rows: list[Row] = []
    files: list[Path] = []
    for name in suites or SUITES:
        # A small family's cells belong to the suite that declares it, unless a suite is asked for
        # by its name.
        own = SUITES[name].families if suites is None and families is None else families
        selection = Selection(SUITES[name], records, own)
        if not any(
            selection.series(entry, condition)
            for entry in selection.suite.entries
            for condition in selection.conditions
        ):
            if suites:
                of = ", ".join(["it", *narrowed])
                raise ValueError(f"--suite {name}: {store.path} holds no finished cell of {of}")
            continue
        if kind in ("md", "latex"):
            text = format_tables(selection.suite.title, suite_tables(selection), kind)
        else:
            found = suite_rows(selection)
            text, rows = format_rows(found, kind), [*rows, *found]
        texts.append(text)
        if out is not None:
            file = out / f"{name}{SUFFIX[kind]}"
            file.write_text(text)
            files += [file, *write_figures(selection, out)]
    if not texts:
        own = [] if families else ["the suites' families (name others by --families)"]
        of = ", ".join([*own, *narrowed])
        raise ValueError(f"{store.path} holds no finished cell of {of}")
    return format_rows(rows, kind) if rows else "\n".join(texts), files


def suite_rows(selection: Selection) -> list[Row]:
    """Everything of a suite in long form."""
    return [
        row
        for condition in selection.conditions
        for entry in selection.suite.entries
        for oracle in entry.oracles
        for row in _rows(selection, condition, entry, oracle)
    ]


def suite_tables(selection: Selection) -> list[Table]:
    """A table for each family, comparison and oracle; and one of the models."""
    tables: list[Table] = []
    for condition in selection.conditions:
        for entry in selection.suite.entries:
            for oracle in entry.oracles:
                rows = list(_rows(selection, condition, entry, oracle))
                if rows:
                    tables.append(_comparison(entry, rows))
                if any(row.kind == "difference" for row in rows):
                    tables.append(_differences(entry, rows))
                if entry.by_task and any(row.success_rate is not None for row in rows):
                    tables.append(_successes(entry, rows))
        tables += _models(selection, condition)
    return tables


def format_tables(title: str, tables: Sequence[Table], kind: str) -> str:
    if kind == "md":
        return "\n\n".join([f"# {title}", *map(_markdown, tables)]) + "\n"
    head = f"% {title}; needs \\usepackage{{booktabs}}"
    return "\n\n".join([head, *map(_latex, tables)]) + "\n"


def format_rows(rows: Iterable[Row], kind: str) -> str:
    data = [vars(row) for row in rows]
    if kind == "json":
        return json.dumps(data, indent=1) + "\n"
    text = io.StringIO()
    writer = csv.DictWriter(text, list(Row.__dataclass_fields__), lineterminator="\n")
    writer.writeheader()
    writer.writerows(data)
    return text.getvalue()


def paper_figure(family: str, row: str | None, queries: int) -> tuple[Any, Any]:
    """Mean and standard deviation of a row of the paper's table; None, twice, if it has none."""
    figures = TABLE_3.get(family, {}).get(row or "")
    if figures is None or queries not in QUERIES:
        return None, None
    mean, deviation = map(float, figures[QUERIES.index(queries)])
    return mean, deviation


def _rows(
    selection: Selection, condition: Condition, entry: Entry, oracle: OracleSpec
) -> Iterator[Row]:
    """Of a table: methods, then the limits and known tasks of their models."""
    place: dict[str, Any] = {
        "suite": selection.suite.name,
        "family": condition.family,
        "condition": str(condition),
        "entry": entry.name,
        "oracle": oracle.label,
    }
    some = [one for one in selection.series(entry, condition) if one.oracle == oracle]
    for one in some:
        final = one.snapshot is None
        # The paper's figures are of the whole training and of its own answers.
        has_paper = final and oracle == EXACT and entry.name == "methods"
        rates = one.success_rates
        for i, queries in enumerate(one.queries):
            row = METHODS[one.method].paper_row if has_paper else None
            paper = paper_figure(family_label(condition.env_id), row, queries)
            yield Row(
                **place,
                method=one.method,
                label=one.label,
                kind="method",
                queries=queries,
                snapshot=one.snapshot,
                samples=one.samples,
                **vars(summarise(one.returns[:, :, i])),
                paper_mean=paper[0],
                paper_deviation=paper[1],
                success_rate=None if rates is None else rates[i],
            )
    ended = {one.method: one for one in some if one.snapshot is None}
    yield from _paired(place, entry, ended)
    variants = {METHODS[one.method].variant for one in some}
    for reference in selection.references(condition):
        if METHODS[reference.method].variant not in variants:
            continue
        of = {**place, "method": reference.method}
        limit = reference.label.replace("task known", "limit")
        for queries in () if entry.films else entry.record_at:
            measured = reference.limits(queries, oracle)
            if measured is not None:
                values = _over_seeds(measured)
                yield Row(**of, label=limit, kind="limit", queries=queries, **values)
        known = _over_seeds(reference.returns.mean(axis=1))
        rate = reference.success_rates
        yield Row(**of, label=reference.label, kind="known", **known, success_rate=rate)


def _paired(place: dict[str, Any], entry: Entry, found: dict[str, Series]) -> Iterator[Row]:
    """Each of the methods that the entry compares against every other, each pair once."""
    subjects = [name for name in entry.compared if name in found and not entry.by_task]
    for position, name in enumerate(subjects):
        for other, theirs in found.items():
            if other in subjects[: position + 1]:
                continue
            of = {**place, "method": name, "label": found[name].label, "against": other}
            for k in filter(entry.record_at.__contains__, entry.shown):
                versus = found[name].against(theirs, k)
                if versus is not None:
                    of |= {"queries": k, "claim": versus.claim, **vars(versus)}
                    yield Row(**of, kind="difference")


def _over_seeds(values: np.ndarray) -> dict[str, Any]:
    deviation = float(values.std(ddof=1)) if len(values) > 1 else None
    return {"n_seeds": len(values), "mean": float(values.mean()), "deviation": deviation}


def _comparison(entry: Entry, rows: Sequence[Row]) -> Table:
    """Methods against numbers of answers: what they earn, its spread, the paper's figure."""
    queries = [k for k in entry.shown if k in entry.record_at]
    has_paper = any(row.paper_mean is not None for row in rows)
    beside = "IQM [95 %]"
    also = "interquartile mean over seeds and tasks with its bootstrap interval"
    if entry.by_task:
        beside = "std. error over tasks"
        also = "standard error over tasks of their means over seeds"
    header = ["method", "seeds"]
    for k in queries:
        header += [_after(k), beside, *(["paper"] if has_paper else [])]
    header += [f"{n} films" for n in entry.films]
    body = []
    final = [row for row in rows if row.snapshot is None]
    for kind in ("method", "limit"):
        for label in dict.fromkeys(row.label for row in final if row.kind == kind):
            mine = {row.queries: row for row in final if row.label == label and row.kind == kind}
            first = next(iter(mine.values()))
            cells = [label, str(first.n_seeds)]
            for row in map(mine.__getitem__, queries):
                interval = (row.iqm_low, row.iqm_high)
                spread = _number(row.task_error) if entry.by_task else _number(row.iqm, *interval)
                cells += [_number(row.mean, row.deviation), spread]
                cells += [_number(row.paper_mean, row.paper_deviation)] * has_paper
            for n in entry.films:
                row = mine[n // METHODS[first.method].films]
                cells.append(_number(row.mean, row.deviation))
            body.append(tuple(cells))
    notes = [f"Mean and standard deviation over seeds; {also}."]
    notes += [
        f"{row.label}: {_number(row.mean, row.deviation)}" for row in final if row.kind == "known"
    ]
    if any(row.kind == "limit" for row in rows):
        notes.append(
            "A limit is what the best choice of those policies earns that so many of these "
            "answers can name: chosen on other tasks of the family, where dynamics are shared, and "
            "measured by other episodes. It binds no method with other policies, nor the reward "
            "oracle, which sees more than answers."
        )
    title = f"{rows[0].condition}; {entry.title.lower()}, {rows[0].oracle}"
    return Table(title, header, body, notes)


def _differences(entry: Entry, rows: Sequence[Row]) -> Table:
    """Paired differences, probabilities of improvement, and what may be said."""
    queries = [k for k in entry.shown if k in entry.record_at]
    header = ["method", "against", "seeds"]
    for k in queries:
        header += [_after(k), "IQM", "P(better)", ""]
    body = []
    paired = {(r.label, r.against, r.queries): r for r in rows if r.kind == "difference"}
    for label, against in dict.fromkeys(key[:2] for key in paired):
        some = [paired[label, against, k] for k in queries]
        cells = [label, METHODS[against or ""].label, str(some[0].n_seeds)]
        for row in some:
            chance = _shown(row.probability, ".2f")
            if row.probability_low is not None:
                chance += f" [{row.probability_low:.2f}, {row.probability_high:.2f}]"
            mean = _number(row.mean, row.low, row.high)
            cells += [mean, _number(row.iqm), chance, row.claim or ""]
        body.append(tuple(cells))
    notes = (
        "Differences of returns, paired by seed and test task: mean with its 95 % interval, "
        "interquartile mean, and the probability of improvement. Bootstrap over seeds and tasks. "
        "A method is ahead or behind if the mean, the interquartile mean and the whole interval of "
        "the mean say so.",
    )
    title = f"{rows[0].condition}; differences of {entry.title.lower()}, {rows[0].oracle}"
    return Table(title, header, body, notes)


def _successes(entry: Entry, rows: Sequence[Row]) -> Table:
    body = []
    for label in dict.fromkeys(row.label for row in rows if row.kind == "method"):
        mine = {row.queries: row.success_rate for row in rows if row.label == label}
        body.append((label, *(f"{mine[k]:.2f}" for k in entry.shown)))
    notes = [f"{row.label}: {row.success_rate:.2f}" for row in rows if row.kind == "known"]
    header = ("method", *map(_after, entry.shown))
    return Table(f"{rows[0].condition}; success rates", header, body, notes)


def _models(selection: Selection, condition: Condition) -> list[Table]:
    """How the models were trained, and how well they order policies: a table, if there are any."""
    references = selection.references(condition)
    records = [record for reference in references for record in reference.records]
    if not records:
        return []
    results = [record.result for record in records]
    models = [record.provenance["model"] for record in records]
    columns: dict[str, list[str]] = {
        "model": [METHODS[record.method].variant for record in records],
        "seed": [str(record.seed) for record in records],
        "source": [model["source"] for model in models],
        "samples": [f"{result['training_samples']:,}" for result in results],
        "updates": [f"{result['updates']:,}" for result in results],
        "seconds": [_shown(result["training_seconds"], ",.0f") for result in results],
        "CPU seconds": [_shown(result.get("training_cpu_seconds"), ",.0f") for result in results],
        "preference accuracy": [_shown(r.get("preference_accuracy"), ".3f") for r in results],
        "Kendall's tau": [_shown(r.get("kendall_tau"), ".3f") for r in results],
    }
    if not any(columns["CPU seconds"]):
        del columns["CPU seconds"]
    machines = sorted({record.provenance["machine"] for record in records})
    title, note = f"{condition.family}: the models{condition.version}", "; ".join(machines)
    rows = list(zip(*columns.values(), strict=True))
    return [Table(title, list(columns), rows, [f"Measured on: {note}."])]


def _after(k: int) -> str:
    return f"{k} answer{'s' * (k != 1)}"


def _shown(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _number(value: float | None, *beside: float | None) -> str:
    """With its deviation, or the two ends of its interval, unless that is None."""
    if value is None:
        return ""
    form = ",.0f" if abs(value) >= 1000 else ",.1f"
    others = [format(other, form) for other in beside if other is not None]
    shown = f" ± {others[0]}" if len(others) == 1 else f" [{', '.join(others)}]" if others else ""
    return format(value, form) + shown


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
    lines += [r"\bottomrule", r"\end{tabular}"]
    lines += [r"\par " + note.translate(escape) for note in table.notes]
    return "\n".join([*lines, r"\end{table}"])
