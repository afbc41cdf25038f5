"""Where sessions, questions and answers are kept: a kill at any moment loses no answer."""

import hashlib
import json
import secrets
import shutil
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from sb3_poem.adaptation.adapter import shown_to_dict
from sb3_poem.adaptation.oracles import HumanAnswer
from sb3_poem.adaptation.preference import Preference, as_preference
from sb3_poem.label.rendering import StorageError, Turn

VERDICTS = ("yes", "not quite")
MAX_WISH = 2000  # characters
LOOK_AGAIN = "look again at the page"
MOVED_ON = f"the conversation has moved on; {LOOK_AGAIN}"
SCHEMA_VERSION = 4
SCHEMA = f"""
CREATE TABLE sessions (
    id INTEGER PRIMARY KEY,
    token_hash TEXT NOT NULL UNIQUE,
    source TEXT NOT NULL,            -- 'page', 'notebook' or 'terminal'
    model TEXT NOT NULL,
    env_id TEXT NOT NULL,
    seed INTEGER NOT NULL,           -- of the adaptation
    options TEXT NOT NULL,           -- of the adaptation, JSON
    step INTEGER NOT NULL,           -- questions before the first result, and between results
    target INTEGER NOT NULL,         -- the next result comes after so many answers
    stopped INTEGER NOT NULL DEFAULT 0,  -- whether the person asked for the result before
    wish TEXT NOT NULL DEFAULT '',   -- in the person's own words
    created REAL NOT NULL            -- seconds since 1970, as all times
);
CREATE TABLE turns (
    id INTEGER PRIMARY KEY,
    session INTEGER NOT NULL REFERENCES sessions(id),
    kind TEXT NOT NULL CHECK (kind IN ('question', 'result')),
    number INTEGER NOT NULL,         -- answers before it
    repeats INTEGER,                 -- number of the question that it asks again
    state TEXT,                      -- JSON, or NULL where nothing continues from it
    trajectories TEXT,               -- what a question shows, by its place: JSON
    belief TEXT,                     -- JSON
    latent TEXT,                     -- JSON
    video TEXT NOT NULL,
    fps REAL NOT NULL,
    frames INTEGER NOT NULL,
    created REAL NOT NULL,
    shown REAL,
    verdict TEXT CHECK (verdict IN ('yes', 'not quite')),
    verdict_time REAL,
    dropped REAL                     -- when an undo, or one asked again, made it void
);
CREATE UNIQUE INDEX one_turn ON turns(session, kind, number) WHERE dropped IS NULL;
CREATE TABLE answers (
    id INTEGER PRIMARY KEY,
    session INTEGER NOT NULL REFERENCES sessions(id),
    question INTEGER NOT NULL REFERENCES turns(id),
    number INTEGER NOT NULL,         -- answers before it
    preference TEXT NOT NULL CHECK (preference IN {tuple(each.value for each in Preference)}),
    created REAL NOT NULL,
    undone REAL
);
CREATE UNIQUE INDEX one_answer ON answers(session, number) WHERE undone IS NULL;
"""
# Of a question that is asked again: where the conversation stands, and what is shown.
STANDS = ("session", "kind", "number", "state", "belief", "latent")
SHOWS = ("trajectories", "video", "fps", "frames")


class RefusedError(ValueError):
    """What was asked for does not fit the session as it now is; nothing was changed."""


@dataclass(frozen=True)
class Session:
    """A person's conversation: a row of the table ``sessions``."""

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

    @property
    def question(self) -> str:
        """The kind of its questions, see :class:`~sb3_poem.adaptation.preference.Query`."""
        return str(self.options.get("question", "pair"))


