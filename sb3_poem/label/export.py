"""Recorded answers as a data set: JSON Lines and Parquet."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sb3_poem.common.files import write_atomically
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.label.store import Session, Store

#: What an answer's record holds, beside the trajectories where these are asked for.
FIELDS = (
    *(
        "session",
        "source",
        "model",
        "env_id",
        "seed",
        "number",
        "preference",
        "undone",
        "wish",
        "verdict",
    ),
    *(
        "asked",
        "shown",
        "answered",
        "seconds",
        "video",
        "fps",
        "frames",
        "left_latent",
        "right_latent",
    ),
)


def records(
    store: Store, trajectories: bool = False, undone: bool = False
) -> Iterator[dict[str, Any]]:
    """The answers of all sessions.

    :param trajectories: Whether observations, actions and reward features are in them.
    :param undone: Whether answers that were taken back are among them.
    :return: A JSON-ready record for each, in the order in which they were given.
    """
    for row in store.records():
        if undone or row["undone"] is None:
            yield _record(row, store.videos.resolve(), trajectories)


def session_record(store: Store, session: Session) -> dict[str, Any]:
    """One session, as its person downloads it.

    :return: JSON-ready; it names no file of the server.
    """
    own = [record for record in records(store) if record["session"] == session.id]
    common = {
        name: getattr(session, name) for name in ("model", "env_id", "seed", "options", "wish")
    }
    left_out = {"session", "source", "video", *common}
    return {
        "format": "sb3_poem answers 1",
        **common,
        "started": _time(session.created),
        "answers": [
            {name: value for name, value in record.items() if name not in left_out}
            for record in own
        ],
    }


def export(store: Store, path: Path, trajectories: bool = False, undone: bool = False) -> int:
    """Write all answers.

    :param path: The file, by whose suffix they become JSON Lines (``.jsonl``) or Parquet
        (``.parquet``).
    :param trajectories: See :func:`records`.
    :param undone: See :func:`records`.
    :return: How many.
    :raises ValueError: If the suffix is another.
    """
    rows = list(records(store, trajectories, undone))
    if path.suffix == ".jsonl":
        write_atomically(
            path, "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows).encode()
        )
    elif path.suffix == ".parquet":
        write_atomically(path, _parquet(rows, trajectories))
    else:
        raise ValueError(f"{path}: the name must end in .jsonl or .parquet")
    return len(rows)


def _record(row: sqlite3.Row, videos: Path, trajectories: bool) -> dict[str, Any]:
    shown = {
        side: Trajectory.from_dict(json.loads(row[f"{side}_trajectory"]))
        for side in ("left", "right")
    }
    begun = row["shown"] or row["asked"]
    record = {
        **{
            name: row[name]
            for name in ("session", "source", "model", "env_id", "seed", "number", "preference")
        },
        "undone": row["undone"] is not None,
        "wish": row["wish"],
        "verdict": row["verdict"],
        "asked": _time(row["asked"]),
        "shown": None if row["shown"] is None else _time(row["shown"]),
        "answered": _time(row["answered"]),
        "seconds": round(row["answered"] - begun, 3),
        "video": str(videos / row["video"]),
        "fps": row["fps"],
        "frames": row["frames"],
        "left_latent": shown["left"].latent.tolist(),
        "right_latent": shown["right"].latent.tolist(),
    }
    assert tuple(record) == FIELDS
    if trajectories:
        for side, trajectory in shown.items():
            record[f"{side}_observations"] = trajectory.observations.tolist()
            record[f"{side}_actions"] = trajectory.actions.tolist()
            features = trajectory.reward_features
            record[f"{side}_reward_features"] = None if features is None else features.tolist()
    return record


def _parquet(rows: list[dict[str, Any]], trajectories: bool) -> bytes:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise ValueError(
            "Parquet needs pyarrow: pip install 'sb3_poem[label]', or export to .jsonl"
        ) from None
    numbers, table = pa.list_(pa.float64()), pa.list_(pa.list_(pa.float64()))
    types = {name: pa.string() for name in FIELDS}
    types |= dict.fromkeys(("session", "seed", "number", "frames"), pa.int64())
    types |= dict.fromkeys(("seconds", "fps"), pa.float64())
    types |= {"undone": pa.bool_(), "left_latent": numbers, "right_latent": numbers}
    if trajectories:
        parts = ("observations", "actions", "reward_features")
        types |= {f"{side}_{part}": table for side in ("left", "right") for part in parts}
    sink = pa.BufferOutputStream()
    parquet.write_table(pa.Table.from_pylist(rows, schema=pa.schema(list(types.items()))), sink)
    return sink.getvalue().to_pybytes()


def _time(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds")
