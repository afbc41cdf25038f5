"""Running a finished cell again, to see whether it comes to the same."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from sb3_poem.benchmark.cells import run_cell
from sb3_poem.benchmark.models import ModelLibrary, Say
from sb3_poem.benchmark.store import Record, Store
from sb3_poem.benchmark.suites import REVISION, Cell

#: What a result holds that is another at each run
TIMES = ("seconds", "training_seconds", "training_cpu_seconds")


def find_record(store: Store, cell_id: str) -> Record:
    """The finished cell of a key, or of a beginning of one that no other has."""
    found = [record for record in store.records() if record.key.startswith(cell_id)]
    if len(found) != 1:
        many = f"is the beginning of {len(found)} keys" if found else "is no cell's key"
        raise ValueError(
            f"--cell {cell_id} {many} in {store.path}; `sb3-poem benchmark verify` without --cell "
            "lists the cells that there are"
        )
    return found[0]


def verify_cell(record: Record, library: ModelLibrary, say: Say = print) -> list[str]:
    """Run a finished cell again and compare with its record, number by number as the store holds
    them, times left out. What differs, a line each; nothing if nothing does.

    :raises ValueError: If the record is of another revision of the code, its identity does not have
        its key, or its model is not there.
    """
    if record.identity["revision"] != REVISION:
        raise ValueError(
            f"cell {record.key} is of revision {record.identity['revision']} of the code, and this "
            f"is {REVISION}: check out commit {record.provenance.get('commit')}"
        )
    cell = Cell.of_identity(record.method, record.identity)
    if cell.key != record.key:
        raise ValueError(
            f"the identity of cell {record.key} has the key {cell.key}: it was changed after the "
            "cell was run"
        )
    origin = library.origin(cell.model_key)
    if origin != cell.model:
        raise ValueError(
            f"cell {record.key} needs the model of {cell.model!r}, but for {cell.model_key} there "
            f"is that of {origin!r}: say where it is by --runs, --models or --model"
        )
    again = run_cell(cell, library, say)
    lines = [
        line
        for name in sorted((record.result.keys() | again.result.keys()) - set(TIMES))
        for line in _differences(name, record.result.get(name), again.result.get(name))
    ]
    if lines:
        lines += _other_places(record.provenance, again.provenance)
    return lines


def _differences(name: str, kept: Any, found: Any) -> Iterator[str]:
    if kept == found:
        return
    if isinstance(kept, dict) and isinstance(found, dict):
        for part in sorted(kept.keys() | found.keys()):
            yield from _differences(f"{name}.{part}", kept.get(part), found.get(part))
        return
    try:
        one, other = np.array(kept, dtype=np.float64), np.array(found, dtype=np.float64)
        assert one.shape == other.shape
    except (TypeError, ValueError, AssertionError):  # text, or of another length
        yield f"{name}: the store has {_short(kept)}, and this run {_short(found)}"
        return
    gaps = np.abs(one - other)
    place = np.unravel_index(np.argmax(gaps), gaps.shape)
    yield (
        f"{name}: {np.count_nonzero(gaps)} of {gaps.size} numbers differ, the most at "
        f"{[int(i) for i in place]}: the store has {one[place]:g}, and this run {other[place]:g}"
    )


def _other_places(kept: dict[str, Any], found: dict[str, Any]) -> Iterator[str]:
    """What may be why: other code, versions or machines."""
    for name in ("commit", "machine", "device", "num_threads", "versions"):
        if kept.get(name) != found.get(name):
            yield f"  {name}: {_short(kept.get(name))} then, {_short(found.get(name))} here"


def _short(value: Any, limit: int = 200) -> str:
    text = str(value)
    return text if len(text) <= limit else f"{text[:limit]}..."
