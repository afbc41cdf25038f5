"""The report: tables and figures of what a store holds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sb3_poem.benchmark.figures import write_figures
from sb3_poem.benchmark.selection import Selection
from sb3_poem.benchmark.store import Store
from sb3_poem.benchmark.suites import SUITES
from sb3_poem.benchmark.tables import format_rows, format_tables, suite_rows, suite_tables

SUFFIX = {"md": ".md", "latex": ".tex", "csv": ".csv", "json": ".json"}


def make_report(
    store: Store,
    suites: Sequence[str] | None = None,
    families: Sequence[str] | None = None,
    kind: str = "md",
    out: Path | None = None,
    seeds: Sequence[int] | None = None,
) -> tuple[str, list[Path]]:
    """Tables as text and, in a folder, the figures beside them.

    :param store: The results.
    :param suites: Names of suites; None: all of which there is something.
    :param families: Names of families; None: all.
    :param kind: "md", "latex", "csv" or "json".
    :param out: Where to write ``<suite>.<suffix>`` and the figures; None writes nothing.
    :param seeds: Only these, say where some methods have more of them than others; None: all.
    :return: The text of all suites, and the files.
    :raises ValueError: If the store holds nothing of what is asked for.
    """
    records = [record for record in store.records() if seeds is None or record.seed in seeds]
    texts, files = [], []
    for name in suites or SUITES:
        # A small family's cells belong to the suite that declares it, unless a suite is asked for
        # by its name.
        own = SUITES[name].families if suites is None and families is None else families
        selection = Selection(SUITES[name], records, own)
        tables = suite_tables(selection)
        if not any(
            selection.series(entry, c)
            for entry in selection.suite.entries
            for c in selection.conditions
        ):
            if suites:
                raise ValueError(f"--suite {name}: {store.path} holds no finished cell of it")
            continue
        if kind in ("md", "latex"):
            text = format_tables(selection.suite.title, tables, kind)
        else:
            text = format_rows(suite_rows(selection), kind)
        texts.append(text)
        if out is not None:
            file = out / f"{name}{SUFFIX[kind]}"
            file.write_text(text)
            files += [file, *write_figures(selection, out)]
    if not texts:
        of = [*(families or []), *(f"seed {seed}" for seed in seeds or [])]
        raise ValueError(
            f"{store.path} holds no finished cell" + (f" of {', '.join(of)}" if of else "")
        )
    return "\n".join(texts), files
