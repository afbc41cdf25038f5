"""Answers that were given at a terminal, kept in the same store as those of the page."""

from __future__ import annotations

import shutil
from typing import Any

from sb3_poem.adaptation.human import HumanAnswer
from sb3_poem.label.store import Store
from sb3_poem.label.turns import Turn


class StoreRecorder:
    """
    Keeps what a ``HumanOracle`` is told: ``HumanOracle(record=StoreRecorder(...))``.

    :param store: The store.
    :param model: The model's name.
    :param env_id: The environment's id.
    :param seed: Of the adaptation.
    :param options: Of the adaptation, JSON-ready.
    :param n_queries: How many answers there will be at most.
    :param wish: What the person wants, in their own words.
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
    ) -> None:
        self.store = store
        self.session, _ = store.create_session(model, env_id, seed, options or {}, n_queries, source="terminal")
        store.set_wish(self.session.id, wish)
        self._count = 0
        self._last: int | None = None

    def __call__(self, answer: HumanAnswer) -> None:
        """
        Keep an answer; it is on the disk when this returns.

        :param answer: It.
        """
        name = f"{self.session.id}-terminal-{self._count + 1:03d}{answer.video.suffix}"
        shutil.copyfile(answer.video, self.store.videos / name)
        frames = max(len(answer.left.frames or ()), len(answer.right.frames or ()))
        turn = Turn(None, answer.left.to_dict(), answer.right.to_dict(), None, None, answer.fps, frames)
        self.store.add_turn(self.session.id, "question", self._count, self._last, turn, name, answer.asked, answer.shown)
        question = self.store.turn(self.session.id, "question", self._count)
        assert question is not None
        self._last = self.store.add_answer(self.session.id, question["id"], answer.preference.value)
        self._count += 1
