"""Answers that were given at a terminal, kept in the same store as those of the page."""

from __future__ import annotations

import shutil
from typing import Any

from sb3_poem.adaptation.human import HumanAnswer
from sb3_poem.label.store import Session, Store
from sb3_poem.label.turns import Turn


class StoreRecorder:
    """Keeps what a ``HumanOracle`` is told: ``HumanOracle(record=StoreRecorder(...))``.

    :param model: The model's name.
    :param env_id: The environment's id.
    :param seed: Of the adaptation.
    :param options: Of the adaptation, JSON-ready.
    :param n_queries: How many answers there will be at most.
    :param wish: What the person wants, in their own words.
    :param resume: Whether to go on with the last terminal session that has answers and agrees in
        all of this, if there is one. The adapter must be told first what :meth:`kept` gives.
    """

    def __init__(
        self,
        store: Store,
        model: str,
        env_id: str,
        seed: int,
        options: dict[str, Any] | None = None,
        n_queries: int = 10,
        wish: str = "",
        resume: bool = False,
    ) -> None:
        self.store = store
        about = (model, env_id, seed, options or {}, n_queries)
        found = self._last_session(*about) if resume else None
        self.resumed = found is not None
        self.session = found or store.create_session(*about, source="terminal")[0]
        if wish:
            store.set_wish(self.session.id, wish)
        answers = store.answers(self.session.id)
        self._count = len(answers)
        self._last: int | None = answers[-1]["id"] if answers else None

    def _last_session(self, *about: Any) -> Session | None:
        for session in reversed(self.store.sessions()):
            facts = (session.model, session.env_id, session.seed, session.options, session.step)
            if session.source == "terminal" and facts == about and self.store.answers(session.id):
                return session
        return None

    def kept(self) -> list[dict[str, Any]]:
        """The session's answers so far: ``preference``, ``left`` and ``right`` of each."""
        return self.store.conversation(self.session.id, self._count)

    def __call__(self, answer: HumanAnswer) -> None:
        """Keep an answer; it is on the disk when this returns."""
        name = f"{self.session.id}-terminal-{self._count + 1:03d}{answer.video.suffix}"
        shutil.copyfile(answer.video, self.store.videos / name)
        frames = max(len(answer.left.frames or ()), len(answer.right.frames or ()))
        turn = Turn(
            None, answer.left.to_dict(), answer.right.to_dict(), None, None, answer.fps, frames
        )
        self.store.add_turn(
            self.session.id,
            "question",
            self._count,
            self._last,
            turn,
            name,
            answer.asked,
            answer.shown,
        )
        question = self.store.turn(self.session.id, "question", self._count)
        assert question is not None
        self._last = self.store.add_answer(self.session.id, question["id"], answer.preference.value)
        self._count += 1
