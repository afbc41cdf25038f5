"""Recorded answers as a data set: JSON Lines and Parquet."""

import json
import sqlite3
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sb3_poem.adaptation.preference import PLACES
from sb3_poem.common.files import write_atomically
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.label.store import Session, Store

#: What an answer's record holds, beside the trajectories where these are asked for, and the types
#: of its columns in Parquet.
FIELDS = {
    **{"session": "int64", "source": "string", "model": "string", "env_id": "string"},
    **{"seed": "int64", "number": "int64", "question": "string", "preference": "string"},
    "repeats": "int64",
    **{"undone": "bool", "wish": "string", "verdict": "string", "asked": "string"},
    **{"shown": "string", "answered": "string", "seconds": "float64", "video": "string"},
    **{"fps": "float64", "frames": "int64"},
}
#: Where trajectories are shown, by any kind of question
ALL_PLACES = tuple(dict.fromkeys(place for places in PLACES.values() for place in places))
# What one session's records have in common.
COMMON = ("model", "env_id", "seed", "options", "wish")


def records(
    store: Store, trajectories: bool = False, undone: bool = False, session: int | None = None
) -> Iterator[dict[str, Any]]:
    """The answers of one session or of all: a JSON-ready record for each, in the order in which
    they were given.

    :param trajectories: Whether observations, actions and reward features are in them.
    :param undone: Whether answers that were taken back are among them.
    """
    for row in store.records(session):
        if undone or row["undone"] is None:
            yield answer_record(row, store.videos.resolve(), trajectories)


def answer_record(row: sqlite3.Row, videos: Path, trajectories: bool = False) -> dict[str, Any]:
    """The record of a row of :meth:`~sb3_poem.label.store.Store.records`; see :func:`records`."""
    sides = trajectories_of(row)
    own = {
        "question": json.loads(row["options"]).get("question", "pair"),
        "undone": row["undone"] is not None,
        "asked": _time(row["asked"]),
        "shown": None if row["shown"] is None else _time(row["shown"]),
        "answered": _time(row["answered"]),
        # A clock may be set back meanwhile.
        "seconds": max(round(row["answered"] - (row["shown"] or row["asked"]), 3), 0.0),
        "video": str(videos / row["video"]),
    }
    record = {name: own[name] if name in own else row[name] for name in FIELDS}
    record |= {f"{side}_latent": shown.latent.tolist() for side, shown in sides.items()}
    for side, shown in sides.items() if trajectories else ():
        record[f"{side}_observations"] = shown.observations.tolist()
        record[f"{side}_actions"] = shown.actions.tolist()
        features = shown.reward_features
        record[f"{side}_reward_features"] = None if features is None else features.tolist()
    return record


def trajectories_of(row: sqlite3.Row) -> dict[str, Trajectory]:
    """What the answer of a row is about, by its place: "left" and "right", say."""
    shown = json.loads(row["trajectories"])
    return {place: Trajectory.from_dict(item) for place, item in shown.items()}


def session_record(store: Store, session: Session) -> dict[str, Any]:
    """One session, as its person downloads it, JSON-ready; it names no file of the server."""
    left_out = {"session", "source", "video", *COMMON}
    return {
        "format": "sb3_poem answers 1",
        **{name: getattr(session, name) for name in COMMON},
        "started": _time(session.created),
        "answers": [
            {name: value for name, value in record.items() if name not in left_out}
            for record in records(store, session=session.id)
        ],
    }


def export(
    store: Store,
    path: Path,
    trajectories: bool = False,
    undone: bool = False,
    kind: str | None = None,
) -> int:
    """Write all answers; see :func:`records`.

    :param kind: "jsonl" (JSON Lines) or "parquet"; None is the file's suffix.
    :return: How many.
    :raises ValueError: If it is another.
    """
    kind, rows = kind or path.suffix[1:], list(records(store, trajectories, undone))
    if kind == "jsonl":
        lines = [json.dumps(row, allow_nan=False) + "\n" for row in rows]
        write_atomically(path, "".join(lines).encode())
    elif kind == "parquet":
        write_atomically(path, _parquet(rows, trajectories))
    else:
        raise ValueError(f"{path}: the name must end in .jsonl or .parquet")
    return len(rows)


def _parquet(rows: list[dict[str, Any]], trajectories: bool) -> bytes:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise ValueError(
            "Parquet needs pyarrow: pip install -c constraints.txt '.[label]' in a checkout, or "
            "export to .jsonl"
        ) from None
    numbers = pa.list_(pa.float64())
    places = [place for place in ALL_PLACES if any(f"{place}_latent" in row for row in rows)]
    places = places or [*PLACES["pair"]]
    types = [(name, pa.type_for_alias(kind)) for name, kind in FIELDS.items()]
    types += [(f"{place}_latent", numbers) for place in places]
    parts = ("observations", "actions", "reward_features") if trajectories else ()
    types += [(f"{place}_{part}", pa.list_(numbers)) for place in places for part in parts]
    sink = pa.BufferOutputStream()
    parquet.write_table(pa.Table.from_pylist(rows, schema=pa.schema(types)), sink)
    return sink.getvalue().to_pybytes()


def _time(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds")