class Store:
    """The store. One connection, used by one thread at a time; several processes may open the same
    file. Sessions, turns and answers are named by their numbers, and a turn's place by the number
    of answers before it. :class:`~sb3_poem.label.rendering.StorageError` says that the disk is full
    or broken.

    >>> store = Store("label_data")
    >>> session, token = store.create_session("PointGoal", "poem/PointGoal-v0", 0, {})
    >>> store.answers(session.id), store.find(token) == session
    ([], True)

    :param folder: It is made if missing, for its owner alone: ``answers.sqlite`` and ``videos/``
    :raises ValueError: If the store is of another version.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.videos = self.folder / "videos"
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.videos.mkdir(mode=0o700, exist_ok=True)
        self.path = self.folder / "answers.sqlite"
        self._lock = threading.RLock()
        with self._locked():
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
        """Begin a conversation; returns the token of its link too, of which only a hash is kept."""
        token, about = secrets.token_urlsafe(32), {"model": model, "env_id": env_id, "seed": seed}
        about |= {"options": json.dumps(options), "step": step, "target": step}
        about |= {"source": source, "created": time.time(), "token_hash": _hash(token)}
        with self._transaction():
            number = self._insert("sessions", **about)
        return self.session(number), token

    def find(self, token: str) -> Session | None:
        """The session of a link's token, if there is one."""
        row = self._one("SELECT * FROM sessions WHERE token_hash = ?", _hash(token))
        return None if row is None else _session(row)

    def session(self, number: int) -> Session:
        """A session; KeyError if there is none."""
        row = self._one("SELECT * FROM sessions WHERE id = ?", number)
        if row is None:
            raise KeyError(f"there is no session {number}")
        return _session(row)

    def sessions(self) -> list[Session]:
        """All sessions, the oldest first."""
        return [_session(row) for row in self._execute("SELECT * FROM sessions ORDER BY id")]

    def answers(self, session: int) -> list[sqlite3.Row]:
        """The rows of the answers in force, in order, with their films' ``fps`` and ``frames``."""
        return self._execute(
            "SELECT answers.*, turns.fps, turns.frames "
            "FROM answers JOIN turns ON turns.id = answers.question "
            "WHERE answers.session = ? AND undone IS NULL ORDER BY answers.number",
            session,
        )

    def turn(self, session: int, kind: str, number: int) -> sqlite3.Row | None:
        """The row of a "question" or "result" that counts, if any, without what is large."""
        return self._one(
            "SELECT id, session, kind, number, belief, latent, video, fps, frames, created, shown, "
            "verdict, repeats FROM turns "
            "WHERE session = ? AND kind = ? AND number = ? AND dropped IS NULL",
            *(session, kind, number),
        )

    def whole_turn(self, turn: int) -> sqlite3.Row | None:
        """The whole row of a turn, whether it counts or not."""
        return self._one("SELECT * FROM turns WHERE id = ?", turn)

    def adapter_answers(self, session: int, before: int = 2**31) -> list[dict[str, Any]]:
        """The answers, or the first so many: ``preference``, and what was shown by its place,
        ``left`` and ``right``, say, of each.
        """
        query = """SELECT answers.preference, turns.trajectories
            FROM answers JOIN turns ON turns.id = answers.question
            WHERE answers.session = ? AND answers.undone IS NULL AND answers.number < ?
            ORDER BY answers.number"""
        return [
            {"preference": row["preference"], **json.loads(row["trajectories"])}
            for row in self._execute(query, session, before)
        ]

    def adapter_data(self, turn: int) -> dict[str, Any]:
        """The adapter's dictionary of a turn: ``answers``, ``pending``, the rest as ``state``."""
        row: Any = self.whole_turn(turn)
        return {
            "state": json.loads(row["state"]),
            "answers": self.adapter_answers(row["session"], row["number"]),
            "pending": json.loads(row["trajectories"] or "null"),
        }

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
    ) -> int | None:
        """Keep a turn, if the conversation still is where it was made for, and it has not been kept
        already; of one that has, the video takes the place of one that somebody deleted.

        :param last_answer: The last of the answers before it; None at the start.
        :param video: Its file's name within ``videos/``.
        :param created: Seconds since 1970, as ``shown``; None is now.
        :return: The turn's number; None if it was not kept.
        """
        with self._transaction() as execute:
            here = [answer["id"] for answer in self.answers(session)]
            if number > len(here) or (here[number - 1] if number else None) != last_answer:
                return None
            film = {"video": video, "fps": turn.fps, "frames": turn.frames}
            kept = self.turn(session, kind, number)
            if kept is not None:
                if (self.videos / kept["video"]).is_file():
                    return None
                put = "UPDATE turns SET video = :video, fps = :fps, frames = :frames WHERE id = :id"
                execute(put, {**film, "id": kept["id"]})
                return int(kept["id"])
            about = {"session": session, "kind": kind, "number": number, "shown": shown}
            made = {name: _json(getattr(turn, name)) for name in ("state", "belief", "latent")}
            made["trajectories"] = _json(turn.shown)
            now = time.time()
            return self._insert("turns", created=created or now, **about, **made, **film)

    def mark_shown(self, turn: int) -> None:
        """Note that a turn has been shown, the first time."""
        put = "UPDATE turns SET shown = ? WHERE id = ? AND shown IS NULL"
        self._execute(put, time.time(), turn)

    def add_answer(self, session: int, question: int, preference: str) -> int:
        """Keep an answer to a question's turn, if that one waits: once this returns, it is on the
        disk. The same answer again is no second one.
        """
        try:
            as_preference(preference[:20], self.session(session).question)
        except ValueError as error:
            raise RefusedError(str(error)) from None
        with self._transaction():
            answers = self.answers(session)
            for answer in answers:
                if answer["question"] == question and answer["preference"] == preference:
                    return int(answer["id"])
            current = self.turn(session, "question", len(answers))
            waits = current is not None and current["id"] == question
            _insist(waits, f"this question is not the one that waits for an answer; {LOOK_AGAIN}")
            about, number = self.session(session), len(answers)
            is_over = about.stopped or number >= about.target
            _insist(not is_over, "the questions are over for now; the result is shown")
            given = {"session": session, "question": question, "preference": preference}
            return self._insert("answers", number=number, created=time.time(), **given)

    def ask_again(self, session: int, question: int) -> None:
        """Ask once more about what the answer was to that the others contradict, as the waiting
        question has it, instead of that one. The same wish again changes nothing.
        """
        with self._transaction() as execute:
            answers = self.answers(session)
            waiting = self.turn(session, "question", len(answers))
            if waiting is not None and waiting["repeats"] is not None:
                return
            if waiting is None or waiting["id"] != question:
                raise RefusedError(MOVED_ON)
            number = json.loads(waiting["belief"] or "{}").get("contradicted")
            _insist(number is not None, "no answer is contradicted by the others")
            stands: Any = self.whole_turn(question)
            shows: Any = self.whole_turn(answers[number]["question"])
            again = {name: stands[name] for name in STANDS} | {name: shows[name] for name in SHOWS}
            now = time.time()
            execute("UPDATE turns SET dropped = ? WHERE id = ?", (now, question))
            self._insert("turns", created=now, repeats=shows["number"], **again)

    def undo(self, session: int, answered: int) -> None:
        """Take the last of ``answered`` answers back, as many as there were where it was asked for,
        and go on with its question.
        """
        with self._transaction() as execute:
            answers = self.answers(session)
            _insist(answered == len(answers), MOVED_ON)
            _insist(answers, "there is no answer to take back")
            now = time.time()
            execute("UPDATE answers SET undone = ? WHERE id = ?", (now, answers[-1]["id"]))
            which = "session = ? AND number >= ? AND dropped IS NULL"
            execute(f"UPDATE turns SET dropped = ? WHERE {which}", (now, session, answered))
            execute("UPDATE sessions SET stopped = 0 WHERE id = ?", (session,))

    def stop(self, session: int, stopped: int) -> None:
        """Show the result after the answers so far; 0 goes back to the question that waited."""
        self._execute("UPDATE sessions SET stopped = ? WHERE id = ?", stopped != 0, session)

    def judge(self, session: int, result: int, verdict: str) -> None:
        """Keep what the person says of the result that is shown; "not quite" asks for more
        questions. The same verdict again changes nothing.
        """
        _insist(verdict in VERDICTS, 'a verdict must be "yes" or "not quite"')
        with self._transaction() as execute:
            about, answered = self.session(session), len(self.answers(session))
            current = self.turn(session, "result", answered)
            is_over = about.stopped or answered >= about.target
            is_shown = is_over and current is not None and current["id"] == result
            _insist(is_shown, f"this result is not the one that is shown; {LOOK_AGAIN}")
            given = (verdict, time.time(), result)
            execute("UPDATE turns SET verdict = ?, verdict_time = ? WHERE id = ?", given)
            if verdict == "not quite":
                more = (answered + about.step, session)
                execute("UPDATE sessions SET stopped = 0, target = ? WHERE id = ?", more)

    def set_wish(self, session: int, wish: str) -> None:
        """Keep what the person wants, in their own words; a wish that is too long is refused."""
        fits = len(wish) <= MAX_WISH
        _insist(fits, f"what you wish for may be {MAX_WISH} characters long at most")
        self._execute("UPDATE sessions SET wish = ? WHERE id = ?", wish, session)

    def records(self, session: int | None = None) -> list[sqlite3.Row]:
        """The answers of one session or of all, with their questions, those taken back too, in the
        order of time.
        """
        return self._execute(
            """SELECT sessions.id AS session, sessions.source, sessions.model, sessions.env_id,
                sessions.seed, sessions.options, sessions.wish, answers.number, answers.preference,
                turns.repeats,
                answers.created AS answered, answers.undone, turns.created AS asked, turns.shown,
                turns.video, turns.fps, turns.frames, turns.trajectories,
                (SELECT results.verdict FROM turns AS results
                    WHERE results.session = sessions.id AND results.kind = 'result'
                    AND results.verdict IS NOT NULL AND results.dropped IS NULL
                    ORDER BY results.number DESC LIMIT 1) AS verdict
            FROM answers JOIN sessions ON sessions.id = answers.session
                JOIN turns ON turns.id = answers.question
            WHERE ? IS NULL OR sessions.id = ? ORDER BY answers.id""",
            *(session, session),
        )

    def remove_orphans(self) -> int:
        """Delete videos that no turn names, as of answers that were not given; returns how many."""
        kept = {row["video"] for row in self._execute("SELECT video FROM turns")}
        old = time.time() - 60  # a younger one's turn may be still to come
        files = [file for file in self.videos.iterdir() if file.stat().st_mtime < old]
        orphans = [file for file in files if file.is_file() and file.name not in kept]
        for file in orphans:
            file.unlink(missing_ok=True)
        return len(orphans)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """One thread at a time, and SQLite's errors as sentences."""
        with self._lock:
            try:
                yield
            except sqlite3.DatabaseError as error:
                hint = " (is the disk full?)" if "disk I/O" in str(error) else ""
                words = f"{self.path} cannot be read or written: {error}{hint}"
                raise StorageError(words) from error

    @contextmanager
    def _transaction(self) -> Iterator[Callable[..., sqlite3.Cursor]]:
        """All or nothing; one within another is part of it."""
        with self._locked():
            if self._connection.in_transaction:
                yield self._connection.execute
                return
            with self._connection:
                self._connection.execute("BEGIN IMMEDIATE")
                yield self._connection.execute

    def _make_tables(self) -> None:
        with self._transaction() as execute:
            version = execute("PRAGMA user_version").fetchone()[0]
            if version not in (0, SCHEMA_VERSION):
                reads = f"this program reads version {SCHEMA_VERSION}; name another folder"
                raise ValueError(f"{self.path} is a store of version {version}, and {reads}")
            for statement in SCHEMA.split(";") if version == 0 else ():
                execute(statement)
            execute(f"PRAGMA user_version = {SCHEMA_VERSION}")

    def _insert(self, table: str, **values: Any) -> int:
        """Within a transaction; the row's number."""
        names, places = ", ".join(values), ", ".join(f":{name}" for name in values)
        statement = f"INSERT INTO {table} ({names}) VALUES ({places})"
        return self._connection.execute(statement, values).lastrowid or 0

    def _one(self, query: str, *arguments: Any) -> sqlite3.Row | None:
        return next(iter(self._execute(query, *arguments)), None)

    def _execute(self, query: str, *arguments: Any) -> list[sqlite3.Row]:
        with self._locked():
            return self._connection.execute(query, arguments).fetchall()


