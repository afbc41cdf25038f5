"""Figures of a suite: return against queries, samples and tolerance."""

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sb3_poem.benchmark.methods import INFERENCE_LABELS, METHODS
from sb3_poem.benchmark.results import Condition, Selection, Series
from sb3_poem.benchmark.suites import TABLE_METHODS, Entry, OracleSpec

PANEL_WIDTH, PANEL_HEIGHT = 4.2, 3.0
TOLERANCE = "tolerance"
COLOURS = 10  # of Matplotlib
MARKERS = "osD^vPX*"
#: Words of a method's name that leave its looks as they are
CONDITIONS = ("aggregate", "prior", "decoder", "untold")


def write_figures(selection: Selection, folder: Path) -> list[Path]:
    """Write all figures of a suite to a folder, each as PNG and PDF, and return the files."""
    files = []
    for name, figure in suite_figures(selection).items():
        # Without the time of writing the same store gives the same file.
        for suffix, unknown in ((".png", "Software"), (".pdf", "CreationDate")):
            files.append(folder / f"{name}{suffix}")
            figure.savefig(files[-1], dpi=150, metadata={unknown: None})
    return files


def suite_figures(selection: Selection) -> dict[str, Figure]:
    """The figures of a suite, by name. Families stand side by side."""
    figures = {}
    for entry in selection.suite.entries:
        name = f"{selection.suite.name}-{entry.name}"
        found = {one: selection.series(entry, one) for one in selection.conditions}
        if entry.name.startswith(TOLERANCE):
            if any(found.values()):
                figures[name] = _tolerance_figure(entry, found)
            continue
        for oracle in entry.oracles:
            mine = {
                condition: some
                for condition, series in found.items()
                if (some := [one for one in series if one.oracle == oracle])
            }
            value = "" if oracle.value is None else f"-{oracle.value:g}"
            full = name if len(entry.oracles) == 1 else f"{name}-{oracle.kind}{value}"
            ended = [one.snapshot is None for series in mine.values() for one in series]
            if any(ended):
                figures[f"{full}-queries"] = _queries_figure(entry, oracle, mine, selection)
            if not all(ended):
                figures[f"{full}-samples"] = _samples_figure(entry, oracle, mine)
    return figures


def _queries_figure(
    entry: Entry, oracle: OracleSpec, found: dict[Condition, list[Series]], selection: Selection
) -> Figure:
    figure, panels = _grid(entry, found)
    for axes, condition, series in panels:
        for one in series:
            if one.snapshot is None:
                by_seed = list(one.returns.mean(axis=1).T)
                _draw(axes, one.queries, by_seed, one.label, _style(entry, one))
        has_poem = any(METHODS[one.method].variant == "poem" for one in series)
        for reference in selection.references(condition):
            if has_poem and METHODS[reference.method].variant == "poem":
                _draw_yardsticks(axes, reference, entry, oracle)
        ticks = 1 if len(entry.record_at) < 12 else 5
        axes.set(xlabel="preference queries", xticks=[k for k in entry.record_at if k % ticks == 0])
    return _finish(figure, f"{entry.title}, {oracle.label}")


def _draw_yardsticks(axes: Axes, reference: Series, entry: Entry, oracle: OracleSpec) -> None:
    looks: dict[str, Any] = {"color": "0.25", "linestyle": "--", "label": "limit (POEM's policies)"}
    if not entry.films:
        measured = [reference.limits(k, oracle) for k in entry.record_at]
        limits = [np.nan if values is None else float(values.mean()) for values in measured]
        axes.plot(entry.record_at, limits, linewidth=1.2, **looks)
    looks = {"color": "0.5", "linestyle": ":", "label": "task known (POEM's policies)"}
    axes.axhline(float(reference.returns.mean(axis=1).mean()), linewidth=1.2, **looks)


def _samples_figure(
    entry: Entry, oracle: OracleSpec, found: dict[Condition, list[Series]]
) -> Figure:
    figure, panels = _grid(entry, found)
    last = max(entry.record_at)
    for axes, _, series in panels:
        for method in dict.fromkeys(one.method for one in series):
            mine = [one for one in series if one.method == method]
            mine.sort(key=lambda one: one.samples)
            by_seed = [one.at(last).mean(axis=1) for one in mine]
            style, label = _style(entry, mine[0]), mine[0].label
            if len(mine) == 1 and mine[0].snapshot is None:  # not measured along the training
                looks = {"color": style["color"], "label": f"{label}, at the end"}
                axes.axhline(float(by_seed[0].mean()), linestyle="-.", linewidth=1.4, **looks)
            else:
                _draw(axes, [one.samples for one in mine], by_seed, label, style)
        axes.set_xlabel("environment steps of the training, thousands")
        axes.xaxis.set_major_formatter(lambda steps, position: f"{steps / 1000:g}")
    return _finish(figure, f"{entry.title}, {oracle.label}; return after {last} queries")


