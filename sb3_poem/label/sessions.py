"""The sessions of a server: which question is next, what is rendered ahead, what the page shows."""

import asyncio
import json
import logging
import secrets
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from sb3_poem.adaptation.adapter import OtherModelError
from sb3_poem.adaptation.preference import ANSWERS, Preference
from sb3_poem.label.families import ModelInfo
from sb3_poem.label.render_queue import Job, Priority, RenderQueue
from sb3_poem.label.rendering import StorageError, TurnRequest, load_shown_model
from sb3_poem.label.store import RefusedError, Session, Store

_logger = logging.getLogger(__name__)

# A person who has not been heard of for so long has gone, and makes room for another.
GONE_AFTER_SECONDS = 600.0
# A person who watches is heard of at least so often: the page asks for its state when it is shown
# and when it answers.
AT_WORK_SECONDS = 60.0
# While more people are at work than turns can be made at a time, films show every second step: half
# the work.
CROWDED_FILM_EVERY = 2
# Answers that are rarer than the others.
UNLIKELY = (Preference.EQUAL, Preference.MUCH_LEFT, Preference.MUCH_RIGHT)
# Errors that say in words why a turn could not be made.
WORDED_ERRORS = (RefusedError, OtherModelError, StorageError)
UNWORDED = "The videos could not be made. It is tried again; your answers are safe."
# After a turn that could not be made: not at once again.
RETRY_SECONDS = 5.0


class FullError(RuntimeError):
    """As many people are at work as this server takes."""


class _Key(NamedTuple):
    """What a turn follows from: a question's turn (None at the start) and its answer; and the
    number of a question that it asks again.
    """

    question: int | None
    preference: str | None
    kind: str
    repeats: int | None = None


@dataclass
class _Active:
    """What is known of a session between requests; all of it can be made again from the store."""

    seen: float
    jobs: dict[_Key, Job] = field(default_factory=dict)
    kept: tuple[int | None, _Key | None] | None = None
    task: asyncio.Task[None] | None = None
    failed: Exception | None = None
    retry_at: float = 0.0


