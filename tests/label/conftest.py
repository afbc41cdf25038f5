"""A small world for the page: the shipped PointGoal, turns made in a thread, no browser."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, TypeVar

import pytest
from label_world import make_conversations

from sb3_poem.label.catalogue import Choice, read_catalogue
from sb3_poem.label.sessions import Conversations
from sb3_poem.label.store import Store

T = TypeVar("T")


@pytest.fixture(scope="session")
def point_goal() -> Choice:
    return next(choice for choice in read_catalogue() if choice.name == "PointGoal")


@pytest.fixture
def store(tmp_path: Path):
    opened = Store(tmp_path / "store")
    yield opened
    opened.close()


@pytest.fixture
def with_conversations(store: Store, point_goal: Choice) -> Callable[..., Any]:
    """Runs ``talk(conversations)`` as one life of a server; what the store holds stays for the
    next.
    """

    def run(talk: Callable[[Conversations], Coroutine[Any, Any, T]], **options: Any) -> T:
        async def life() -> T:
            conversations = make_conversations(store, point_goal, **options)
            try:
                return await talk(conversations)
            finally:
                await conversations.workshop.close()

        return asyncio.run(life())

    return run
