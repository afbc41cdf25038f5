"""The page in a real browser: reloaded, in two tabs, offline, with a server that fails."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

from browser_world import (
    BROWSER,
    SHOWN,
    ForkedServer,
    Person,
    Server,
    begin,
)

from sb3_poem.label.families import ModelInfo

pytestmark = BROWSER


def test_undo_and_reload_in_the_middle(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo
) -> None:
    person = begin(open_page, server, point_goal, 0.4)
    page = person.page
    person.answer(2)
    sentences = page.text_content("#belief-sentence")
    video = page.evaluate("() => view.turn.id")
    page.reload()
    page.wait_for_function(SHOWN)
    assert (person.answered(), page.text_content("#belief-sentence")) == (2, sentences)
    assert page.evaluate("() => view.turn.id") == video
    for left in (1, 0):
        page.click("#undo")
        page.wait_for_function(f"() => view.answered === {left} && !busy")
    assert page.is_hidden("#undo")
    assert person.stored() == []
    person.answer(2)
    assert page.text_content("#belief-sentence") == sentences
    page.click("#stop")
    page.wait_for_selector("text=Filming what it learned")
    assert page.text_content("#undo-text") == "Back to the questions"
    page.wait_for_selector("#result:visible")

    def unanswered(route: Any) -> None:
        route.fetch()
        route.abort()

    page.route("**/stop", unanswered, times=1)
    page.click("#undo")  # back to the questions; it is sent again
    page.wait_for_selector("#answers:visible")
    assert person.answered() == 2


def test_two_people_and_a_second_tab(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo
) -> None:
    ann, ben = begin(open_page, server, point_goal, 0.3), begin(open_page, server, point_goal, 2.8)
    assert ann.token != ben.token
    tab = open_page(ann.page.url)
    tab.wait_for_function(SHOWN)
    for _ in range(2):
        ann.answer()
        ben.answer()
    # The second tab of the same session still shows the first question: its answer is refused, and
    # it catches up.
    tab.keyboard.press("2")
    tab.wait_for_function("() => view.answered === 2 && view.phase === 'question' && !busy")
    assert ann.stored() != ben.stored()
    assert len(ann.stored()) == len(ben.stored()) == 2


def test_what_is_said_offline_is_sent_later(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo
) -> None:
    person = begin(open_page, server, point_goal, 1.0)
    page = person.page
    page.context.set_offline(True)
    page.keyboard.press("1")
    page.fill("#wish", "far to the left")
    page.wait_for_selector("#error:visible")
    assert "kept in this browser" in page.text_content("#error")
    assert person.stored() == []
    page.context.set_offline(False)
    page.wait_for_function("() => view.answered === 1 && view.phase === 'question' && !busy")
    assert page.is_hidden("#error")
    page.wait_for_function("() => Object.keys(unsent).length === 0")
    # Whoever closes the page while they are offline finds it sent when they come back.
    page.context.set_offline(True)
    page.click("[data-preference='much right']")
    page.fill("#wish", "farther")
    page.wait_for_selector("#error:visible")
    address = page.url
    context = page.context
    page.close()  # which may send it at once, or leave it to the next visit
    context.set_offline(False)
    page = context.new_page()
    page.goto(address)
    page.wait_for_function("() => view !== null && view.answered === 2 && !busy")
    assert person.stored() == ["much left", "much right"]
    # Who types and closes the page at once loses no word.
    page.wait_for_function(SHOWN)
    page.fill("#wish", "at once")
    page.click("#robots")
    page.wait_for_url(f"{server.url}/")
    page.goto(address)
    assert page.input_value("#wish") == "at once"


def test_a_server_that_is_silent_is_asked_again(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo
) -> None:
    page = open_page(server.url)
    soon = "const timeout = AbortSignal.timeout; AbortSignal.timeout = (ms) => timeout(ms / 10);"
    page.add_init_script(f"{{ {soon} }}")
    page.click(f"button[value={point_goal.name}]")
    page.wait_for_function(SHOWN)
    os.kill(server.process.pid, signal.SIGSTOP)  # takes requests, and answers none
    try:
        page.keyboard.press("1")
        page.wait_for_selector("#error:visible")
        assert "kept in this browser" in page.text_content("#error")
    finally:
        os.kill(server.process.pid, signal.SIGCONT)
    page.wait_for_function("() => view.answered === 1 && view.phase === 'question' && !busy")
    assert page.is_hidden("#error")


def test_tabs_of_one_conversation_keep_what_each_could_not_send(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo
) -> None:
    person = begin(open_page, server, point_goal, 1.0)
    page, tab = person.page, person.page.context.new_page()
    tab.goto(page.url)
    tab.wait_for_function(SHOWN)
    page.context.set_offline(True)
    page.click("[data-preference=left]")
    tab.fill("#wish", "up")
    tab.wait_for_selector("#error:visible")
    assert set(tab.evaluate("() => readKept()")) == {"/answer", "/wish"}
    page.context.set_offline(False)
    page.wait_for_function("() => view.answered === 1 && !busy")
    tab.wait_for_function("() => Object.keys(unsent).length === 0")
    tab.wait_for_function("() => Object.keys(readKept()).length === 0")


def test_an_answer_waits_while_the_disk_is_full(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo
) -> None:
    person = begin(open_page, server, point_goal, 1.0)
    page = person.page

    def full(route: Any) -> None:
        route.fulfill(status=507, json={"error": "The disk of this server is full."})

    page.route("**/answer", full)
    page.click("[data-preference=left]")
    page.wait_for_selector("text=The disk of this server is full.")
    page.wait_for_timeout(500)
    assert page.is_visible("#error")  # as long as it is so
    page.unroute("**/answer")
    page.wait_for_function("() => view.answered === 1 && !busy")
    assert page.is_hidden("#error")
    assert person.stored() == ["left"]
    # Nor is it lost on a server that was started anew, and lets in who has another link.
    page.route("**/answer", lambda route: route.fulfill(status=401), times=1)
    page.click("[data-preference=right]")
    page.wait_for_function("() => Object.keys(readKept()).length === 1 && !busy")
    page.reload()
    page.wait_for_function("() => view !== null && view.answered === 2 && !busy")
    assert person.stored() == ["left", "right"]
    # Nor by a proxy before it that shows a page of its own, where one logs in.
    page.wait_for_function(SHOWN)
    login = {"content_type": "text/html", "body": "<p>Log in</p>"}
    page.route("**/answer", lambda route: route.fulfill(**login), times=1)
    page.click("[data-preference=equal]")
    page.wait_for_function("() => view.answered === 3 && !busy", timeout=15_000)


def test_films_that_cannot_be_shown_are_not_the_servers_fault(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo
) -> None:
    person = begin(open_page, server, point_goal, 1.0)
    page = person.page
    page.route("**/video/*", lambda route: route.fulfill(body="no film"))
    page.reload()
    page.wait_for_selector("text=This browser cannot play H.264 video.")
    page.unroute("**/video/*")
    page.wait_for_function(SHOWN)
    person.answer(1)
    page.click("#past summary")
    page.get_by_role("button", name="Show again: pair 1").click()
    page.wait_for_selector(".past #then")
    page.context.set_offline(True)
    page.click("#back")
    page.wait_for_selector("text=The server does not answer.")
    page.context.set_offline(False)
    page.wait_for_function(SHOWN)
    person.answer(1)


def test_a_browser_that_keeps_nothing(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo
) -> None:
    """As in a notebook's frame, where cookies of other sites are blocked."""
    page = open_page("about:blank")
    page.add_init_script(
        "Object.defineProperty(window, 'localStorage', { get() { throw new Error('blocked'); } })"
    )
    page.goto(server.url)
    page.click(f"button[value={point_goal.name}]")
    page.wait_for_function(SHOWN)
    Person(server, page, point_goal, 1.0).answer(1)


def test_the_server_is_killed_in_the_middle(
    open_page: Callable[..., Any], point_goal: ModelInfo, tmp_path: Path
) -> None:
    server = ForkedServer(tmp_path, point_goal)
    person = begin(open_page, server, point_goal, 2.5)
    page = person.page
    person.answer(1)
    page.keyboard.press("ArrowLeft")
    page.wait_for_function("() => view.answered === 2")  # kept; what follows perhaps not yet made
    server.kill()
    assert len(person.stored()) == 2
    server.start()
    page.reload()
    page.wait_for_function(SHOWN)
    assert person.answered() == 2
    page.click("#undo")
    page.wait_for_function("() => view.answered === 1 && !busy")
    person.answer(2)
    assert len(person.stored()) == 3
    server.kill()
