"""Conversations: which question is next, what is rendered ahead, and what a page needs to know of
it all.
"""

from __future__ import annotations

import asyncio
import json
import logging
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sb3_poem.adaptation.adapter import OtherModelError
from sb3_poem.label.catalogue import Choice
from sb3_poem.label.store import RefusedError, Session, Store
from sb3_poem.label.turns import Request, Turn, load_choice
from sb3_poem.label.videos import StorageError
from sb3_poem.label.workshop import LIKELY, POSSIBLE, WAITED_FOR, Job, Workshop

_logger = logging.getLogger(__name__)

PREFERENCES = ("left", "right", "equal")
# A person who has not been heard of for so long has gone, and makes room for another.
GONE_AFTER_SECONDS = 600.0
# A person who watches is heard of at least so often: the page asks for its state when it is shown
# and when it answers.
AT_WORK_SECONDS = 60.0
# While more people are at work than turns can be made at a time, films show every second step: half
# the work.
CROWDED_FILM_EVERY = 2
# Errors that say in words why a turn could not be made.
TOLD = (RefusedError, OtherModelError, StorageError)
# After a turn that could not be made: not at once again.
RETRY_SECONDS = 5.0


class FullError(RuntimeError):
    """As many people are at work as this server takes."""


@dataclass
class _Presence:
    """What is known of a session between requests; all of it can be made again from the store."""

    seen: float
    #: (number of the question's turn or None at the start, preference, kind) -> the turn that
    #: follows.
    jobs: dict[tuple[int | None, str | None, str], Job] = field(default_factory=dict)
    task: asyncio.Task[None] | None = None
    failed: Exception | None = None
    failed_at: float = 0.0


