"""Runs cells in this process, one after another."""

from __future__ import annotations

import traceback
from collections.abc import Sequence
from pathlib import Path

from sb3_poem.benchmark.cells import run_cell
from sb3_poem.benchmark.locks import locked, try_lock
from sb3_poem.benchmark.models import ModelLibrary, Say
from sb3_poem.benchmark.store import Store
from sb3_poem.benchmark.suites import Cell


def run_cells(
    cells: Sequence[Cell], library: ModelLibrary, store: Store, say: Say = print
) -> list[str]:
    """Run cells, and keep each as soon as it is finished. It may be interrupted at any moment; what
    another process is at, or has finished, is left to it, and cells whose model another process is
    training come last.

    :param library: The models.
    :param store: The results.
    :param say: Takes lines of progress.
    :return: What failed, a line each; the other cells were run all the same.
    """
    failures: list[str] = []
    postponed: list[Cell] = []
    broken: dict[object, str] = {}
    for position, cell in enumerate(cells, start=1):
        with try_lock(_lock_file(cell, library, store)) as mine:
            if not mine or (cell.key not in store and library.is_taken(cell.model_key)):
                postponed.append(cell)
                continue
            _run_one(cell, library, store, say, failures, broken, f"[{position}/{len(cells)}]")
    for cell in postponed:  # whoever has them, or trains for them, may have died
        with locked(
            _lock_file(cell, library, store),
            lambda cell=cell: say(f"waiting for another process: {cell}"),  # type: ignore[misc]
        ):
            _run_one(cell, library, store, say, failures, broken, "[postponed]")
    return failures


def _run_one(
    cell: Cell,
    library: ModelLibrary,
    store: Store,
    say: Say,
    failures: list[str],
    broken: dict[object, str],
    place: str,
) -> None:
    if cell.key in store:
        return
    if cell.model_key in broken:  # its training has failed, and would again
        failures.append(f"{cell}: {broken[cell.model_key]}")
        return
    say(f"{place} {cell}")
    try:
        library.ensure(cell.model_key, say)
    except Exception as error:
        traceback.print_exc()
        broken[cell.model_key] = str(error)
        failures.append(f"{cell}: {error}")
        return
    try:
        record = run_cell(cell, library, say)
    except Exception as error:
        traceback.print_exc()
        failures.append(f"{cell}: {error}")
        return
    store.add(record)
    say(f"    {summary(record.result)}, {record.result['seconds']:.0f} s")


def summary(result: dict) -> str:
    """The mean returns of a result in a line."""
    returns = result["task_returns"]
    if "queries" not in result:
        return f"return {sum(returns) / len(returns):.1f}"
    means = [sum(column) / len(column) for column in zip(*returns, strict=True)]
    return ", ".join(f"{k}: {mean:.1f}" for k, mean in zip(result["queries"], means, strict=True))


def _lock_file(cell: Cell, library: ModelLibrary, store: Store) -> Path:
    """Of a cell in a store: another store's cell of the same key is another piece of work."""
    return library.runs / ".locks" / store.path.name / cell.key
