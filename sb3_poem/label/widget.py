"""The page within a Jupyter notebook."""

import html
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from poem_envs.headless import release_graphics
from sb3_poem.adaptation.adapter import PreferenceAdapter
from sb3_poem.adaptation.policy import AdaptedPolicy
from sb3_poem.label.access import Access
from sb3_poem.label.families import ModelInfo
from sb3_poem.label.render_queue import RenderQueue
from sb3_poem.label.rendering import CONVERSATION, Renderer, Turn, TurnRequest
from sb3_poem.label.server import BackgroundServer, make_app
from sb3_poem.label.sessions import SessionManager
from sb3_poem.label.store import Session, Store


class LabelWidget:
    """The page on which a person answers, for an adapter in a notebook: the last expression of a
    cell shows it.

    >>> import gymnasium as gym
    >>> from sb3_poem import Bayes, PreferenceAdapter
    >>> env = gym.make("poem/PointGoal-v0", render_mode="rgb_array")
    >>> rule = Bayes(question="graded", noise_model="infer")  # five answers, whoever gives them
    >>> widget = LabelWidget(PreferenceAdapter("PointGoal", env, rule=rule))
    >>> html = widget._repr_html_()  # the page, which a cell shows below it
    >>> widget.close()

    Before that, in a later cell, ``widget.policy()`` is the policy for the answers so far.

    The server runs in this process, on loopback: the browser must run on the same machine, or its
    port be forwarded.

    :param adapter: A fresh one; its environment must have been made with
        ``render_mode="rgb_array"``. Do not use the adapter or its environment elsewhere meanwhile;
        :meth:`sync` brings it to where the person stands.
    :param store: The folder of the store; None takes a temporary one, which ends with the widget.
    :param height: Of the page in the notebook, pixels.
    :param port: The server's port; 0 takes a free one.
    """

    def __init__(
        self,
        adapter: PreferenceAdapter,
        store: str | Path | None = None,
        height: int = 900,
        port: int = 0,
    ) -> None:
        if not isinstance(adapter, PreferenceAdapter):
            kind = type(adapter).__name__
            raise TypeError(f"`adapter` must be a PreferenceAdapter, but is a {kind}")
        if adapter.answers or adapter.pending is not None:
            raise ValueError("`adapter` has been asked already; give the widget a fresh one")
        if adapter.library is not None:
            raise ValueError("`adapter` asks from a library; the page shows new rollouts")
        if not all(hasattr(adapter.model, name) for name in ("reward_feature_dim", "train_tasks")):
            kind, takes = type(adapter.model).__name__, "as a POEMSAC or PEARLSAC has them"
            needs = f"the page needs `reward_feature_dim` and `train_tasks`, {takes}"
            raise ValueError(f"`adapter` has a model of type {kind}, but {needs}")
        self.adapter, self.height = adapter, height
        env_id = getattr(adapter.model, "env_id", None) or "?"
        data = adapter.to_dict()
        start = {name: value for name, value in data.items() if name not in CONVERSATION}
        renderer = Renderer(adapter.model, adapter.env, env_id)

        def make(request: TurnRequest) -> Turn:
            """What it rendered with is the caller's again afterwards."""
            try:
                return renderer.turn(replace(request, state=request.state or start))
            finally:
                release_graphics()

        self._temporary = tempfile.TemporaryDirectory()  # not used where a folder is given
        self._store = Store(self._temporary.name if store is None else store)
        release_graphics()  # the environment may have rendered in this thread
        # One thread: a graphics context belongs to one at a time.
        self._thread = ThreadPoolExecutor(1)
        queue = RenderQueue(1, lambda: self._thread, make)
        info = ModelInfo("notebook", Path(), env_id)
        options = {**adapter.rule.to_dict(), "question": adapter.rule.question}
        how = (options, adapter.n_queries)
        sessions = SessionManager(self._store, queue, [info], *how, 1, load=lambda _: adapter.model)
        about = (info.name, env_id, adapter.seed, *how)
        self._session, token = self._store.create_session(*about, source="notebook")
        self._server = BackgroundServer(make_app(sessions, Access(embedded=True)), port)
        self.url = f"http://127.0.0.1:{self._server.port}/s/{token}"

    @property
    def session(self) -> Session:
        """The session as the store has it now."""
        return self._store.session(self._session.id)

    def sync(self) -> PreferenceAdapter:
        """The adapter, brought to where the person stands."""
        session, store = self._session.id, self._store
        answered = len(store.answers(session))
        turn = store.turn(session, "question", answered) or store.turn(session, "result", answered)
        if turn is None:
            preparing = "the page is still preparing what follows from the last answer"
            raise RuntimeError(f"{preparing}; try again in a moment")
        data = store.adapter_data(turn["id"])
        self.adapter.restore({**data.pop("state"), **data})
        return self.adapter

    def policy(self) -> AdaptedPolicy:
        """The policy for the person's answers so far."""
        return self.sync().policy()

    def close(self) -> None:
        """Stop the server; adapter and environment are the caller's again."""
        self._server.close()
        self._thread.shutdown(cancel_futures=True)
        self._store.close()
        self._temporary.cleanup()

    def _repr_html_(self) -> str:
        return (
            f'<iframe src="{html.escape(self.url)}" width="100%" height="{self.height}" '
            f'allow="fullscreen" style="border:0" title="Which one is better?"></iframe>'
        )
