"""The page in a real browser: questions are answered, and teach."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser_world import (
    BROWSER,
    SHOWN,
    ForkedServer,
    Person,
    Server,
    assert_learned,
    begin,
    returns,
)

from sb3_poem.label.families import ModelInfo, find_models

pytestmark = BROWSER


def test_clicks_teach_what_the_oracle_teaches(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo, tmp_path: Path
) -> None:
    person = begin(open_page, server, point_goal, 2.2)
    page = person.page
    page.fill("#wish", "up and to the left")
    before = page.text_content("#belief-sentence")
    person.answer(server.queries)
    assert page.evaluate("() => view.phase") == "result"
    assert page.text_content("#belief-sentence") != before
    assert len(person.stored()) == server.queries
    assert_learned(point_goal, person, 2.2)
    page.click('[data-verdict="yes"]')
    page.wait_for_selector("#thanks:visible")
    for link, suffix in (
        ("#get-video", ".mp4"),
        ("#get-answers", ".json"),
        ("#get-policy", ".safetensors"),
    ):
        with page.expect_download() as download:
            page.click(link)
        path = tmp_path / download.value.suggested_filename
        download.value.save_as(path)
        assert path.suffix == suffix
        assert path.stat().st_size > 500
    assert json.loads((tmp_path / "answers.json").read_text())["wish"] == "up and to the left"


def test_the_keyboard_alone(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo
) -> None:
    page = open_page(server.url)
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    page.wait_for_url("**/s/*")
    page.wait_for_function(SHOWN)
    person = Person(server, page, point_goal, 1.0)
    person.answer(2, keyboard=True)
    page.keyboard.press("Space")
    assert page.get_attribute("#play", "aria-label") == "Pause"
    page.wait_for_function("() => player.frame > 2")
    page.keyboard.press("Space")
    assert page.get_attribute("#play", "aria-label") == "Play"
    moment = page.input_value("#frame")
    page.keyboard.press(".")
    page.wait_for_function(
        "before => document.querySelector('#frame').value !== before", arg=moment
    )
    page.focus("#frame")
    page.keyboard.press("ArrowRight")  # moves the film, and answers nothing
    assert person.answered() == 2
    page.keyboard.press("u")  # which means nothing else there
    page.wait_for_function("() => view.answered === 1 && !busy")
    person.answer(1)
    page.focus("#past summary")
    page.keyboard.press("Space")  # opens the list
    assert page.get_attribute("#past", "open") is not None
    assert page.get_attribute("#play", "aria-label") == "Play"
    page.focus("#wish")
    page.keyboard.type("left u right")
    assert person.answered() == 2
    page.keyboard.press("Tab")
    page.evaluate("() => document.activeElement.blur()")
    page.keyboard.press("ArrowDown")  # scrolls
    page.keyboard.press("u")
    page.wait_for_function("() => view.answered === 1 && !busy")
    page.uncheck("#keys")  # WCAG 2.1.4
    for _ in range(2):
        for key in ("1", "u", "ArrowRight", "Space"):
            page.evaluate("() => document.activeElement.blur()")
            page.keyboard.press(key)
        assert page.evaluate("() => [view.answered, busy, player.wantsToPlay]") == [1, False, False]
        page.reload()
        page.wait_for_function(SHOWN)
    page.check("#keys")
    controls = page.locator(
        "button:visible, a:visible, input:visible, select:visible, textarea:visible, summary:visible"
    )
    page.evaluate("() => document.activeElement.blur()")
    page.evaluate("() => document.addEventListener('focusin', e => e.target.classList.add('met'))")
    for _ in range(controls.count() + 1):  # round once
        page.keyboard.press("Tab")
    met = controls.evaluate_all("all => all.map(one => one.classList.contains('met'))")
    assert len(met) > 15
    assert all(met)


ANSWERS = {
    "graded": [
        ("1 Left much better", "much left", "1"),
        ("2 Left a bit better", "left", "ArrowLeft"),
        ("3 Can\u2019t tell", "equal", "3"),
        ("4 Right a bit better", "right", None),
        ("5 Right much better", "much right", None),
    ],
    "pair": [
        ("\u2190 Left is better", "left", "ArrowLeft"),
        ("2 Can\u2019t tell", "equal", None),
        ("Right is better \u2192", "right", "3"),
    ],
}


@pytest.fixture
def of_pairs(point_goal: ModelInfo, tmp_path: Path) -> Iterator[ForkedServer]:
    server = ForkedServer(tmp_path, point_goal, question="pair")
    yield server
    server.kill()


@pytest.mark.parametrize(("question", "asked_by"), [("graded", "server"), ("pair", "of_pairs")])
def test_all_answers_by_keys_and_by_clicks(
    open_page: Callable[..., Any],
    point_goal: ModelInfo,
    request: pytest.FixtureRequest,
    question: str,
    asked_by: str,
) -> None:
    person = begin(open_page, request.getfixturevalue(asked_by), point_goal, 1.0)
    page, answers = person.page, ANSWERS[question]
    buttons = page.get_by_role("group", name="Your answer").get_by_role("button")

    def texts() -> list[str]:
        return [" ".join(text.split()) for text in buttons.all_inner_texts()]

    expected = [text for text, _, _ in answers]
    # In one picture a robot is called by its colour: it may be at the other's side.
    assert texts() == [text.replace("Left", "Blue").replace("Right", "Orange") for text in expected]
    page.click("#race")
    assert texts() == expected
    for number, (_, _, key) in enumerate(answers):
        page.wait_for_function(SHOWN)
        if key is None:
            buttons.nth(number).click()
        else:
            page.keyboard.press(key)
        page.wait_for_function("n => view.answered === n", arg=number + 1)
    page.wait_for_function(SHOWN)
    record = page.request.get(f"{page.url}/answers.json").json()
    given = [preference for _, preference, _ in answers]
    assert [answer["preference"] for answer in record["answers"]] == person.stored() == given
    assert {answer["question"] for answer in record["answers"]} == {question}
    page.click("#undo")
    page.wait_for_function("n => view.answered === n && !busy", arg=len(given) - 1)
    assert person.stored() == given[:-1]


def test_the_best_of_four_is_found_by_keys_and_by_clicks(
    open_page: Callable[..., Any], of_four: ForkedServer, point_goal: ModelInfo
) -> None:
    person = begin(open_page, of_four, point_goal, 2.2)
    page = person.page
    assert page.text_content("#task") == "Which one is closest to what you want?"
    films = page.get_by_role("img", name=re.compile("^Video"))
    assert [film.get_attribute("aria-label") for film in films.all()] == [
        f"Video {n}" for n in (1, 2, 3, 4)
    ]
    boxes = [film.bounding_box() for film in films.all()]
    assert [(round(box["x"]), round(box["y"])) for box in boxes] == [
        (round(boxes[column]["x"]), round(boxes[2 * row]["y"]))
        for row in (0, 1)
        for column in (0, 1)
    ]
    assert boxes[0]["y"] < boxes[2]["y"]
    assert boxes[0]["x"] < boxes[1]["x"]
    # all begin alike, and part
    page.wait_for_function("() => new Set(screens.map(screen => screen.toDataURL())).size === 4")
    assert page.is_hidden("#race")
    for key in ("ArrowLeft", "5", "0"):  # no answer, can't tell, can't tell
        page.keyboard.press(key)
        page.wait_for_function("n => view.answered === n && !busy", arg=int(key in "50"))
        page.wait_for_function(SHOWN)
        if person.answered():
            page.click("#undo")
            page.wait_for_function("() => view.answered === 0 && !busy")
    person.answer(2, keyboard=True)
    person.answer(3)
    page.wait_for_selector("#result:visible")
    assert [film.is_visible() for film in films.all()] == []  # one film, of what it learned
    assert page.get_by_role("img", name="What it learned").is_visible()
    page.click("#past summary")
    assert re.match(r"[1-4] is best Show again", page.inner_text("#past-list li >> nth=0"))
    page.click("#past-list li >> nth=0 >> button")
    page.wait_for_function("() => player.parts === 4")
    assert page.text_content("#task") == "Question 1, as you saw it."
    assert all(film.is_visible() for film in films.all())
    record = page.request.get(f"{page.url}/answers.json").json()
    assert {answer["question"] for answer in record["answers"]} == {"best-of-four"}
    assert [answer["preference"] for answer in record["answers"]] == person.stored()
    before, after = returns(point_goal, np.stack([np.zeros(5), person.learned()]), 2.2)
    assert after > before


def test_answers_can_be_looked_at_again(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo
) -> None:
    person = begin(open_page, server, point_goal, 2.6)
    page = person.page
    picture = "() => [...document.querySelectorAll('canvas')].map(canvas => canvas.toDataURL())"
    assert page.is_hidden("#past")
    page.evaluate("() => player.seek(20)")
    page.wait_for_function("() => player.drawn === 20")
    page.wait_for_timeout(300)  # a late frame of a slow machine may be drawn over it
    first = page.evaluate(picture)
    person.answer(2)
    said = {"much left": "Blue much better", "left": "Blue a bit better", "equal": "Can"}  # 't tell
    said |= {"right": "Orange a bit better", "much right": "Orange much better"}
    page.click("#past summary")
    items = page.locator("#past li").all_inner_texts()
    assert len(items) == 2
    for item, preference in zip(items, person.stored(), strict=True):
        assert item.startswith(said[preference])
    page.get_by_role("button", name="Show again: pair 1").click()
    page.wait_for_selector(".past #then")
    page.evaluate("() => player.seek(20)")
    page.wait_for_function(
        f"first => JSON.stringify(({picture})()) === first",
        arg=json.dumps(first, separators=(",", ":")),
    )
    assert items[0].split(" Show")[0] in page.inner_text("#then")
    assert page.evaluate("() => document.activeElement.id") == "back"
    # Nothing is answered here, and nothing changes.
    assert page.is_hidden("#answers")
    for key in ("ArrowLeft", "1"):
        page.keyboard.press(key)
    assert page.evaluate("() => [view.answered, busy]") == [2, False]
    page.click("#back")
    page.wait_for_selector("#answers:visible")
    assert page.is_hidden("#then")
    person.answer(1)
    page.get_by_role("button", name="Show again: pair 3").click()
    page.wait_for_selector(".past #then")
    page.keyboard.press("u")  # of the very pair that is shown
    page.wait_for_function("() => view.answered === 2 && !busy")
    assert page.is_visible("#answers")
    assert page.locator("#past li").count() == 2
    person.answer(3)
    assert page.locator("#past li").first.inner_text() == items[0]  # in the result, too
    page.get_by_role("button", name="Show again: pair 2").click()
    page.wait_for_selector(".past #then")
    assert page.is_hidden("#result")
    page.click("#back")
    page.wait_for_selector("#result:visible")
    assert page.is_hidden("#right-figure")


@pytest.mark.slow
def test_a_running_robot_learns_its_speed(open_page: Callable[..., Any], tmp_path: Path) -> None:
    info = find_models("HalfCheetahVel")[0]
    server = Server(tmp_path, "HalfCheetahVel", queries=10)
    try:
        person = begin(open_page, server, info, 1.3)
        person.answer(10)
        assert_learned(info, person, 1.3)
    finally:
        server.stop()
