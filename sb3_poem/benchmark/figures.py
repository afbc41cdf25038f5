"""Figures of a suite, as pure functions of what the store holds: return against queries, samples
and tolerance.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_poem.benchmark.methods import INFERENCE_LABELS, METHODS
from sb3_poem.benchmark.selection import Condition, Reference, Selection, Series
from sb3_poem.benchmark.suites import Entry, OracleSpec

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".pdf")
PANEL_WIDTH, PANEL_HEIGHT = 4.2, 3.0
TOLERANCE = "tolerance"
COLOURS = {
    "poem-bayes": "#d62728",
    "poem-paper": "#ff7f0e",
    "anole": "#1f77b4",
    "anole-greedy": "#17becf",
    "anole-random": "#9467bd",
    "maml-reward": "#8c564b",
    "reward-oracle": "#2ca02c",
}
OTHER_COLOURS = ("#1f77b4", "#2ca02c", "#9467bd", "#8c564b", "#e377c2", "#17becf", "#bcbd22")
MARKERS = "osD^vPX*"


def write_figures(selection: Selection, folder: Path) -> list[Path]:
    """Write all figures of a suite, each as PNG and PDF.

    :param selection: What there is.
    :param folder: Where.
    :return: The files.
    """
    files = []
    for name, figure in suite_figures(selection).items():
        for suffix in SUFFIXES:
            path = folder / f"{name}{suffix}"
            # Without the time of writing the same store gives the same file.
            figure.savefig(
                path,
                dpi=150,
                metadata={"CreationDate": None} if suffix == ".pdf" else {"Software": None},
            )
            files.append(path)
    return files


def suite_figures(selection: Selection) -> dict[str, Figure]:
    """The figures of a suite, by name. Families stand side by side.

    :param selection: What there is.
    :return: The figures.
    """
    figures = {}
    for entry in selection.suite.entries:
        by_condition = {
            condition: selection.series(entry, condition) for condition in selection.conditions
        }
        references = {
            condition: selection.references(condition) for condition in selection.conditions
        }
        base = f"{selection.suite.name}-{entry.name}"
        if entry.name == TOLERANCE:
            figure = _tolerance_figure(entry, by_condition)
            if figure is not None:
                figures[base] = figure
            continue
        for oracle in entry.oracles:
            name = base if len(entry.oracles) == 1 else f"{base}-{_slug(oracle)}"
            figures |= _figures_of(name, entry, oracle, by_condition, references)
    return figures


def _figures_of(
    name: str,
    entry: Entry,
    oracle: OracleSpec,
    by_condition: dict[Condition, list[Series]],
    references: dict[Condition, list[Reference]],
) -> dict[str, Figure]:
    """Return against queries, and if it was measured against samples."""
    mine = {
        condition: some
        for condition, series in by_condition.items()
        if (some := [one for one in series if one.oracle == oracle])
    }
    if not mine:
        return {}
    rows = list(INFERENCE_LABELS.values()) if entry.by_inference else [""]
    figures = {}
    kinds = {"queries": _draw_queries}
    if any(one.snapshot is not None for series in mine.values() for one in series):
        kinds["samples"] = _draw_samples
    for kind, draw in kinds.items():
        figure, panels = _grid(len(rows), len(mine))
        for column, (condition, series) in enumerate(mine.items()):
            for row, prefix in enumerate(rows):
                axes = panels[row][column]
                some = [one for one in series if one.label.startswith(prefix)]
                draw(axes, some, entry, oracle, references[condition])
                _title(axes, condition, prefix)
        after = f"; return after {max(entry.record_at)} queries" if kind == "samples" else ""
        _finish(figure, panels, f"{entry.title}, {oracle.label}{after}")
        figures[f"{name}-{kind}"] = figure
    return figures


def _draw_queries(
    axes: Axes,
    series: Sequence[Series],
    entry: Entry,
    oracle: OracleSpec,
    references: Sequence[Reference],
) -> None:
    for one in series:
        if one.snapshot is None:
            _line(axes, one.queries, one.returns.mean(axis=1), entry, one.method, one.label)
    variants = {METHODS[one.method].variant for one in series}
    shown = [
        reference
        for reference in references
        if METHODS[reference.method].variant == "poem" and "poem" in variants
    ]
    for reference in shown:
        limits = [float(reference.limits(k, oracle).mean()) for k in entry.record_at]
        axes.plot(
            entry.record_at,
            limits,
            color="0.25",
            linestyle="--",
            linewidth=1.2,
            label="limit (POEM's policies)",
        )
        known = float(reference.known.mean())
        axes.axhline(
            known, color="0.5", linestyle=":", linewidth=1.2, label="task known (POEM's policies)"
        )
    axes.set_xlabel("preference queries")
    axes.set_xticks(
        [k for k in entry.record_at if k % (1 if len(entry.record_at) < 12 else 5) == 0]
    )


def _draw_samples(
    axes: Axes,
    series: Sequence[Series],
    entry: Entry,
    oracle: OracleSpec,
    references: Sequence[Reference],
) -> None:
    last = max(entry.record_at)
    for method in dict.fromkeys(one.method for one in series):
        mine = sorted(
            (one for one in series if one.method == method and one.at(last) is not None),
            key=lambda one: one.samples,
        )
        if len(mine) == 1 and mine[0].snapshot is None:  # not measured along the training
            returns = mine[0].at(last)
            assert returns is not None
            level = float(returns.mean())
            axes.axhline(
                level,
                color=_colour(entry, method),
                linestyle="-.",
                linewidth=1.4,
                label=f"{mine[0].label}, at the end",
            )
            continue
        points = [(one.samples, one.at(last)) for one in mine]
        means = [float(returns.mean()) for _, returns in points if returns is not None]
        deviations = [_deviation(returns) for _, returns in points if returns is not None]
        _band(
            axes,
            [samples for samples, _ in points],
            np.array(means),
            np.array(deviations),
            entry,
            method,
            mine[0].label,
        )
    axes.set_xlabel("environment steps of the training, thousands")
    axes.xaxis.set_major_formatter(lambda steps, position: f"{steps / 1000:g}")


def _tolerance_figure(entry: Entry, by_condition: dict[Condition, list[Series]]) -> Figure | None:
    """Return against epsilon, a row for each oracle."""
    conditions = {condition: series for condition, series in by_condition.items() if series}
    if not conditions:
        return None
    figure, panels = _grid(len(entry.oracles), len(conditions))
    for row, oracle in enumerate(entry.oracles):
        for column, (condition, series) in enumerate(conditions.items()):
            axes = panels[row][column]
            some = [one for one in series if one.oracle == oracle]
            for position, queries in enumerate((1, 5, 10)):
                points = [
                    (_epsilon(one), returns)
                    for one in some
                    if (returns := one.at(queries)) is not None
                ]
                if points:
                    means = np.array([returns.mean() for _, returns in points])
                    deviations = np.array([_deviation(returns) for _, returns in points])
                    label = f"{queries} quer{'ies' if queries > 1 else 'y'}"
                    _draw_band(
                        axes,
                        [e for e, _ in points],
                        means,
                        deviations,
                        f"C{position}",
                        MARKERS[position],
                        label,
                    )
            axes.set_xlabel("tolerance epsilon")
            _title(axes, condition, oracle.label)
    _finish(figure, panels, entry.title)
    return figure


def _epsilon(series: Series) -> float:
    return float(METHODS[series.method].options.get("epsilon", 0.1))


def _line(
    axes: Axes, x: Sequence[float], by_seed: np.ndarray, entry: Entry, method: str, label: str
) -> None:
    """One line with the deviation over seeds; ``by_seed`` is (n_seeds, n_points)."""
    deviations = by_seed.std(axis=0, ddof=1) if len(by_seed) > 1 else np.zeros(by_seed.shape[1])
    _band(axes, x, by_seed.mean(axis=0), deviations, entry, method, label)


def _band(
    axes: Axes,
    x: Sequence[float],
    means: np.ndarray,
    deviations: np.ndarray,
    entry: Entry,
    method: str,
    label: str,
) -> None:
    names = (
        list(dict.fromkeys(map(_change, entry.methods)))
        if entry.by_inference
        else list(entry.methods)
    )
    marker = MARKERS[names.index(_change(method) if entry.by_inference else method) % len(MARKERS)]
    _draw_band(axes, x, means, deviations, _colour(entry, method), marker, label)


def _draw_band(
    axes: Axes,
    x: Sequence[float],
    means: np.ndarray,
    deviations: np.ndarray,
    colour: str,
    marker: str,
    label: str,
) -> None:
    axes.plot(
        x, means, color=colour, marker=marker, markersize=4, linewidth=1.6, label=label, zorder=3
    )
    axes.fill_between(
        x, means - deviations, means + deviations, color=colour, alpha=0.1, linewidth=0
    )


def _colour(entry: Entry, method: str) -> str:
    others = [name for name in entry.methods if name not in COLOURS]
    if method in COLOURS:
        return COLOURS[method]
    # With a row for each inference rule the same change has the same colour in both.
    if entry.by_inference:
        changes = list(dict.fromkeys(_change(name) for name in others))
        return OTHER_COLOURS[changes.index(_change(method)) % len(OTHER_COLOURS)]
    return OTHER_COLOURS[others.index(method) % len(OTHER_COLOURS)]


def _change(method: str) -> str:
    """What differs from POEM, without the inference rule."""
    return "-".join(word for word in method.split("-") if word not in INFERENCE_LABELS)


def _deviation(returns: np.ndarray) -> float:
    """Over the seeds of (n_seeds, n_tasks)."""
    return float(returns.mean(axis=1).std(ddof=1)) if len(returns) > 1 else 0.0


def _grid(rows: int, columns: int) -> tuple[Figure, list[list[Axes]]]:
    # The object interface: a figure of pyplot would stay in its global list, and choose a window
    # system.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(
        figsize=(max(6.0, PANEL_WIDTH * columns), PANEL_HEIGHT * rows + 1.2), layout="constrained"
    )
    FigureCanvasAgg(figure)
    panels: Any = figure.subplots(rows, columns, squeeze=False)
    return figure, panels.tolist()


def _title(axes: Axes, condition: Condition, detail: str) -> None:
    axes.set_title(f"{condition.family}{', ' * bool(detail)}{detail}", fontsize=10)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def _finish(figure: Figure, panels: list[list[Axes]], title: str) -> None:
    """One legend for all panels, below them."""
    entries: dict[str, Any] = {}
    for row in panels:
        row[0].set_ylabel("return per episode")
        for axes in row:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                for prefix in INFERENCE_LABELS.values():
                    if len(panels) > 1 and label.startswith(f"{prefix}, "):
                        label = label.removeprefix(f"{prefix}, ")
                entries.setdefault(label, handle)
    figure.suptitle(title, fontsize=11)
    columns = 2 * len(panels[0]) + 1
    figure.legend(
        entries.values(),
        entries.keys(),
        loc="outside lower center",
        ncols=min(columns, 4),
        frameon=False,
        fontsize=8,
    )


def _slug(oracle: OracleSpec) -> str:
    return oracle.kind if oracle.value is None else f"{oracle.kind}-{oracle.value:g}"