def _tolerance_figure(entry: Entry, found: dict[Condition, list[Series]]) -> Figure:
    figure, panels = _grid(entry, {one: series for one, series in found.items() if series}, True)
    for axes, _, series in panels:
        epsilons = [METHODS[one.method].options.get("epsilon", 0.1) for one in series]
        for number, queries in enumerate((1, 5, 10) if series else ()):
            style = {"color": f"C{number}", "marker": MARKERS[number]}
            label = f"{queries} quer{'ies' if queries > 1 else 'y'}"
            by_seed = [one.at(queries).mean(axis=1) for one in series]
            _draw(axes, epsilons, by_seed, label, style)
        axes.set_xlabel("tolerance epsilon")
    return _finish(figure, entry.title)


def _draw(
    axes: Axes, x: Sequence[float], by_seed: list[np.ndarray], label: str, style: dict[str, Any]
) -> None:
    """A line with the deviation over seeds, of whose returns there is an array for each x."""
    means = np.array([returns.mean() for returns in by_seed])
    deviations = np.array([some.std(ddof=1) if len(some) > 1 else 0.0 for some in by_seed])
    axes.plot(x, means, markersize=4, linewidth=1.6, label=label, zorder=3, **style)
    bounds = (means - deviations, means + deviations)
    axes.fill_between(x, *bounds, color=style["color"], alpha=0.1, linewidth=0)


def _style(entry: Entry, series: Series) -> dict[str, Any]:
    """A method of Table 3 looks the same in each entry, unless that compares its candidates; with a
    row for each inference rule the same change looks the same in both.
    """

    def change(method: str) -> str:
        words = method.split("-")
        dropped = tuple(INFERENCE_LABELS) if entry.by_inference else CONDITIONS
        return "-".join(word for word in words if word not in dropped)

    names, known = list(map(change, entry.methods)), [*TABLE_METHODS, "anole-rollouts"]
    if entry.by_inference:
        known = []
    elif len(set(names)) < len(names):
        names, known = list(entry.methods), []
    mine = names[entry.methods.index(series.method)]
    place = list(dict.fromkeys([*known, *names])).index(mine)
    return {"color": f"C{place % COLOURS}", "marker": MARKERS[place % len(MARKERS)]}


def _grid(
    entry: Entry, found: dict[Condition, list[Series]], by_oracle: bool = False
) -> tuple[Figure, list[tuple[Axes, Condition, list[Series]]]]:
    """A column for each family; a row for each oracle, or inference rule, or one."""
    rows = list(INFERENCE_LABELS.values()) if entry.by_inference else [""]
    if by_oracle:
        rows = [oracle.label for oracle in entry.oracles]
    size = (max(6.0, PANEL_WIDTH * len(found)), PANEL_HEIGHT * len(rows) + 1.2)
    # A figure of pyplot would stay in its global list, and choose a window system.
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    grid: Any = figure.subplots(len(rows), len(found), squeeze=False)
    panels, families = [], [condition.family for condition in found]
    for column, (condition, series) in enumerate(found.items()):
        alike = families.count(condition.family) > 1
        name = fill(str(condition), 45) if alike else condition.family
        for row, detail in enumerate(rows):
            axes = grid[row][column]
            axes.set_title(f"{name}{', ' * bool(detail)}{detail}", fontsize=10)
            axes.grid(alpha=0.25)
            axes.spines[["top", "right"]].set_visible(False)
            if column == 0:
                axes.set_ylabel("return per episode")
            of_oracle = [one for one in series if one.oracle.label == detail]
            of_rule = [one for one in series if one.label.startswith(detail)]
            panels.append((axes, condition, of_oracle if by_oracle else of_rule))
    return figure, panels


def _finish(figure: Figure, title: str) -> Figure:
    """One legend for all panels, below them."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            if any(axes.get_title().endswith(f", {rule}") for rule in INFERENCE_LABELS.values()):
                label = label.split(", ", 1)[-1]
            entries.setdefault(label, handle)
    figure.suptitle(title, fontsize=11)
    fitting = int(figure.get_figwidth() / (0.5 + 0.065 * max(map(len, entries))))  # inches a column
    columns = max(1, min(fitting, 4))
    where: dict[str, Any] = {"loc": "outside lower center", "frameon": False, "fontsize": 8}
    figure.legend(list(entries.values()), list(entries), ncols=columns, **where)
    return figure
