"""Where sessions, questions and answers are kept: SQLite, so that a kill at any moment loses
nothing that was answered.
"""

from __future__ import annotations

import hashlib
import json
import secrets
import sqlite3
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_poem.label.turns import Turn
from sb3_poem.label.videos import StorageError

SCHEMA_VERSION = 1
SCHEMA = """
CREATE TABLE sessions (
    id INTEGER PRIMARY KEY,
    token_hash TEXT NOT NULL UNIQUE,
    source TEXT NOT NULL,            -- 'page', 'notebook' or 'terminal'
    model TEXT NOT NULL,
    env_id TEXT NOT NULL,
    seed INTEGER NOT NULL,
    options TEXT NOT NULL,           -- JSON
    step INTEGER NOT NULL,           -- questions before the first result, and between results
    target INTEGER NOT NULL,         -- the next result comes after so many answers
    stopped INTEGER NOT NULL DEFAULT 0,
    wish TEXT NOT NULL DEFAULT '',
    created REAL NOT NULL
);
CREATE TABLE turns (
    id INTEGER PRIMARY KEY,
    session INTEGER NOT NULL REFERENCES sessions(id),
    kind TEXT NOT NULL CHECK (kind IN ('question', 'result')),
    number INTEGER NOT NULL,         -- answers before it
    state TEXT,                      -- JSON, or NULL where nothing continues from it
    left_trajectory TEXT,            -- JSON
    right_trajectory TEXT,           -- JSON
    belief TEXT,                     -- JSON
    latent TEXT,                     -- JSON
    video TEXT NOT NULL,
    fps REAL NOT NULL,
    frames INTEGER NOT NULL,
    created REAL NOT NULL,
    shown REAL,
    verdict TEXT CHECK (verdict IN ('yes', 'not quite')),
    verdict_time REAL,
    dropped REAL                     -- when an undo made it void
);
CREATE UNIQUE INDEX one_turn ON turns(session, kind, number) WHERE dropped IS NULL;
CREATE TABLE answers (
    id INTEGER PRIMARY KEY,
    session INTEGER NOT NULL REFERENCES sessions(id),
    question INTEGER NOT NULL REFERENCES turns(id),
    number INTEGER NOT NULL,         -- answers before it
    preference TEXT NOT NULL CHECK (preference IN ('left', 'right', 'equal')),
    created REAL NOT NULL,
    undone REAL
);
CREATE UNIQUE INDEX one_answer ON answers(session, number) WHERE undone IS NULL;
"""


class RefusedError(ValueError):
    """What was asked for does not fit the session as it now is: an answer out of order, say.
    Nothing was changed.
    """


@dataclass(frozen=True)
class Session:
    """A person's conversation.

    :param id: Its number.
    :param source: "page", "notebook" or "terminal".
    :param model: The model's name.
    :param env_id: The environment's id.
    :param seed: Of the adaptation.
    :param options: Of the adaptation.
    :param step: Questions between results.
    :param target: The next result comes after so many answers.
    :param stopped: Whether the person asked for the result before.
    :param wish: In the person's own words.
    :param created: Seconds since 1970.
    """

    id: int
    source: str
    model: str
    env_id: str
    seed: int
    options: dict[str, Any]
    step: int
    target: int
    stopped: bool
    wish: str
    created: float


