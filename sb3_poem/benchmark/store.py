"""The results: one SQLite file, one row per finished cell."""

import json
import sqlite3
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

from sb3_poem import __version__

SCHEMA = "3"
BUSY_SECONDS = 120
TABLES = """
PRAGMA page_size = 1024; -- a cell takes 3 KB
CREATE TABLE IF NOT EXISTS about (name TEXT PRIMARY KEY NOT NULL, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS cells (
    key TEXT PRIMARY KEY NOT NULL,
    family TEXT NOT NULL,
    method TEXT NOT NULL,
    seed INTEGER NOT NULL,
    created TEXT NOT NULL,
    identity BLOB NOT NULL,
    result BLOB NOT NULL,
    provenance BLOB NOT NULL
);
"""
#: Columns that hold JSON, compressed: a result is mostly a matrix of returns
PACKED = ("identity", "result", "provenance")


@dataclass(frozen=True)
class Record:
    """A finished cell: its :attr:`Cell.key`, the method under whose name it was run first, its
    :meth:`Cell.identity`, what it earned and took, where it comes from, and when (UTC).
    """

    key: str
    family: str
    method: str
    seed: int
    identity: dict[str, Any]
    result: dict[str, Any]
    provenance: dict[str, Any]
    created: str = ""


class Store:
    """A store of finished cells. Several processes may use one file: every access is a transaction
    of its own, and a cell that is there stays as it is. A missing file is made only with
    ``create``; one of another program or version is refused by a ``ValueError``.
    """

    def __init__(self, path: str | Path, create: bool = True) -> None:
        self.path = Path(path)
        if not self.path.exists():
            if not create:
                raise FileNotFoundError(
                    f"--store {path}: there is no such file; `sb3-poem benchmark run` makes it"
                )
            self.path.parent.mkdir(parents=True, exist_ok=True)
        with self._usable():
            self._database = sqlite3.connect(self.path, timeout=BUSY_SECONDS)
            self._database.row_factory = sqlite3.Row
            about = self._about(create)
        if about.get("schema") != SCHEMA:
            raise ValueError(
                f"--store {path} was written in schema {about.get('schema')!r} by sb3_poem "
                f"{about.get('version')!r}, but this is sb3_poem {__version__}, which reads schema "
                f"{SCHEMA!r}; use that version, or another file"
            )

    @contextmanager
    def _usable(self) -> Iterator[None]:
        """Say which file it is that is damaged, or no store."""
        try:
            yield
        except (sqlite3.DatabaseError, zlib.error) as error:
            raise ValueError(
                f"--store {self.path} cannot be used as a store of the benchmark: {error}"
            ) from error

    def _about(self, create: bool) -> dict[str, str]:
        """What the file says about itself; it is made, or completed, first."""
        tables = {name for (name,) in self._database.execute("SELECT name FROM sqlite_master")}
        if "about" not in tables and (tables or not create):
            raise ValueError(
                f"--store {self.path} is a database of another program: it has no table `about`"
            )
        if create:  # another process may be doing the same: what is there already stays
            facts = {"schema": SCHEMA, "version": __version__}.items()
            with self._database:
                self._database.executescript(TABLES)
                self._database.executemany("INSERT OR IGNORE INTO about VALUES (?, ?)", facts)
        return dict(self._database.execute("SELECT name, value FROM about"))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        self._database.close()

    def __contains__(self, key: str) -> bool:
        return key in self.keys()

    def keys(self) -> set[str]:
        with self._usable():
            return {key for (key,) in self._database.execute("SELECT key FROM cells")}

    def add(self, record: Record) -> bool:
        """Keep a finished cell, and tell whether it is new; if not, what is there stays."""
        row = vars(record) | {name: _pack(getattr(record, name)) for name in PACKED}
        row["created"] = record.created or datetime.now(UTC).isoformat(timespec="seconds")
        names = f"({', '.join(row)}) VALUES (:{', :'.join(row)})"
        with self._usable(), self._database:
            added = self._database.execute(f"INSERT OR IGNORE INTO cells {names}", row)
        return added.rowcount == 1

    def records(self) -> Iterator[Record]:
        """Finished cells, in the order of their names."""
        order = "SELECT * FROM cells ORDER BY family, method, seed, key"
        with self._usable():
            for row in map(dict, self._database.execute(order).fetchall()):
                packed = {name: json.loads(zlib.decompress(row[name])) for name in PACKED}
                yield Record(**row | packed)


def _pack(value: dict[str, Any]) -> bytes:
    return zlib.compress(json.dumps(value, sort_keys=True, allow_nan=False).encode(), 9)
