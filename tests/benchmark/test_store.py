"""The store: versions, foreign files, and several processes at once."""

import json
import sqlite3
import subprocess
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmark_records import cells_of, finished

from sb3_poem.benchmark.store import Record, Store
from sb3_poem.benchmark.suites import SUITES


def some_record(number: int, value: float = 0.0) -> Record:
    return Record(
        f"key{number}",
        "PointGoal",
        "anole",
        number,
        {"n": number},
        {"value": value},
        {"commit": "abc"},
    )


def test_a_record_comes_back_as_it_was(tmp_path: Path) -> None:
    cell = cells_of(SUITES["smoke"])[0]
    record = finished(cell, lambda cell, k: np.arange(10.0) + k)
    with Store(tmp_path / "deep" / "store.sqlite") as store:
        assert store.add(record)
        assert cell.key in store
        assert "other" not in store
        [read] = store.records()
    assert replace(read, created="") == record
    assert read.created.endswith("+00:00")


def test_what_is_kept_is_compressed_json(tmp_path: Path) -> None:
    path, matrix = tmp_path / "store.sqlite", (np.arange(6000.0).reshape(30, 200) / 100).tolist()
    record = replace(some_record(1), result={"candidate_returns": matrix})
    with Store(path) as store:
        store.add(record)
        assert [read.result for read in store.records()] == [record.result]
    with sqlite3.connect(path) as connection:
        [packed] = connection.execute("select result from cells").fetchone()
    assert json.loads(zlib.decompress(packed)) == record.result
    assert len(packed) < len(json.dumps(matrix)) / 2


def test_what_is_there_stays(tmp_path: Path) -> None:
    with Store(tmp_path / "store.sqlite") as store:
        assert store.add(some_record(1, 1.0))
        assert not store.add(some_record(1, 2.0))
        assert [record.result["value"] for record in store.records()] == [1.0]
    with Store(tmp_path / "store.sqlite", create=False) as store:
        assert store.keys() == {"key1"}


def test_a_store_whose_creation_was_interrupted_is_completed(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    Store(path).close()
    with sqlite3.connect(
        path
    ) as connection:  # as after a kill between the first table and its rows
        connection.execute("delete from about")
        connection.execute("drop table cells")
    with Store(path) as store:
        assert store.add(some_record(1))
    with Store(path, create=False) as store:
        assert store.keys() == {"key1"}


def test_another_version_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    Store(path).close()
    with sqlite3.connect(path) as connection:
        connection.execute("update about set value = '7' where name = 'schema'")
        connection.execute("update about set value = '9.9' where name = 'version'")
    with pytest.raises(
        ValueError,
        match=r"written in schema '7' by sb3_poem '9.9', but this is .* which reads schema '3'",
    ):
        Store(path)


def test_other_files_are_refused_and_stay_as_they_are(tmp_path: Path) -> None:
    text, foreign = tmp_path / "notes.txt", tmp_path / "foreign.sqlite"
    text.write_text("not a database, but long enough to look at " * 10)
    with sqlite3.connect(foreign) as connection:
        connection.execute("create table t (x)")
    for path, message in (
        (text, "file is not a database"),
        (foreign, "a database of another program"),
    ):
        before = path.read_bytes()
        with pytest.raises(ValueError, match=message):
            Store(path)
        assert path.read_bytes() == before
    with pytest.raises(ValueError, match=r"cannot be used as a store .*: unable to open"):
        Store(tmp_path)
    with pytest.raises(FileNotFoundError, match="benchmark run"):
        Store(tmp_path / "missing.sqlite", create=False)
    assert not (tmp_path / "missing.sqlite").exists()


def test_a_damaged_store_is_named(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    with Store(path) as store:
        for number in range(60):
            store.add(some_record(number))
    content = path.read_bytes()
    packed = content.index(zlib.compress(b"{", 9)[:2])  # where a column begins
    pages = content[:4096] + b"\xff" * 2048 + content[6144:]
    for damaged in (pages, content[:packed] + b"\0" + content[packed + 1 :]):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"store\.sqlite cannot be used as a store"):
            list(Store(path, create=False).records())


WRITER = """
import sys
sys.path[:0] = {path!r}
from test_store import some_record
from sb3_poem.benchmark.store import Store
store = Store(sys.argv[1])
print(sum(store.add(some_record(number, float(sys.argv[2]))) for number in range(60)))
"""


def test_two_processes_do_not_harm_one_store(tmp_path: Path) -> None:
    """Both make it, and write the same cells at the same time: each is kept once, whole."""
    path = tmp_path / "store.sqlite"
    command = [
        sys.executable,
        "-c",
        WRITER.format(path=[str(Path(__file__).parent), *sys.path]),
        str(path),
    ]
    writers = [
        subprocess.Popen([*command, str(n)], stdout=subprocess.PIPE, text=True) for n in (1, 2)
    ]
    added = [int(writer.communicate()[0]) for writer in writers]
    assert [writer.returncode for writer in writers] == [0, 0]
    assert sum(added) == 60
    with Store(path, create=False) as store:
        records = list(store.records())
    assert sorted(record.seed for record in records) == list(range(60))
    assert [sum(record.result["value"] == n for record in records) for n in (1.0, 2.0)] == added
    with sqlite3.connect(path) as connection:
        assert connection.execute("pragma integrity_check").fetchone() == ("ok",)