class Conversations:
    """All sessions of a server. Its methods belong to one event loop.

    :param store: Where they are kept.
    :param workshop: Where turns are made.
    :param catalogue: The models that may be chosen.
    :param options: Of the adaptations, JSON-ready.
    :param n_queries: Questions before the first result, and between results.
    :param max_sessions: How many people may be at work at once.
    :param seed: The next session's seed; None draws each.
    :param load: Loads a chosen model, for the download of its adapted policy.
    """

    def __init__(
        self,
        store: Store,
        workshop: Workshop,
        catalogue: list[Choice],
        options: dict[str, Any] | None = None,
        n_queries: int = 10,
        max_sessions: int = 16,
        seed: int | None = None,
        load: Callable[[Choice], Any] = load_choice,
    ) -> None:
        self.store = store
        self.workshop = workshop
        self.catalogue = {choice.name: choice for choice in catalogue}
        self.options = dict(options or {})
        self.n_queries = n_queries
        self.max_sessions = max_sessions
        self.load = load
        self._seed = seed
        self._present: dict[int, _Presence] = {}

    async def begin(self, model: str) -> str:
        """Begin a conversation.

        :param model: The name of a model in the catalogue.
        :return: The token of its link.
        :raises RefusedError: If there is no such model.
        :raises FullError: If too many people are at work.
        """
        choice = self.catalogue.get(model)
        if choice is None:
            raise RefusedError("there is no model of this name here; choose one from the list")
        self._make_room()
        seed = secrets.randbelow(2**31) if self._seed is None else self._seed
        session, token = await asyncio.to_thread(
            self.store.create_session,
            choice.name,
            choice.env_id,
            seed,
            self.options,
            self.n_queries,
        )
        self._presence(session)
        return token

    async def find(self, token: str) -> Session | None:
        """The session of a link.

        :return: The session, or None.
        :raises FullError: If its person is not at work and too many others are.
        """
        session = await asyncio.to_thread(self.store.find, token)
        if session is not None:
            self._presence(session)
        return session

    async def view(self, session: Session) -> dict[str, Any]:
        """All that the page shows. What is missing for it is begun.

        :return: JSON-ready.
        :raises StorageError: If it cannot be kept.
        """
        presence = self._presence(session)
        session, answered, turn, before = await asyncio.to_thread(self._look, session.id)
        wanted = "result" if session.stopped or answered >= session.target else "question"
        view: dict[str, Any] = {
            "phase": "preparing",
            "model": session.model,
            "answered": answered,
            "target": session.target,
            "step": session.step,
            "wish": session.wish,
            "can_undo": answered > 0 or session.stopped,
            "belief": None,
        }
        shown = turn or before
        if shown is not None and shown["belief"] is not None:
            view["belief"] = json.loads(shown["belief"])
        if turn is None or not (self.store.videos / turn["video"]).is_file():
            self._begin_turn(session, answered, wanted)
            if isinstance(presence.failed, StorageError):
                raise presence.failed
            if presence.failed is not None:
                told, kind = isinstance(presence.failed, TOLD), type(presence.failed).__name__
                view["failed"] = str(presence.failed) if told else f"{kind}; it is tried again"
            return view
        if turn["shown"] is None:
            await asyncio.to_thread(self.store.mark_shown, turn["id"])
        view["phase"] = wanted
        view["turn"] = {
            "id": turn["id"],
            "fps": turn["fps"],
            "frames": turn["frames"],
            "verdict": turn["verdict"],
        }
        if wanted == "question":
            self._render_ahead(session, answered, turn["id"])
        return view

    async def answer(self, session: Session, question: int, preference: str) -> None:
        """Keep an answer; it is on the disk when this returns.

        :param question: The number of the question's turn.
        :param preference: "left", "right" or "equal".
        :raises RefusedError: If it is no answer, or that question is not the one that waits.
        """
        if preference not in PREFERENCES:
            raise RefusedError(
                f'an answer must be "left", "right" or "equal", but is {preference[:20]!r}'
            )
        await asyncio.to_thread(self.store.add_answer, session.id, question, preference)

    def video(self, session: Session, number: int) -> Path | None:
        """The file of a turn's video.

        :param number: The turn's number.
        :return: The file; None if the session has no such turn, or the file is gone.
        """
        turn = self.store.whole_turn(number)
        if turn is None or turn["session"] != session.id:
            return None
        path = self.store.videos / turn["video"]
        return path if path.is_file() else None

    def request(
        self, session: Session, number: int, preference: str | None, wanted: str
    ) -> Request:
        """What a turn is made from.

        :param number: Answers before the question from which it follows.
        :param preference: The answer to that question; None at the start.
        :param wanted: "question" or "result".
        :return: The request.
        :raises RefusedError: If the session's model is not in the catalogue.
        """
        choice = self.catalogue.get(session.model)
        if choice is None or choice.env_id != session.env_id:
            raise RefusedError(
                f"this session needs the model {session.model!r} in {session.env_id!r}, which this server was not started with"
            )
        film_every = CROWDED_FILM_EVERY if self._is_crowded() else 1
        video = self.store.videos / f"{session.id}-{secrets.token_hex(12)}.mp4"
        if preference is None:
            return Request(
                choice, session.seed, session.options, wanted, video, film_every=film_every
            )
        row = self.store.turn(session.id, "question", number)
        question = None if row is None else self.store.whole_turn(row["id"])
        if question is None:
            raise RefusedError("the question before is missing")
        pending = {
            "left": json.loads(question["left_trajectory"]),
            "right": json.loads(question["right_trajectory"]),
        }
        answers = self.store.conversation(session.id, number)
        state = json.loads(question["state"])
        return Request(
            choice,
            session.seed,
            session.options,
            wanted,
            video,
            state,
            answers,
            pending,
            preference,
            film_every,
        )

    def _look(self, number: int) -> tuple[Session, int, Any, Any]:
        """The session as it is now, its answers, the turn that should be shown, and the question
        before it.
        """
        session = self.store.session(number)
        answered = len(self.store.answers(number))
        kind = "result" if session.stopped or answered >= session.target else "question"
        turn = self.store.turn(number, kind, answered)
        before = None
        if turn is None:
            before = self.store.turn(number, "question", answered) or self.store.turn(
                number, "question", answered - 1
            )
        return session, answered, turn, before

    def _presence(self, session: Session) -> _Presence:
        presence = self._present.get(session.id)
        if presence is None:
            self._make_room()
            presence = self._present[session.id] = _Presence(time.monotonic())
        presence.seen = time.monotonic()
        return presence

    def _is_crowded(self) -> bool:
        since = time.monotonic() - AT_WORK_SECONDS
        return (
            sum(presence.seen > since for presence in list(self._present.values()))
            > self.workshop.n_workers
        )

    def _make_room(self) -> None:
        now = time.monotonic()
        for number, presence in list(self._present.items()):
            if now - presence.seen > GONE_AFTER_SECONDS:
                for job in presence.jobs.values():
                    self.workshop.discard(job)
                del self._present[number]
        if len(self._present) >= self.max_sessions:
            raise FullError(
                f"{self.max_sessions} people are at work already, which is as many as this server takes; come later"
            )

    def _begin_turn(self, session: Session, answered: int, wanted: str) -> None:
        presence = self._present[session.id]
        if presence.task is not None and not presence.task.done():
            return
        if presence.failed is not None and time.monotonic() - presence.failed_at < RETRY_SECONDS:
            return
        presence.task = asyncio.get_running_loop().create_task(
            self._make_turn(session, answered, wanted)
        )

    async def _make_turn(self, session: Session, answered: int, wanted: str) -> None:
        """Have the turn made that the page waits for, or take the one that was rendered ahead, and
        keep it.
        """
        presence = self._present[session.id]
        try:
            answers = await asyncio.to_thread(self.store.answers, session.id)
            if len(answers) != answered:
                return
            last = answers[-1] if answers else None
            key = (
                (last["question"], last["preference"], wanted)
                if last is not None
                else (None, None, wanted)
            )
            job = presence.jobs.get(key)
            self._keep_only(presence, None if last is None else last["question"], key)
            if (
                job is None
                or job.done.cancelled()
                or (job.done.done() and job.done.exception() is not None)
            ):
                preference = None if last is None else last["preference"]
                request = await asyncio.to_thread(
                    self.request, session, answered - 1, preference, wanted
                )
                job = presence.jobs[key] = self.workshop.submit(request, WAITED_FOR)
            self.workshop.hurry(job)
            made = await asyncio.shield(job.done)
            last_answer = None if last is None else last["id"]
            video = job.request.video
            kept = await asyncio.to_thread(
                self.store.add_turn, session.id, wanted, answered, last_answer, made, video.name
            )
            presence.jobs.pop(key, None)
            if not kept:
                await asyncio.to_thread(self._put_back, session, answered, wanted, video, made)
            presence.failed = None
        except asyncio.CancelledError:
            raise
        except Exception as error:
            words = "session %d: the %s after %d answers could not be made: %s"
            trace = None if isinstance(error, TOLD) else error
            _logger.error(words, session.id, wanted, answered, error, exc_info=trace)
            presence.failed = error
            presence.failed_at = time.monotonic()

    def _put_back(
        self, session: Session, answered: int, wanted: str, video: Path, made: Turn
    ) -> None:
        """Of a turn that is kept already, the video takes the place of one that somebody deleted;
        else it is not needed.
        """
        turn = self.store.turn(session.id, wanted, answered)
        if turn is not None and not (self.store.videos / turn["video"]).is_file():
            self.store.note_film(
                turn["id"], made.fps, made.frames
            )  # first: whoever finds the film finds what it is
            video.replace(self.store.videos / turn["video"])
        else:
            video.unlink(missing_ok=True)

    def _render_ahead(self, session: Session, answered: int, question: int) -> None:
        """Begin what follows from each of the three answers."""
        presence = self._present[session.id]
        kind = "result" if answered + 1 >= session.target else "question"
        self._keep_only(presence, question)
        missing = [
            preference
            for preference in PREFERENCES
            if (question, preference, kind) not in presence.jobs
        ]
        if not missing:
            return
        try:
            requests = [self.request(session, answered, preference, kind) for preference in missing]
        except RefusedError:  # the page says so when the turn is due
            return
        for preference, request in zip(missing, requests, strict=True):
            urgency = POSSIBLE if preference == "equal" else LIKELY
            presence.jobs[question, preference, kind] = self.workshop.submit(request, urgency)

    def _keep_only(
        self,
        presence: _Presence,
        question: int | None,
        wanted: tuple[int | None, str | None, str] | None = None,
    ) -> None:
        """Drop jobs that follow from other questions, or, once the answer is known, from other
        answers.
        """
        for key in list(presence.jobs):
            if key[0] != question or (wanted is not None and key != wanted):
                self.workshop.discard(presence.jobs.pop(key))