@dataclass(eq=False)
class SessionManager:
    """All sessions of a server. Its methods belong to one event loop.

    :param options: Of the adaptations, JSON-ready.
    :param n_queries: Questions before the first result, and between results.
    :param max_sessions: How many people may be at work at once.
    :param seed: The next session's seed; None draws each.
    :param load: Loads a chosen model, for the download of its adapted policy.
    """

    store: Store
    queue: RenderQueue
    models: Sequence[ModelInfo]
    options: dict[str, Any] = field(default_factory=dict)
    n_queries: int = 10
    max_sessions: int = 16
    seed: int | None = None
    load: Callable[[ModelInfo], Any] = load_shown_model
    _active: dict[int, _Active] = field(default_factory=dict, init=False)

    def model(self, name: str) -> ModelInfo | None:
        """The model of a name, if it may be chosen."""
        return next((info for info in self.models if info.name == name), None)

    async def begin(self, model: str) -> str:
        """Begin a session with a model of this name, if there is room; its link's token."""
        info = self.model(model)
        if info is None:
            raise RefusedError("there is no model of this name here; choose one from the list")
        self._make_room()
        seed = secrets.randbelow(2**31) if self.seed is None else self.seed
        about = (info.name, info.env_id, seed, self.options, self.n_queries)
        session, token = await asyncio.to_thread(self.store.create_session, *about)
        self._activate(session)
        return token

    async def find(self, token: str) -> Session | None:
        """The session of a link, if there is one; FullError if others leave it no room."""
        session = await asyncio.to_thread(self.store.find, token)
        if session is not None:
            self._activate(session)
        return session

    async def prepare(self, session: Session) -> None:
        """Begin what the page will show, for a person who is about to come to it."""
        self._activate(session)
        session, answers, kind, turn, _ = await asyncio.to_thread(self._look, session.id)
        if turn is None:
            self._begin_turn(session, len(answers), kind)

    async def view(self, session: Session) -> dict[str, Any]:
        """All that the page shows, JSON-ready. What is missing for it is begun."""
        active = self._activate(session)
        session, answers, kind, turn, shown = await asyncio.to_thread(self._look, session.id)
        answered, names = len(answers), ("question", "preference", "fps", "frames")
        view: dict[str, Any] = {
            "phase": "preparing",
            "due": kind,
            "question": session.question,
            "answered": answered,
            "answers": [{name: answer[name] for name in names} for answer in answers],
            "target": session.target,
            "step": session.step,
            "can_undo": answered > 0 or session.stopped,
            "belief": json.loads(shown["belief"] or "null") if shown is not None else None,
        }
        if turn is None or not (self.store.videos / turn["video"]).is_file():
            self._begin_turn(session, answered, kind)
            error = active.failed
            if isinstance(error, StorageError):
                raise error
            if error is not None:
                view["failed"] = str(error) if isinstance(error, WORDED_ERRORS) else UNWORDED
            return view
        if turn["shown"] is None:
            await asyncio.to_thread(self.store.mark_shown, turn["id"])
        view["phase"] = kind
        about = ("id", "fps", "frames", "verdict", "repeats")
        view["turn"] = {name: turn[name] for name in about}
        if kind == "question":
            await self._render_ahead(session, answered, turn["id"])
        return view

    def video(self, session: Session, turn: int) -> Path | None:
        """The file of a turn's video; None if the session has no such turn, or the file is gone."""
        row = self.store.whole_turn(turn)
        if row is None or row["session"] != session.id:
            return None
        path = self.store.videos / row["video"]
        return path if path.is_file() else None

    def model_of(self, session: Session) -> ModelInfo:
        """A session's model; refuses one that is not this server's."""
        info = self.model(session.model)
        if info is None or info.env_id != session.env_id:
            needs = f"the model {session.model!r} in {session.env_id!r}"
            raise RefusedError(
                f"this session needs {needs}, which this server was not started with"
            )
        return info

    def _request(self, session: Session, key: _Key, before: dict[str, Any]) -> TurnRequest:
        """What a turn is made from."""
        info = self.model_of(session)
        since = time.monotonic() - AT_WORK_SECONDS
        at_work = sum(active.seen > since for active in self._active.values())
        film_every = CROWDED_FILM_EVERY if at_work > self.queue.n_workers else 1
        video = self.store.videos / f"{session.id}-{secrets.token_hex(12)}.mp4"
        about = (info, session.seed, session.options, key.kind, video)
        follows = {**before, "preference": key.preference, "repeats": key.repeats}
        return TurnRequest(*about, **follows, film_every=film_every)

    def _look(self, number: int) -> tuple[Session, list[Any], str, Any, Any]:
        """The session, its answers, the kind of the turn that is due, the turn itself, if there is
        one, and it or else the question before.
        """
        session, answers = self.store.session(number), self.store.answers(number)
        answered = len(answers)
        kind = "result" if session.stopped or answered >= session.target else "question"
        turn = self.store.turn(number, kind, answered)
        question = partial(self.store.turn, number, "question")
        return session, answers, kind, turn, turn or question(answered) or question(answered - 1)

    def _activate(self, session: Session) -> _Active:
        if session.id not in self._active:
            self._make_room()
            self._active[session.id] = _Active(0.0)
        self._active[session.id].seen = time.monotonic()
        return self._active[session.id]

    def _make_room(self) -> None:
        now = time.monotonic()
        for number, active in list(self._active.items()):
            if now - active.seen > GONE_AFTER_SECONDS:
                for job in active.jobs.values():
                    self.queue.cancel(job)
                del self._active[number]
        if len(self._active) >= self.max_sessions:
            places = f"all places of this server are taken ({self.max_sessions})"
            raise FullError(f"{places}; come later")

    def _begin_turn(self, session: Session, answered: int, kind: str) -> None:
        active = self._active[session.id]
        is_at_it = active.task is not None and not active.task.done()
        if not is_at_it and time.monotonic() >= active.retry_at:
            active.task = asyncio.create_task(self._make_turn(session, answered, kind))

    async def _make_turn(self, session: Session, answered: int, kind: str) -> None:
        """Have the turn made that the page waits for, or take the one rendered ahead; keep it."""
        active = self._active[session.id]
        try:
            answers = await asyncio.to_thread(self.store.answers, session.id)
            if len(answers) != answered:
                return
            last = answers[-1] if answers else dict.fromkeys(("id", "question", "preference"))
            kept = await asyncio.to_thread(self.store.turn, session.id, kind, answered)
            repeats = None if kept is None else kept["repeats"]
            key = _Key(last["question"], last["preference"], kind, repeats)
            self._keep_only(active, key.question, key)
            job = active.jobs.get(key)
            if job is None or _has_failed(job):
                before: dict[str, Any] = {}
                if key.question is not None:
                    before = await asyncio.to_thread(self.store.adapter_data, key.question)
                request = self._request(session, key, before)
                job = active.jobs[key] = self.queue.submit(request, Priority.WAITED_FOR)
            job.priority = Priority.WAITED_FOR
            made, video = await asyncio.shield(job.done), job.request.video
            is_kept = await asyncio.to_thread(
                self.store.add_turn, session.id, kind, answered, last["id"], made, video.name
            )
            active.jobs.pop(key, None)
            if not is_kept:
                video.unlink(missing_ok=True)
            active.failed, active.retry_at = None, 0.0
        except Exception as error:
            words = "session %d: the %s after %d answers could not be made: %s"
            trace = None if isinstance(error, WORDED_ERRORS) else error
            _logger.error(words, session.id, kind, answered, error, exc_info=trace)
            active.failed, active.retry_at = error, time.monotonic() + RETRY_SECONDS

    async def _render_ahead(self, session: Session, answered: int, question: int) -> None:
        """Begin what follows from each of the question's answers."""
        active = self._active[session.id]
        kind = "result" if answered + 1 >= session.target else "question"
        self._keep_only(active, question)
        answers = {_Key(question, one.value, kind): one for one in ANSWERS[session.question][::-1]}
        if answers.keys() <= active.jobs.keys():
            return
        before = await asyncio.to_thread(self.store.adapter_data, question)
        if active.kept != (question, None):  # it has been answered meanwhile
            return
        for key, answer in answers.items():
            if key in active.jobs:
                continue
            try:
                request = self._request(session, key, before)
            except RefusedError:  # the page says so when the turn is due
                return
            priority = Priority.POSSIBLE if answer in UNLIKELY else Priority.LIKELY
            active.jobs[key] = self.queue.submit(request, priority)

    def _keep_only(self, active: _Active, question: int | None, due: _Key | None = None) -> None:
        """Drop jobs that follow from other questions or, once it is known, from other answers."""
        active.kept = question, due
        for key in list(active.jobs):
            if key.question != question or due not in (None, key):
                self.queue.cancel(active.jobs.pop(key))


def _has_failed(job: Job) -> bool:
    return job.done.cancelled() or (job.done.done() and job.done.exception() is not None)
