"""A small world for the page: the shipped PointGoal, turns made in a thread; and a browser."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any, TypeVar

import pytest
from browser_world import CHROMIUM, DESKTOP, ForkedServer, Server
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


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield launched
        launched.close()


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    running = Server(tmp_path_factory.mktemp("label"), "PointGoal")
    yield running
    running.stop()


@pytest.fixture
def open_page(browser: Any) -> Iterator[Callable[..., Any]]:
    """A page of its own, which fails the test if a script of it failed or it asked another host for
    anything.
    """
    contexts, problems = [], []

    def opened(url: str, viewport: dict[str, int] = DESKTOP, **options: Any) -> Any:
        # Films that play all the time would take this machine's processors from the server.
        options = {"reduced_motion": "reduce", **options}
        context = browser.new_context(viewport=viewport, **options)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(90_000)
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("request", lambda request: foreign(request.url))
        page.goto(url)
        return page

    def foreign(url: str) -> None:
        if not url.startswith(("http://127.0.0.1:", "blob:", "data:")):
            problems.append(f"asked for {url}")

    yield opened
    for context in contexts:
        context.close()
    assert problems == []


@pytest.fixture
def of_four(point_goal: ModelInfo, tmp_path: Path) -> Iterator[ForkedServer]:
    server = ForkedServer(tmp_path, point_goal, question="best-of-four")
    yield server
    server.kill()