class Store:
    """The store. One connection, used by one thread at a time; several processes may open the same
    file.

    Each method raises :class:`~sb3_poem.label.videos.StorageError` if the disk is full or broken.

    :param folder: Where; it is made if missing, for its owner alone. ``answers.sqlite`` is the
        store, ``videos/`` holds the videos.
    :raises ValueError: If the store is of another version.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.videos = self.folder / "videos"
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.videos.mkdir(mode=0o700, exist_ok=True)
        self.path = self.folder / "answers.sqlite"
        self._lock = threading.RLock()
        with self._speaking():
            self._connection = sqlite3.connect(
                self.path, timeout=30.0, isolation_level=None, check_same_thread=False
            )
            self._connection.row_factory = sqlite3.Row
            self.path.chmod(0o600)
            for setting in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON"):
                self._connection.execute(f"PRAGMA {setting}")
            self._make_tables()

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._connection.close()

    def create_session(
        self,
        model: str,
        env_id: str,
        seed: int,
        options: dict[str, Any],
        step: int = 10,
        source: str = "page",
    ) -> tuple[Session, str]:
        """Begin a conversation.

        :param model: The model's name.
        :param env_id: The environment's id.
        :param seed: Of the adaptation.
        :param options: Of the adaptation, JSON-ready.
        :param step: Questions before the first result, and between results.
        :param source: "page", "notebook" or "terminal".
        :return: The session, and the token of its link, of which only a hash is kept.
        """
        token = secrets.token_urlsafe(32)
        row = (
            _hash(token),
            source,
            model,
            env_id,
            seed,
            json.dumps(options),
            step,
            step,
            time.time(),
        )
        columns = "token_hash, source, model, env_id, seed, options, step, target, created"
        with self._transaction() as connection:
            cursor = connection.execute(
                f"INSERT INTO sessions ({columns}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", row
            )
        assert cursor.lastrowid is not None
        return self.session(cursor.lastrowid), token

    def find(self, token: str) -> Session | None:
        """The session of a link.

        :param token: The link's token.
        :return: The session, or None.
        """
        row = self._one("SELECT * FROM sessions WHERE token_hash = ?", _hash(token))
        return None if row is None else _session(row)

    def session(self, number: int) -> Session:
        """A session.

        :return: The session.
        :raises KeyError: If there is none.
        """
        row = self._one("SELECT * FROM sessions WHERE id = ?", number)
        if row is None:
            raise KeyError(f"there is no session {number}")
        return _session(row)

    def sessions(self) -> list[Session]:
        """All sessions, the oldest first."""
        return [_session(row) for row in self._all("SELECT * FROM sessions ORDER BY id")]

    def answers(self, session: int) -> list[sqlite3.Row]:
        """The answers in force, in order.

        :param session: The session's number.
        :return: Rows of ``answers``.
        """
        return self._all(
            "SELECT * FROM answers WHERE session = ? AND undone IS NULL ORDER BY number", session
        )

    def turn(self, session: int, kind: str, number: int) -> sqlite3.Row | None:
        """A turn that counts, without what is large.

        :param session: The session's number.
        :param kind: "question" or "result".
        :param number: Answers before it.
        :return: The row, or None.
        """
        columns = (
            "id, session, kind, number, belief, latent, video, fps, frames, created, shown, verdict"
        )
        query = f"SELECT {columns} FROM turns WHERE session = ? AND kind = ? AND number = ? AND dropped IS NULL"
        return self._one(query, session, kind, number)

    def whole_turn(self, turn: int) -> sqlite3.Row | None:
        """All of a turn, whether it counts or not.

        :param turn: Its number.
        :return: The row, or None.
        """
        return self._one("SELECT * FROM turns WHERE id = ?", turn)

    def conversation(self, session: int, before: int) -> list[dict[str, Any]]:
        """The first answers with their trajectories, as an adapter's dictionary holds them.

        :param session: The session's number.
        :param before: How many.
        :return: ``preference``, ``left`` and ``right`` of each.
        """
        query = """SELECT answers.preference, turns.left_trajectory, turns.right_trajectory FROM answers
            JOIN turns ON turns.id = answers.question
            WHERE answers.session = ? AND answers.undone IS NULL AND answers.number < ? ORDER BY answers.number"""
        return [
            {"preference": row[0], "left": json.loads(row[1]), "right": json.loads(row[2])}
            for row in self._all(query, session, before)
        ]

    def add_turn(
        self,
        session: int,
        kind: str,
        number: int,
        last_answer: int | None,
        turn: Turn,
        video: str,
        created: float | None = None,
        shown: float | None = None,
    ) -> bool:
        """Keep a turn, if the conversation still is where it was made for, and it has not been kept
        already.

        :param session: The session's number.
        :param kind: "question" or "result".
        :param number: Answers before it.
        :param last_answer: The number in the store of the last of these; None at the start.
        :param video: Its file's name within ``videos/``.
        :param created: When it was made, seconds since 1970; None is now.
        :param shown: When it was shown; None is not yet.
        :return: Whether it was kept.
        """
        columns = "session, kind, number, state, left_trajectory, right_trajectory, belief, latent, video, fps, frames, created"
        columns += ", shown"
        contents = map(_json, (turn.state, turn.left, turn.right, turn.belief, turn.latent))
        made = time.time() if created is None else created
        row: tuple[Any, ...] = (
            session,
            kind,
            number,
            *contents,
            video,
            turn.fps,
            turn.frames,
            made,
            shown,
        )
        with self._transaction() as connection:
            here = [answer["id"] for answer in self.answers(session)]
            if (
                here[number - 1] if 0 < number <= len(here) else None
            ) != last_answer or number > len(here):
                return False
            if self.turn(session, kind, number) is not None:
                return False
            connection.execute(
                f"INSERT INTO turns ({columns}) VALUES ({', '.join('?' * len(row))})", row
            )
        return True

    def mark_shown(self, turn: int) -> None:
        """Note that a turn has been shown, the first time.

        :param turn: Its number.
        """
        with self._transaction() as connection:
            connection.execute(
                "UPDATE turns SET shown = ? WHERE id = ? AND shown IS NULL", (time.time(), turn)
            )

    def note_film(self, turn: int, fps: float, frames: int) -> None:
        """Note how a turn's video moves that was filmed again.

        :param turn: Its number.
        :param fps: Frames per second.
        :param frames: How many.
        """
        with self._transaction() as connection:
            connection.execute(
                "UPDATE turns SET fps = ?, frames = ? WHERE id = ?", (fps, frames, turn)
            )

    def add_answer(self, session: int, question: int, preference: str) -> int:
        """Keep an answer. Once this returns, it is on the disk. The same answer again is no second
        one.

        :param session: The session's number.
        :param question: The number of the question's turn.
        :param preference: "left", "right" or "equal".
        :return: The answer's number in the store.
        :raises RefusedError: If that question is not the one that waits.
        """
        with self._transaction() as connection:
            answers = self.answers(session)
            for answer in answers:
                if answer["question"] == question and answer["preference"] == preference:
                    return int(answer["id"])
            current = self.turn(session, "question", len(answers))
            if current is None or current["id"] != question:
                raise RefusedError(
                    "this question is not the one that waits for an answer; look again at the page"
                )
            about = self.session(session)
            if about.stopped or len(answers) >= about.target:
                raise RefusedError("the questions are over for now; the result is shown")
            cursor = connection.execute(
                "INSERT INTO answers (session, question, number, preference, created) VALUES (?, ?, ?, ?, ?)",
                (session, question, len(answers), preference, time.time()),
            )
        assert cursor.lastrowid is not None
        return cursor.lastrowid

    def undo(self, session: int, answered: int) -> None:
        """Take the last answer back; or, after an early stop, go back to the question that waited.

        :param session: The session's number.
        :param answered: How many answers there were where the undo was asked for; so that a
            repeated one takes back no more.
        :raises RefusedError: If there is nothing to take back, or the conversation is somewhere
            else by now.
        """
        with self._transaction() as connection:
            answers = self.answers(session)
            if answered != len(answers):
                raise RefusedError("the conversation has moved on; look again at the page")
            if self.session(session).stopped:
                connection.execute("UPDATE sessions SET stopped = 0 WHERE id = ?", (session,))
                return
            if not answers:
                raise RefusedError("there is no answer to take back")
            now = time.time()
            connection.execute(
                "UPDATE answers SET undone = ? WHERE id = ?", (now, answers[-1]["id"])
            )
            connection.execute(
                "UPDATE turns SET dropped = ? WHERE session = ? AND number >= ? AND dropped IS NULL",
                (now, session, answered),
            )

    def stop(self, session: int) -> None:
        """Show the result after the answers so far.

        :param session: The session's number.
        """
        with self._transaction() as connection:
            connection.execute("UPDATE sessions SET stopped = 1 WHERE id = ?", (session,))

    def judge(self, session: int, result: int, verdict: str) -> None:
        """Keep what the person says of a result; "not quite" asks for more questions. The same
        verdict again changes nothing.

        :param session: The session's number.
        :param result: The number of the result's turn.
        :param verdict: "yes" or "not quite".
        :raises RefusedError: If that result is not the one that is shown.
        """
        with self._transaction() as connection:
            about, answered = self.session(session), len(self.answers(session))
            current = self.turn(session, "result", answered)
            if (
                current is None
                or current["id"] != result
                or not (about.stopped or answered >= about.target)
            ):
                raise RefusedError(
                    "this result is not the one that is shown; look again at the page"
                )
            connection.execute(
                "UPDATE turns SET verdict = ?, verdict_time = ? WHERE id = ?",
                (verdict, time.time(), result),
            )
            if verdict == "not quite":
                connection.execute(
                    "UPDATE sessions SET stopped = 0, target = ? WHERE id = ?",
                    (answered + about.step, session),
                )

    def set_wish(self, session: int, wish: str) -> None:
        """Keep what the person wants, in their own words.

        :param session: The session's number.
        :param wish: The words.
        """
        with self._transaction() as connection:
            connection.execute("UPDATE sessions SET wish = ? WHERE id = ?", (wish, session))

    def records(self) -> Iterator[sqlite3.Row]:
        """All answers of all sessions with their questions, those that were taken back too, in the
        order of time.
        """
        query = """SELECT sessions.id AS session, sessions.source, sessions.model, sessions.env_id, sessions.seed,
            sessions.options, sessions.wish, answers.number, answers.preference, answers.created AS answered,
            answers.undone, turns.created AS asked, turns.shown, turns.video, turns.fps, turns.frames,
            turns.left_trajectory, turns.right_trajectory,
            (SELECT results.verdict FROM turns AS results WHERE results.session = sessions.id AND results.kind = 'result'
                AND results.verdict IS NOT NULL AND results.dropped IS NULL ORDER BY results.number DESC LIMIT 1) AS verdict
            FROM answers JOIN sessions ON sessions.id = answers.session JOIN turns ON turns.id = answers.question
            ORDER BY answers.id"""
        yield from self._all(query)

    def remove_orphans(self) -> int:
        """Delete videos that no turn names: rendered ahead for an answer that was not given, or cut
        short by a kill.

        :return: How many.
        """
        kept = {row["video"] for row in self._all("SELECT video FROM turns")}
        orphans = [
            file for file in self.videos.iterdir() if file.is_file() and file.name not in kept
        ]
        for file in orphans:
            file.unlink(missing_ok=True)
        return len(orphans)

    @contextmanager
    def _speaking(self) -> Iterator[None]:
        """One thread at a time, and SQLite's errors as sentences."""
        with self._lock:
            try:
                yield
            except sqlite3.DatabaseError as error:
                hint = " (is the disk full?)" if "disk I/O" in str(error) else ""
                raise StorageError(
                    f"{self.path} cannot be read or written: {error}{hint}"
                ) from error

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._speaking():
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield self._connection
                self._connection.execute("COMMIT")
            finally:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")

    def _make_tables(self) -> None:
        with self._transaction() as connection:
            version = connection.execute("PRAGMA user_version").fetchone()[0]
            if version not in (0, SCHEMA_VERSION):
                raise ValueError(
                    f"{self.path} is a store of version {version}; this program reads {SCHEMA_VERSION}"
                )
            if version == 0:
                for statement in SCHEMA.split(";"):
                    connection.execute(statement)
                connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")

    def _one(self, query: str, *arguments: Any) -> sqlite3.Row | None:
        with self._speaking():
            return self._connection.execute(query, arguments).fetchone()

    def _all(self, query: str, *arguments: Any) -> list[sqlite3.Row]:
        with self._speaking():
            return self._connection.execute(query, arguments).fetchall()


def _hash(token: str) -> str:
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).hexdigest()


def _json(value: Any) -> str | None:
    return None if value is None else json.dumps(value, allow_nan=False)


def _session(row: sqlite3.Row) -> Session:
    names = ("id", "source", "model", "env_id", "seed", "step", "target", "wish", "created")
    return Session(
        **{name: row[name] for name in names},
        options=json.loads(row["options"]),
        stopped=bool(row["stopped"]),
    )
