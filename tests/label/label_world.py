"""Helpers of the page's tests."""

from __future__ import annotations

import asyncio
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from sb3_poem.label.catalogue import Choice
from sb3_poem.label.sessions import Conversations
from sb3_poem.label.store import Session, Store
from sb3_poem.label.workshop import Workshop


def make_conversations(
    store: Store, choice: Choice, ahead: bool = False, **options: Any
) -> Conversations:
    """A server's conversations; rendering ahead, which triples the work, is for the tests that ask
    for it.
    """
    conversations = Conversations(
        store, Workshop(1, lambda: ThreadPoolExecutor(1)), [choice], seed=5, **options
    )
    if not ahead:
        conversations._render_ahead = lambda *_: None  # type: ignore[method-assign]
    return conversations


async def settled(
    conversations: Conversations, session: Session, seconds: float = 60.0
) -> dict[str, Any]:
    """The session's view once nothing is being prepared."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        view = await conversations.view(session)
        assert "failed" not in view, view
        if view["phase"] != "preparing":
            return view
        await asyncio.sleep(0.02)
    raise AssertionError(f"nothing was shown within {seconds} s")
