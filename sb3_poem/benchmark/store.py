"""The results: one SQLite file, one row per finished cell."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects.sqlite import insert
from sqlalchemy.pool import NullPool
from sqlalchemy.schema import CreateTable

from sb3_poem import __version__

SCHEMA = "3"
BUSY_SECONDS = 120


class _Packed(sa.types.TypeDecorator[dict[str, Any]]):
    """JSON, compressed: a record's result is mostly a matrix of returns."""

    impl = sa.LargeBinary
    cache_ok = True

    def process_bind_param(self, value: Any, dialect: sa.Dialect) -> bytes:
        return zlib.compress(json.dumps(value, sort_keys=True, allow_nan=False).encode(), 9)

    def process_result_value(self, value: Any, dialect: sa.Dialect) -> dict[str, Any]:
        return json.loads(zlib.decompress(value))


_METADATA = sa.MetaData()
_ABOUT = sa.Table(
    "about",
    _METADATA,
    sa.Column("name", sa.String, primary_key=True),
    sa.Column("value", sa.String, nullable=False),
)
_CELLS = sa.Table(
    "cells",
    _METADATA,
    sa.Column("key", sa.String, primary_key=True),
    sa.Column("family", sa.String, nullable=False),
    sa.Column("method", sa.String, nullable=False),
    sa.Column("seed", sa.Integer, nullable=False),
    sa.Column("created", sa.String, nullable=False),
    sa.Column("identity", _Packed, nullable=False),
    sa.Column("result", _Packed, nullable=False),
    sa.Column("provenance", _Packed, nullable=False),
)


@dataclass(frozen=True)
class Record:
    """A finished cell: :attr:`Cell.key`, the method under whose name it was run first,
    :meth:`Cell.identity`, every task's return after every recorded number of answers with samples
    and times, where it comes from, and when (UTC).
    """

    key: str
    family: str
    method: str
    seed: int
    identity: dict[str, Any]
    result: dict[str, Any]
    provenance: dict[str, Any]
    created: str = ""

    def to_dict(self) -> dict[str, Any]:
        return dict(vars(self))


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
        patience = {"timeout": BUSY_SECONDS}
        url = f"sqlite:///{self.path}"
        self._engine = sa.create_engine(url, poolclass=NullPool, connect_args=patience)
        try:
            about = self._open(create)
        except sa.exc.DatabaseError as error:
            raise ValueError(
                f"--store {path} cannot be used as a store of the benchmark: {error.orig}"
            ) from error
        if about.get("schema") != SCHEMA:
            raise ValueError(
                f"--store {path} was written in schema {about.get('schema')!r} by sb3_poem "
                f"{about.get('version')!r}, but this is sb3_poem {__version__}, which reads schema "
                f"{SCHEMA!r}; use that version, or another file"
            )

    def _open(self, create: bool) -> dict[str, str]:
        """What the file says about itself; it is made, or completed, first."""
        with self._engine.connect() as connection:
            tables = set(sa.inspect(connection).get_table_names())
        if "about" not in tables and (tables or not create):
            raise ValueError(
                f"--store {self.path} is a database of another program: it has no table `about`"
            )
        with self._engine.begin() as connection:
            if create:  # another process may be doing the same: what is there already stays
                for table in _METADATA.sorted_tables:
                    connection.execute(CreateTable(table, if_not_exists=True))
                facts = {"schema": SCHEMA, "version": __version__}
                rows = [{"name": name, "value": value} for name, value in facts.items()]
                connection.execute(insert(_ABOUT).on_conflict_do_nothing(), rows)
            return {row.name: row.value for row in connection.execute(sa.select(_ABOUT))}

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        self._engine.dispose()

    def __contains__(self, key: str) -> bool:
        return key in self.keys()

    def keys(self) -> set[str]:
        with self._engine.connect() as connection:
            return set(connection.execute(sa.select(_CELLS.c.key)).scalars())

    def add(self, record: Record) -> bool:
        """Keep a finished cell, and tell whether it is new; if not, what is there stays."""
        row = record.to_dict()
        row["created"] = record.created or datetime.now(UTC).isoformat(timespec="seconds")
        with self._engine.begin() as connection:
            return connection.execute(insert(_CELLS).on_conflict_do_nothing(), row).rowcount == 1

    def records(self, keys: Iterable[str] | None = None) -> Iterator[Record]:
        """Finished cells, in the order of their names; all, or those of some keys."""
        wanted = None if keys is None else set(keys)
        order = (_CELLS.c.family, _CELLS.c.method, _CELLS.c.seed, _CELLS.c.key)
        with self._engine.connect() as connection:
            rows = connection.execute(sa.select(_CELLS).order_by(*order)).mappings().all()
        for row in rows:
            if wanted is None or row["key"] in wanted:
                yield Record(**row)
