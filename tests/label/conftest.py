"""A small world for the page: the shipped PointGoal, turns made in a thread, no browser."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, TypeVar

import pytest
from label_world import make_sessions

from sb3_poem.label.families import ModelInfo, find_models
from sb3_poem.label.sessions import SessionManager
from sb3_poem.label.store import Store

T = TypeVar("T")


@pytest.fixture(scope="session")
def point_goal() -> ModelInfo:
    return find_models("PointGoal")[0]


@pytest.fixture
def store(tmp_path: Path):
    opened = Store(tmp_path / "store")
    yield opened
    opened.close()


@pytest.fixture
def run_server(store: Store, point_goal: ModelInfo) -> Callable[..., Any]:
    """Runs ``life(sessions)`` as one life of a server; what the store holds stays for the next."""

    def run(
        life: Callable[[SessionManager], Coroutine[Any, Any, T]],
        info: ModelInfo = point_goal,
        **options: Any,
    ) -> T:
        async def whole_life() -> T:
            sessions = make_sessions(store, info, **options)
            try:
                return await life(sessions)
            finally:
                await sessions.queue.close()

        return asyncio.run(whole_life())

    return run
