"""Helpers of the page's tests."""

from __future__ import annotations

import asyncio
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from sb3_poem.label.families import ModelInfo
from sb3_poem.label.render_queue import Job, Priority, RenderQueue
from sb3_poem.label.rendering import TurnRequest
from sb3_poem.label.sessions import SessionManager
from sb3_poem.label.store import Session, Store


class OnlyWaitedFor(RenderQueue):
    """Makes nothing ahead of time, as one that has no time for it."""

    def submit(self, request: TurnRequest, priority: Priority) -> Job:
        if priority is Priority.WAITED_FOR:
            return super().submit(request, priority)
        job = Job(request, priority)
        job.done.cancel()
        return job


def make_sessions(
    store: Store, info: ModelInfo, render_ahead: bool = False, **options: Any
) -> SessionManager:
    """A server's sessions; rendering ahead, which triples the work, is for the tests that ask for
    it.
    """
    queue = (RenderQueue if render_ahead else OnlyWaitedFor)(1, lambda: ThreadPoolExecutor(1))
    return SessionManager(store, queue, [info], seed=5, **options)


async def settled(
    sessions: SessionManager, session: Session, seconds: float = 60.0
) -> dict[str, Any]:
    """The session's view once nothing is being prepared."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        view = await sessions.view(session)
        assert "failed" not in view, view
        if view["phase"] != "preparing":
            return view
        await asyncio.sleep(0.02)
    raise AssertionError(f"nothing was shown within {seconds} s")
