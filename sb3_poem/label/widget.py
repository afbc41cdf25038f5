"""The page within a Jupyter notebook."""

from __future__ import annotations

import html
import json
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

from poem_envs.headless import release_graphics
from sb3_poem.adaptation.adapter import PreferenceAdapter
from sb3_poem.label.access import Access
from sb3_poem.label.catalogue import Choice
from sb3_poem.label.hosting import BackgroundServer
from sb3_poem.label.server import make_app
from sb3_poem.label.sessions import Conversations
from sb3_poem.label.store import Session, Store
from sb3_poem.label.turns import CONVERSATION, Bench, Request, Turn
from sb3_poem.label.workshop import Workshop


class LabelWidget:
    """The page on which a person answers, for an adapter in a notebook: the last expression of a
    cell shows it.

    .. code-block:: python

        env = gym.make("poem/HalfCheetahVel-v0", render_mode="rgb_array")
        widget = LabelWidget(PreferenceAdapter(model, env))
        widget                      # answer in the page below the cell
        policy = widget.policy()    # in a later cell

    The server runs in this process, on loopback: the browser must run on the same machine, or its
    port be forwarded.

    :param adapter: The adapter; its environment must have been made with
        ``render_mode="rgb_array"``. Do not use the adapter or its environment elsewhere meanwhile;
        :meth:`sync` brings it to where the person stands.
    :param store: The folder of the store; None takes a temporary one, which ends with the widget.
    :param height: Of the page in the notebook, pixels.
    :param port: The server's port; 0 takes a free one.
    :raises ValueError: If the environment does not render, or the adapter has answers already or
        asks from a library.
    """

    def __init__(
        self,
        adapter: PreferenceAdapter,
        store: str | Path | None = None,
        height: int = 900,
        port: int = 0,
    ) -> None:
        if not isinstance(adapter, PreferenceAdapter):
            raise TypeError(
                f"`adapter` must be a PreferenceAdapter, but is a {type(adapter).__name__}"
            )
        if adapter.answers or adapter.pending is not None:
            raise ValueError("`adapter` has been asked already; give the widget a fresh one")
        if adapter.library is not None:
            raise ValueError("`adapter` asks from a library; the page shows new rollouts")
        self.adapter = adapter
        self.height = height
        env_id = getattr(adapter.model, "env_id", None) or "?"
        self._start = {
            name: value for name, value in adapter.to_dict().items() if name not in CONVERSATION
        }
        bench = _AdaptersBench(adapter.model, adapter.env, env_id, self._start)
        self._temporary = tempfile.TemporaryDirectory() if store is None else None
        self._store = Store(
            Path(self._temporary.name) if self._temporary is not None else Path(store or ".")
        )
        release_graphics()  # the environment may have rendered in this thread
        # One thread: a graphics context belongs to one at a time.
        self._thread = ThreadPoolExecutor(1)
        workshop = Workshop(1, lambda: self._thread, bench.turn)
        choice = Choice("notebook", Path(), type(adapter.model).__name__, env_id)
        options = {**adapter.options.to_dict(), "notebook": True}
        self._conversations = Conversations(
            self._store,
            workshop,
            [choice],
            options,
            adapter.options.n_queries,
            1,
            load=lambda _: adapter.model,
        )
        self._session, token = self._store.create_session(
            choice.name, env_id, adapter.seed, options, adapter.options.n_queries, source="notebook"
        )
        self._server = BackgroundServer(make_app(self._conversations, Access(embedded=True)), port)
        self.url = f"http://127.0.0.1:{self._server.port}/s/{token}"

    @property
    def session(self) -> Session:
        """The session as the store has it now."""
        return self._store.session(self._session.id)

    def sync(self) -> PreferenceAdapter:
        """Bring the adapter to where the person stands.

        :return: It.
        """
        number = self._session.id
        answered = len(self._store.answers(number))
        turn = None
        for kind in ("question", "result"):
            turn = turn or self._store.turn(number, kind, answered)
        if turn is None:
            raise RuntimeError(
                "the page is still preparing what follows from the last answer; try again in a moment"
            )
        row = self._store.whole_turn(turn["id"])
        assert row is not None
        pending = None
        if row["left_trajectory"] is not None:
            pending = {
                "left": json.loads(row["left_trajectory"]),
                "right": json.loads(row["right_trajectory"]),
            }
        answers = self._store.conversation(number, answered)
        self.adapter.restore({**json.loads(row["state"]), "answers": answers, "pending": pending})
        return self.adapter

    def policy(self) -> Any:
        """The policy for the person's answers so far.

        :return: An :class:`~sb3_poem.adaptation.AdaptedPolicy`.
        """
        return self.sync().policy()

    def close(self) -> None:
        """Stop the server; adapter and environment are the caller's again."""
        self._server.close()
        self._thread.shutdown(cancel_futures=True)
        self._store.close()
        if self._temporary is not None:
            self._temporary.cleanup()

    def _repr_html_(self) -> str:
        return (
            f'<iframe src="{html.escape(self.url)}" width="100%" height="{self.height}" '
            f'style="border:0" title="Which one is better?"></iframe>'
        )


class _AdaptersBench(Bench):
    """Makes turns with a given adapter's model, environment, options and seed."""

    def __init__(self, model: Any, env: Any, env_id: str, start: dict[str, Any]) -> None:
        super().__init__(model, env, env_id)
        self._start = start

    def turn(self, request: Request) -> Turn:
        """See :class:`Bench`. What it rendered with is the caller's again afterwards."""
        try:
            return super().turn(request)
        finally:
            release_graphics()

    def adapter(self, request: Request) -> PreferenceAdapter:
        """See :class:`Bench`."""
        return super().adapter(replace(request, state=request.state or self._start))