def _insist(fits: object, otherwise: str) -> None:
    if not fits:
        raise RefusedError(otherwise)


def _hash(token: str) -> str:
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).hexdigest()


def _json(value: Any) -> str | None:
    return None if value is None else json.dumps(value, allow_nan=False)


def _session(row: sqlite3.Row) -> Session:
    values = {field.name: row[field.name] for field in fields(Session)}
    return Session(
        **{**values, "options": json.loads(row["options"]), "stopped": bool(row["stopped"])}
    )


class StoreRecorder:
    """Keeps what a ``HumanOracle`` is told at a terminal, in the same store as the page's answers:
    ``HumanOracle(record=StoreRecorder(...))``.

    >>> from sb3_poem import HumanOracle
    >>> recorder = StoreRecorder(Store("label_data"), "PointGoal", "poem/PointGoal-v0", seed=0)
    >>> oracle = HumanOracle(record=recorder)
    >>> recorder.kept()
    []

    :param options: Of the adaptation, JSON-ready, as ``seed``
    :param n_queries: How many answers there will be at most.
    :param resume: Whether to go on with the last terminal session that has answers and agrees in
        all of this, if there is one. The adapter must be told first what :meth:`kept` gives.
    :raises ValueError: If there is none to resume, but an unfinished one of this model and
        environment, begun with other arguments.
    """

    def __init__(
        self,
        store: Store,
        model: str,
        env_id: str,
        seed: int,
        options: dict[str, Any] | None = None,
        n_queries: int = 10,
        resume: bool = False,
    ) -> None:
        self.store = store
        about = (model, env_id, seed, options or {}, n_queries)
        found = [one for one in store.sessions() if resume and self._agrees(one, about)]
        self.resumed = bool(found)
        if resume and not found:
            self._refuse_other(about)
        self.session = found[-1] if found else store.create_session(*about, source="terminal")[0]

    def _agrees(self, one: Session, about: tuple[Any, ...]) -> bool:
        facts = (one.source, one.model, one.env_id, one.seed, one.options, one.step)
        return facts == ("terminal", *about) and bool(self.store.answers(one.id))

    def _refuse_other(self, about: tuple[Any, ...]) -> None:
        """Of unfinished sessions one may be meant that was begun a little otherwise."""
        for one in reversed(self.store.sessions()):
            n = len(self.store.answers(one.id))
            if (one.source, one.model, one.env_id) == ("terminal", *about[:2]) and 0 < n < one.step:
                names = ("seed", "options", "n_queries")
                own = zip(names, (one.seed, one.options, one.step), about[2:], strict=True)
                others = [f"{name} {was}, not {now}" for name, was, now in own if was != now]
                raise ValueError(
                    f"nothing to resume: session {one.id} has {n} of {one.step} answers, but was "
                    f"begun with {'; '.join(others)}. Give the same, or begin anew without resume"
                )

    def kept(self) -> list[dict[str, Any]]:
        """The session's answers so far, see :meth:`Store.adapter_answers`."""
        return self.store.adapter_answers(self.session.id)

    def __call__(self, answer: HumanAnswer) -> None:
        """Keep an answer; it is on the disk when this returns."""
        store, session = self.store, self.session.id
        before = store.answers(session)
        last, number = before[-1]["id"] if before else None, len(before)
        name = f"{session}-terminal-{number + 1:03d}{answer.video.suffix}"
        shutil.copyfile(answer.video, store.videos / name)
        query = answer.query
        frames = max(len(item.frames or ()) for item in query.shown)
        shown = shown_to_dict(query.kind, query.shown)
        turn = Turn(None, shown, None, None, answer.fps, frames)
        with store._transaction():  # a question alone would be in the way of the next try
            question = store.add_turn(
                session, "question", number, last, turn, name, answer.asked, answer.shown
            )
            if question is None:
                raise RefusedError(f"session {session} has been answered elsewhere meanwhile")
            store.add_answer(session, question, answer.preference.value)
