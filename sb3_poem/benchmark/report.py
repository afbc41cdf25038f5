"""The report: tables and figures of what a store holds."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sb3_poem.benchmark.figures import write_figures
from sb3_poem.benchmark.models import ModelLibrary
from sb3_poem.benchmark.selection import Reference, Selection
from sb3_poem.benchmark.store import Store
from sb3_poem.benchmark.suites import EXACT, SUITES, Cell
from sb3_poem.benchmark.tables import format_rows, format_tables, suite_rows, suite_tables
from sb3_poem.common.vec_env import make_task_vec_env

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


def export_model(cells: Sequence[Cell], library: ModelLibrary, store: Store, folder: Path) -> None:
    """Write the model of finished cells as a pretrained folder, with how it was trained and what it
    earns on its card.

    :param cells: Of one model: methods with preferences, and what is known.
    :param library: The models.
    :param store: The results.
    :param folder: Where; made if missing.
    :raises ValueError: If a cell is not finished.
    """
    records = {record.key: record for record in store.records(cell.key for cell in cells)}
    missing = [str(cell) for cell in cells if cell.key not in records]
    if missing:
        raise ValueError(f"{folder} cannot be written before its cells are finished: {missing}")
    [known] = [records[cell.key] for cell in cells if cell.definition.kind == "known"]
    reference = Reference("known-task", (known,))
    adaptations = []
    for cell in cells:
        if cell.definition.kind == "known":
            continue
        result = records[cell.key].result
        figures = {
            "inference": cell.options["inference"],
            "queries": result["queries"],
            "mean_return": np.mean(result["task_returns"], axis=0).tolist(),
            "limit": [float(reference.limits(k, EXACT)[0]) for k in result["queries"]],
            "known_task_return": float(reference.known[0]),
        }
        if "task_success_rates" in result:
            figures["success_rate"] = np.mean(result["task_success_rates"], axis=0).tolist()
            figures["known_task_success_rate"] = reference.success_rate
        adaptations.append(figures)
    training = known.provenance["model"]
    order = {name: known.result[name] for name in ("preference_accuracy", "kendall_tau")}
    order |= {"env_steps": known.result["training_samples"], "updates": known.result["updates"]}
    n_tasks = len(known.result["tasks"])
    card = {
        **{name: training[name] for name in ("command", "commit", "machine") if name in training},
        "seed": cells[0].seed,
        "wall_seconds": training.get("seconds"),
        "cpu_seconds": training.get("cpu_seconds"),
        "results": {f"adaptation to {n_tasks} unseen tasks": adaptations, "property 1": order},
    }
    with contextlib.closing(make_task_vec_env(cells[0].env_id, 1)) as env:
        library.load(cells[0].model_key, env).save_pretrained(folder, card)
