"""The page in a real browser: what is where, on screens of all sizes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser_world import (
    BROWSER,
    DESKTOP,
    KEYS,
    LANDSCAPE,
    PHONE,
    SHOWN,
    ForkedServer,
    Person,
    Server,
    begin,
)
from PIL import Image

from poem_envs.films import PATH_COLOURS
from sb3_poem.label.families import ModelInfo, find_models
from sb3_poem.label.server import ROBOTS

pytestmark = BROWSER


def test_four_on_a_phone(
    open_page: Callable[..., Any], of_four: ForkedServer, point_goal: ModelInfo
) -> None:
    person = begin(open_page, of_four, point_goal, 2.0, viewport=PHONE, has_touch=True)
    page = person.page
    person.answer(1)
    full = "() => document.fullscreenElement !== null"
    for viewport in (PHONE, LANDSCAPE):
        page.set_viewport_size(viewport)
        page.evaluate("() => scrollTo(0, 0)")
        assert page.evaluate("() => document.documentElement.scrollWidth") <= viewport["width"]
        needed = [page.locator(f'[data-preference="{word}"]') for word in KEYS["best-of-four"]]
        for element in (*page.locator("canvas").all(), page.locator("#play"), *needed):
            box = element.bounding_box()
            assert 0 <= box["x"] <= viewport["width"] - box["width"]
            assert box["y"] + box["height"] <= viewport["height"]  # all that is needed is in sight
            assert min(box["width"], box["height"]) >= 44
        assert page.locator("canvas >> nth=0").bounding_box()["width"] >= 160
        page.click("#full")
        page.wait_for_function(full)
        boxes = [canvas.bounding_box() for canvas in page.locator("canvas").all()]
        assert boxes[0]["y"] == boxes[1]["y"] < boxes[2]["y"] == boxes[3]["y"]
        assert boxes[3]["y"] + boxes[3]["height"] <= viewport["height"]
        page.click("#full")
        page.wait_for_function(f"!({full})()")


TOPS = """() => {
  window.tops = new Set();
  window.waited = false;
  const measure = () => {
    waited ||= Boolean(document.getElementById("progress")?.offsetParent);
    const answers = document.getElementById("answers");
    const shown = answers && answers.offsetParent;
    if (shown) tops.add(Math.round(answers.getBoundingClientRect().top + scrollY));
    requestAnimationFrame(measure);
  };
  measure();
}"""


@pytest.mark.parametrize("viewport", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_a_doubtful_pair_is_shown_again_and_the_answers_stay_where_they_are(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo, viewport: dict[str, int]
) -> None:
    page = open_page(server.url, viewport=viewport)
    page.add_init_script(f"({TOPS})()")  # in every frame, from the first on
    page.click(f"button[value={point_goal.name}]")
    page.wait_for_function(SHOWN)
    assert page.evaluate("() => waited")
    wish, films = (page.locator(part).bounding_box() for part in ("#wish", "#screens"))
    assert wish["y"] + wish["height"] <= films["y"]  # one wishes before one looks
    person = Person(server, page, point_goal, 2.5)
    page.evaluate("() => showError('The server does not answer. '.repeat(9))")
    assert page.is_hidden("#doubt")
    person.say("much right" if "left" in person.judge() else "much left")
    while not page.is_visible("#doubt"):
        person.answer()
    assert "Look at pair 1 again?" in " ".join(page.inner_text("#doubt").split())
    answered = person.answered()
    assert answered < server.queries
    page.click("#again")
    page.wait_for_function("() => view.turn.repeats === 0 && !busy")
    assert page.text_content("#task").startswith("Pair 1 once more: which")
    assert page.is_hidden("#doubt")
    assert person.answered() == answered
    person.answer()
    record = page.request.get(f"{page.url}/answers.json").json()
    assert [answer["repeats"] for answer in record["answers"]] == [None] * answered + [0]
    person.answer(server.queries - person.answered())
    page.wait_for_selector("#result:visible")
    assert len(page.evaluate("() => [...tops]")) == 1


def coloured(page: Any, side: str) -> dict[str, int]:
    """How many pixels of a screen have the left path's colour, and the right one's."""
    return page.evaluate(
        """side => {
            const canvas = document.getElementById(side + '-screen');
            const context = canvas.getContext('2d');
            const data = context.getImageData(0, 0, canvas.width, canvas.height).data;
            const count = { blue: 0, orange: 0 };
            for (let i = 0; i < data.length; i += 4) {
                count.blue += data[i + 2] - data[i] > 90;
                count.orange += data[i] - data[i + 2] > 110;
            }
            return count;
        }""",
        side,
    )


BACKGROUND = "element => getComputedStyle(element).backgroundColor"


def test_both_robots_beside_each_other_and_in_one_picture(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo
) -> None:
    person = begin(open_page, server, point_goal, 1.0)
    page = person.page

    def seen() -> list[bool]:
        return [page.is_visible(f"#{side}-screen") for side in ("left", "right", "race")]

    assert seen() == [False, False, True]  # which tells more where robots go to places
    assert page.get_attribute("#race", "aria-pressed") == "true"
    for frame in (0, 7, 3, 24):
        page.evaluate("frame => player.seek(frame)", frame)
        page.wait_for_function(
            "frame => player.drawn === frame && document.querySelector('#frame').value == frame",
            arg=frame,
        )
    left, right, both = (coloured(page, side) for side in ("left", "right", "race"))
    # The dot of either side is on its own screen, and both are in the race.
    assert min(left["blue"], right["orange"]) > 20
    assert left["orange"] == right["blue"] == 0
    assert min(both.values()) > 20
    assert sum(both.values()) > 0.9 * max(left["blue"], right["orange"])  # one may hide the other
    assert page.inner_text("#race-figure figcaption") == "Blue Orange"
    # All that names a side has the colour of its robot.
    for side, colour in zip(("left", "right"), PATH_COLOURS, strict=False):
        shade = f"rgb({', '.join(str(round(255 * part)) for part in colour)})"
        captions = page.locator(f".side.{side}").all()
        much, bit = (page.locator(f'[data-preference="{w}{side}"]') for w in ("much ", ""))
        assert {seen.evaluate(BACKGROUND) for seen in (*captions, much)} == {shade}
        assert bit.evaluate("button => getComputedStyle(button).borderColor") == shade
    page.evaluate("() => { waitingSince = -1e5; showProgress(true, 1, false); }")
    film, words = (page.locator(box).bounding_box() for box in ("#race-screen", "#progress-text"))
    assert film["x"] < words["x"] < words["x"] + words["width"] < film["x"] + film["width"]
    page.evaluate("() => showProgress(false, 1, false)")
    page.keyboard.press("r")
    assert page.inner_text("#left-figure figcaption") == "Left"
    assert page.inner_text("#right-figure figcaption") == "Right"
    assert seen() == [True, True, False]
    person.answer(1)  # and it stays so, in the next question and when they come back
    assert seen() == [True, True, False]
    page.reload()
    page.wait_for_function(SHOWN)
    assert seen() == [True, True, False]
    page.click("#race")
    assert seen() == [False, False, True]
    page.click("#stop")
    page.wait_for_selector("#result:visible")
    assert seen() == [True, False, False]  # a result is one robot
    assert page.is_hidden("#race")


@pytest.fixture
def of_a_hand(tmp_path: Path) -> Iterator[ForkedServer]:
    server = ForkedServer(tmp_path, find_models("FetchReach")[0])
    yield server
    server.kill()


def test_where_one_picture_tells_less_two_films_are_shown_at_first(
    open_page: Callable[..., Any], of_a_hand: ForkedServer
) -> None:
    page = open_page(of_a_hand.url)
    page.click("button[value=FetchReach]")
    page.wait_for_function(SHOWN)

    def seen() -> list[bool]:
        return [page.is_visible(f"#{side}-screen") for side in ("left", "right", "race")]

    assert seen() == [True, True, False]  # a hand moves in space
    assert page.get_attribute("#race", "aria-pressed") == "false"
    assert page.get_by_role("button", name="Left is better").is_visible()  # no colours
    page.evaluate("() => player.seek(player.frames - 1)")
    page.wait_for_function("() => player.drawn === player.frames - 1")
    left, right = (coloured(page, side) for side in ("left", "right"))
    assert min(left["blue"], right["orange"]) > 20
    page.keyboard.press("r")  # who wants it sees both in one
    assert seen() == [False, False, True]


def test_the_films_fill_the_screen(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo
) -> None:
    person = begin(open_page, server, point_goal, 2.0)
    page, full = person.page, "() => document.fullscreenElement !== null"
    both = ["#left-screen", "#right-screen"]
    for viewport, screens in product((DESKTOP, PHONE, LANDSCAPE), (["#race-screen"], both)):
        page.set_viewport_size(viewport)
        width, height = viewport["width"], viewport["height"]
        before = page.locator(screens[0]).bounding_box()["height"]
        page.keyboard.press("f")
        page.wait_for_function(full)
        page.wait_for_selector("#full[aria-pressed=true]")
        seen = page.evaluate("() => [stage.scrollWidth, stage.scrollHeight]")
        assert seen == [width, height]  # without scrolling
        boxes = [page.locator(screen).bounding_box() for screen in screens]
        areas = [min(box["width"] / 4, box["height"] / 3) for box in boxes]
        assert min(areas) * 3 > (before if viewport is not PHONE else 0.9 * before)
        assert page.is_hidden("#wish")
        for name in ("left", "equal", "right"):
            button = page.locator(f"[data-preference={name}]").bounding_box()
            assert button["y"] + button["height"] <= height
            assert button["height"] >= 44
        page.keyboard.press("r")
        page.keyboard.press("Escape")
        page.wait_for_function(f"!({full})()")
    page.click("#full")
    page.wait_for_function(full)
    person.answer(1)
    person.answer(1, keyboard=True)
    assert page.evaluate(full)  # from question to question
    page.click("#full")
    page.wait_for_function(f"!({full})()")
    page.wait_for_selector("#full[aria-pressed=false]")


def test_the_choice_of_robots(open_page: Callable[..., Any], server: Server) -> None:
    page = open_page(server.url)
    assert page.text_content("h2") == "Where should it go?"
    picture = page.locator("button[value=PointGoal] img")
    picture.evaluate("image => image.decode()")  # waits until it has come
    assert picture.evaluate("image => image.naturalWidth") == 320
    assert picture.evaluate("image => image.currentSrc").endswith("/PointGoal.webp")
    page = open_page(server.url, reduced_motion="no-preference")
    loop = page.locator("button[value=PointGoal] img")
    assert loop.evaluate("image => image.currentSrc").endswith("/PointGoal-loop.webp")


def test_loops_of_the_choice_end_within_five_seconds() -> None:
    loops = sorted(ROBOTS.glob("*-loop.webp"))
    assert [loop.stem.removesuffix("-loop") for loop in loops] == sorted(
        info.family for info in find_models()
    )
    for loop in loops:
        with Image.open(loop) as film:
            assert film.n_frames > 1
            seconds = 0.0
            for number in range(film.n_frames):
                film.seek(number)
                film.load()
                seconds += film.info["duration"] / 1000
            assert 0 < seconds * film.info["loop"] <= 5, loop.name


def test_a_phone(open_page: Callable[..., Any], server: Server, point_goal: ModelInfo) -> None:
    person = begin(
        open_page, server, point_goal, 2.0, viewport=PHONE, has_touch=True, is_mobile=True
    )
    page = person.page
    person.answer(1)
    assert page.evaluate("() => document.documentElement.scrollWidth") <= PHONE["width"]
    for selector in (
        *(f'[data-preference="{word}"]' for word in KEYS["graded"]),
        "#play",
        "#race",
        ".speed",
        "#full",
    ):
        box = page.locator(selector).bounding_box()
        stage = page.locator(".stage").bounding_box()
        assert box["x"] + box["width"] <= stage["x"] + stage["width"]
        assert box["height"] >= 44 or selector == ".speed"
        assert box["width"] >= 60 or not selector.startswith("[")
        assert box["y"] + box["height"] <= PHONE["height"]  # all that is needed is in sight
    assert page.locator("#frame").bounding_box()["width"] >= 200
    assert page.is_visible("#moment")
    undo, stop = (page.locator(selector).bounding_box() for selector in ("#undo", "#stop"))
    assert undo["y"] == stop["y"]
    assert undo["x"] + undo["width"] <= stop["x"]
    assert max(undo["height"], stop["height"]) < 48  # a line
    assert page.is_hidden("#keys")
    page.keyboard.press(".")  # there is a keyboard after all: WCAG 2.1.4
    assert page.is_visible("#keys")


def test_a_phone_on_its_side(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo
) -> None:
    person = begin(open_page, server, point_goal, 2.0, viewport=LANDSCAPE, has_touch=True)
    needed = ["#play", *(f'[data-preference="{word}"]' for word in KEYS["graded"])]
    for screen in ("#race-screen", "#left-screen"):
        for selector in (screen, *needed):
            box = person.page.locator(selector).bounding_box()
            assert box["y"] >= 0
            assert box["y"] + box["height"] <= LANDSCAPE["height"], selector
        assert person.page.locator(screen).bounding_box()["height"] >= 120
        person.page.click("#race")
    person.answer(1)
    person.page.click("#past summary")
    person.page.get_by_role("button", name="Show again: pair 1").click()
    person.page.wait_for_selector(".past #then")
    for selector in ("#race-screen", "#back"):  # where the list is, far below, is no film
        box = person.page.locator(selector).bounding_box()
        assert 0 <= box["y"] <= LANDSCAPE["height"] - box["height"], selector
    person.page.click("#back")
    person.page.click("#stop")
    person.page.wait_for_selector("#result:visible")
    film = person.page.locator("#left-screen").bounding_box()
    verdict = person.page.locator("[data-verdict=yes]").bounding_box()
    assert verdict["y"] + verdict["height"] - film["y"] <= LANDSCAPE["height"]


def test_the_page_is_readable_for_all(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo
) -> None:
    page = open_page(f"{server.url}/s/none")
    assert page.text_content("h1") == "There is nothing here"
    page.click("text=Choose a robot")
    page.click(f"button[value={point_goal.name}]")
    page.wait_for_url("**/s/*")
    assert page.get_by_role("img", name=re.compile("It knows nothing yet")).count() == 1
    page.wait_for_function(SHOWN)  # what waits is pale
    ratios = page.evaluate(
        """() => [...document.querySelectorAll('kbd, .note, .hint, .side, .answer')].map(element => {
            const light = colour => colour.match(/[\\d.]+/g).slice(0, 3).map(Number)
                .map(c => (c /= 255) <= .04045 ? c / 12.92 : ((c + .055) / 1.055) ** 2.4)
                .reduce((sum, c, i) => sum + c * [.2126, .7152, .0722][i], 0);
            const style = getComputedStyle(element);
            let behind = element, opacity = 1;
            for (let e = element; e; e = e.parentElement) opacity *= getComputedStyle(e).opacity;
            while (getComputedStyle(behind).backgroundColor === 'rgba(0, 0, 0, 0)')
                behind = behind.parentElement;
            const back = light(getComputedStyle(behind).backgroundColor);
            const front = back + opacity * (light(style.color) - back);
            return (Math.max(back, front) + .05) / (Math.min(back, front) + .05);
        })"""
    )
    assert min(ratios) >= 4.5
    # The map's words are above its dots, those of directions around it.
    drawn = page.evaluate(
        """() => {
            drawBelief(byId('belief'), { picture: 'place', points: [[0, 0]], weights: [1], unit: 'm',
                estimate: [1, 1], extent: 3.5, words: ['right', 'ahead', 'left', 'back'] });
            const map = document.querySelector('#belief .map').getBoundingClientRect();
            const all = byId('belief').getBoundingClientRect();
            return [...byId('belief').querySelectorAll('.cloud, text')].map(element => {
                const box = element.getBoundingClientRect();
                const beside = box.right < map.left || box.left > map.right
                    || box.bottom < map.top || box.top > map.bottom;
                const within = box.left >= all.left && box.right <= all.right
                    && box.top >= all.top && box.bottom <= all.bottom;
                return [element.textContent || 'dot', beside, within];
            });
        }"""
    )
    inside, around = ["dot", "start", "1 m", "2 m", "3 m"], ["right", "ahead", "left", "back"]
    assert drawn == [[name, name in around, True] for name in inside + around]


PIXELS = """name => {
  const canvas = document.getElementById(name);
  const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  return Array.from(data.filter((_, i) => i % 16 < 3));
}"""


@pytest.mark.slow
@pytest.mark.parametrize("name", [info.name for info in find_models()])
def test_the_films_of_each_family(
    open_page: Callable[..., Any], tmp_path: Path, name: str, request: pytest.FixtureRequest
) -> None:
    """Both films move, and end apart; screens and answers fit a desktop and a phone."""
    server = Server(tmp_path, name)
    request.addfinalizer(server.stop)
    page = open_page(server.url)
    page.click(f"button[value={name}]")
    for viewport in (DESKTOP, PHONE):
        page.set_viewport_size(viewport)
        if viewport == PHONE:
            page.reload()
        page.wait_for_function(SHOWN)
        moments = []
        for frame in ("min", "max"):
            page.evaluate(
                f"""() => {{ const slider = document.getElementById("frame");
                slider.value = slider.{frame}; slider.dispatchEvent(new Event("input")); }}"""
            )
            page.wait_for_function("() => player.drawn === Number(player.controls.frame.value)")
            screens = (page.evaluate(PIXELS, f"{side}-screen") for side in ("left", "right"))
            moments.append(np.array(list(screens), dtype=float))
        (first, _), (left, right) = moments
        assert np.std(left) > 5
        assert np.abs(left - first).mean() > 0.5 or np.abs(right - moments[0][1]).mean() > 0.5
        assert np.abs(left - right).max() > 50
        page.screenshot(path=tmp_path / f"{name}-{viewport['width']}.png")
        assert page.evaluate("() => document.documentElement.scrollWidth") <= viewport["width"]
        box = page.locator('[data-preference="equal"]').bounding_box()
        assert box["y"] + box["height"] <= viewport["height"]
