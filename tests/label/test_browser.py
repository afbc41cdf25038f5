"""The page in a real browser: a scripted person who looks at nothing but true returns."""

from __future__ import annotations

import json
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from label_world import make_sessions
from PIL import Image

from sb3_poem import Bayes
from sb3_poem.adaptation import PreferenceAdapter, ReturnOracle, evaluate_episodes
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.label.families import ModelInfo, find_models
from sb3_poem.label.rendering import load_shown_model
from sb3_poem.label.server import ROBOTS, bind, make_app, make_server
from sb3_poem.label.store import Store

playwright_api = pytest.importorskip(
    "playwright.sync_api", reason="the Python package playwright is not installed"
)
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium: apt-get install chromium"),
    pytest.mark.xdist_group("browser"),
]
SEED = 3
DESKTOP, PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}
LANDSCAPE = {"width": 844, "height": 390}
# Differences of returns that the scripted person calls better, and much better.
THRESHOLDS = {"PointGoal": (1.0, 8.0), "HalfCheetahVel": (5.0, 60.0)}
KEYS = {
    "pair": {"left": "ArrowLeft", "equal": "2", "right": "ArrowRight"},
    "graded": {"much left": "1", "left": "2", "equal": "3", "right": "ArrowRight"}
    | {"much right": "5"},
    "best-of-four": {"first": "1", "second": "2", "third": "3", "fourth": "4", "equal": "0"},
}
SHOWN = "() => typeof view !== 'undefined' && view !== null && view.phase !== 'preparing' && !busy"


class Server:
    """``sb3-poem label`` in a process of its own, which may be killed and started again."""

    def __init__(self, store: Path, model: str, queries: int = 5) -> None:
        self.store, self.model, self.queries, self.port = store, model, queries, 0
        self.start()

    def start(self) -> None:
        command = [sys.executable, "-m", "sb3_poem", "label", "--model", self.model]
        command += ["--port", str(self.port), "--store", str(self.store), "--workers", "1"]
        command += ["--queries", str(self.queries), "--seed", str(SEED), "--max-sessions", "40"]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        match = re.search(r"http://127\.0\.0\.1:(\d+)", line)
        assert match is not None, line
        self.port = int(match[1])
        self.url = match[0]

    def kill(self) -> None:
        os.kill(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def stop(self) -> None:
        self.process.terminate()
        try:
            self.process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            self.kill()


class ForkedServer:
    """The same in a fork of this process, which need not import everything anew."""

    def __init__(self, store: Path, info: ModelInfo, **options: str) -> None:
        self.store, self.info, self.options = store, info, options
        self.listener = bind("127.0.0.1", 0)
        self.port = self.listener.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"
        self.start()

    def start(self) -> None:
        self.process = multiprocessing.get_context("fork").Process(target=self.serve, daemon=True)
        self.process.start()

    def serve(self) -> None:
        how = {"n_queries": 5, "options": self.options}
        app = make_app(make_sessions(Store(self.store), self.info, **how))
        make_server(app, "127.0.0.1", self.port).run(sockets=[self.listener])

    def kill(self) -> None:
        self.process.kill()
        self.process.join()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright_api.sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield launched
        launched.close()


@pytest.fixture(scope="module")
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


class Person:
    """Answers by the true return of what was shown, as an oracle that knows the task."""

    def __init__(
        self, server: Server | ForkedServer, page: Any, info: ModelInfo, task: float
    ) -> None:
        self.page = page
        self.token = page.url.rpartition("/s/")[2]
        self.task = np.array([task])
        self.question = page.evaluate("() => view.question")
        kinds = {"graded": {"thresholds": THRESHOLDS[info.name]}, "pair": {}}
        how = kinds.get(self.question, {"question": self.question})
        self.oracle = ReturnOracle(gym.make(info.env_id), self.task, **how)
        self.store = server.store

    def judge(self) -> str:
        """The answer to the question that waits."""
        store = Store(self.store)
        session = store.find(self.token)
        assert session is not None
        turn = store.turn(session.id, "question", len(store.answers(session.id)))
        assert turn is not None
        row = store.whole_turn(turn["id"])
        store.close()
        assert row is not None
        shown = map(Trajectory.from_dict, json.loads(row["trajectories"]).values())
        return self.oracle(*shown).value

    def answer(self, times: int = 1, keyboard: bool = False) -> None:
        for _ in range(times):
            self.page.wait_for_function(SHOWN)
            self.say(self.judge(), keyboard)

    def say(self, preference: str, keyboard: bool = False) -> None:
        answered = self.answered()
        if keyboard:
            self.page.keyboard.press(KEYS[self.question][preference])
        else:
            self.page.click(f'[data-preference="{preference}"]')
        self.page.wait_for_function(
            f"() => view.answered === {answered + 1} && view.phase !== 'preparing' && !busy"
        )

    def answered(self) -> int:
        return int(self.page.evaluate("() => view.answered"))

    def stored(self) -> list[str]:
        store = Store(self.store)
        session = store.find(self.token)
        assert session is not None
        answers = [row["preference"] for row in store.answers(session.id)]
        store.close()
        return answers

    def learned(self) -> np.ndarray:
        store = Store(self.store)
        session = store.find(self.token)
        assert session is not None
        turn = store.turn(session.id, "result", len(store.answers(session.id)))
        store.close()
        assert turn is not None
        return np.array(json.loads(turn["latent"]))


def begin(
    open_page: Callable[..., Any],
    server: Server | ForkedServer,
    info: ModelInfo,
    task: float,
    **options: Any,
) -> Person:
    page = open_page(server.url, **options)
    page.click(f"button[value={info.name}]")
    page.wait_for_function(SHOWN)
    return Person(server, page, info, task)


def returns(info: ModelInfo, latents: np.ndarray, task: float) -> np.ndarray:
    """True returns of latents, the mean of the same ten episodes each."""
    env, model = make_task_vec_env(info.env_id, 10), load_shown_model(info)
    values = [
        evaluate_episodes(
            model, env, latent[None, :], np.array([[task]]), 10, seed=77
        ).returns.mean()
        for latent in latents
    ]
    env.close()
    return np.array(values)


def oracles_latents(info: ModelInfo, task: float, n_queries: int) -> np.ndarray:
    """Before any answer, and after those by ``ReturnOracle``."""
    thresholds = THRESHOLDS[info.name]
    oracle = ReturnOracle(gym.make(info.env_id), np.array([task]), thresholds=thresholds)
    options: dict[str, Any] = {
        "n_queries": n_queries,
        "rule": Bayes(question="graded", noise_model="infer"),
    }
    model = load_shown_model(info)
    adapter = PreferenceAdapter(model, info.env_id, oracle=oracle, seed=SEED, **options)
    before = adapter.policy().latent
    return np.stack([before, adapter.adapt().latent])


def assert_learned(info: ModelInfo, person: Person, task: float) -> None:
    by_others = oracles_latents(info, task, len(person.stored()))
    latents = np.vstack([by_others, person.learned()])
    before, by_oracle, by_person = returns(info, latents, task)
    # What ReturnOracle's answers gained, a person on the page must gain, but for a hundredth.
    assert by_oracle > before
    assert by_person >= by_oracle - 0.01 * (by_oracle - before), (before, by_oracle, by_person)


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


def test_undo_and_reload_in_the_middle(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo
) -> None:
    person = begin(open_page, server, point_goal, 0.4)
    page = person.page
    person.answer(3)
    sentences = page.text_content("#belief-sentence")
    video = page.evaluate("() => view.turn.id")
    page.reload()
    page.wait_for_function(SHOWN)
    assert (person.answered(), page.text_content("#belief-sentence")) == (3, sentences)
    assert page.evaluate("() => view.turn.id") == video
    for left in (2, 1, 0):
        page.click("#undo")
        page.wait_for_function(f"() => view.answered === {left} && !busy")
    assert page.is_hidden("#undo")
    assert person.stored() == []
    person.answer(3)
    assert page.text_content("#belief-sentence") == sentences
    page.click("#stop")
    page.wait_for_selector("text=Filming what it learned")
    assert page.text_content("#undo-text") == "Back to the questions"
    page.wait_for_selector("#result:visible")
    page.click("#undo")  # back to the questions
    page.wait_for_selector("#answers:visible")
    assert person.answered() == 3


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
    for element in page.query_selector_all(
        "button:visible, a:visible, input:visible, select:visible, textarea:visible"
    ):
        element.focus()
        assert element.evaluate("element => element === document.activeElement")


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


@pytest.mark.parametrize("question", [*ANSWERS])
def test_all_answers_by_keys_and_by_clicks(
    open_page: Callable[..., Any], point_goal: ModelInfo, tmp_path: Path, question: str
) -> None:
    server = ForkedServer(tmp_path, point_goal, question=question)
    person = begin(open_page, server, point_goal, 1.0)
    page, answers = person.page, ANSWERS[question]
    buttons = page.get_by_role("group", name="Your answer").get_by_role("button")
    texts = [" ".join(text.split()) for text in buttons.all_text_contents()]
    assert texts == [text for text, _, _ in answers]
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
    server.kill()


@pytest.fixture
def of_four(point_goal: ModelInfo, tmp_path: Path) -> Iterator[ForkedServer]:
    server = ForkedServer(tmp_path, point_goal, question="best-of-four")
    yield server
    server.kill()


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


@pytest.mark.parametrize("viewport", [PHONE, LANDSCAPE], ids=["upright", "on its side"])
def test_four_on_a_phone(
    open_page: Callable[..., Any],
    of_four: ForkedServer,
    point_goal: ModelInfo,
    viewport: dict[str, int],
) -> None:
    person = begin(open_page, of_four, point_goal, 2.0, viewport=viewport, has_touch=True)
    page = person.page
    person.answer(1)
    assert page.evaluate("() => document.documentElement.scrollWidth") <= viewport["width"]
    needed = [page.locator(f'[data-preference="{word}"]') for word in KEYS["best-of-four"]]
    for element in (*page.locator("canvas").all(), page.locator("#play"), *needed):
        box = element.bounding_box()
        assert 0 <= box["x"] <= viewport["width"] - box["width"]
        assert box["y"] + box["height"] <= viewport["height"]  # all that is needed is in sight
        assert min(box["width"], box["height"]) >= 44
    assert page.locator("canvas >> nth=0").bounding_box()["width"] >= 160
    page.click("#full")
    page.wait_for_function("() => document.fullscreenElement !== null")
    boxes = [canvas.bounding_box() for canvas in page.locator("canvas").all()]
    assert boxes[0]["y"] == boxes[1]["y"] < boxes[2]["y"] == boxes[3]["y"]
    assert boxes[3]["y"] + boxes[3]["height"] <= viewport["height"]


def test_a_pair_is_shown_again_where_answers_contradict_each_other(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo
) -> None:
    person = begin(open_page, server, point_goal, 2.5)
    page = person.page
    assert page.is_hidden("#doubt")
    films = []
    while not page.is_visible("#doubt"):
        films.append(page.evaluate("() => view.turn.id"))
        answer = person.judge()
        if len(films) == 1:
            answer = "much right" if "left" in answer else "much left"
        person.say(answer)
    assert "Look at pair 1 again?" in " ".join(page.inner_text("#doubt").split())
    answered = person.answered()
    page.click("#again")
    page.wait_for_function("() => view.turn.repeats === 0 && !busy")
    assert page.text_content("#task").startswith("Pair 1 once more: which")
    assert page.is_hidden("#doubt")
    assert person.answered() == answered
    first, again = (
        page.request.get(f"{page.url}/video/{turn}").body()
        for turn in (films[0], page.evaluate("() => view.turn.id"))
    )
    assert first == again
    person.answer()
    record = page.request.get(f"{page.url}/answers.json").json()
    assert [answer["repeats"] for answer in record["answers"]] == [None] * answered + [0]


TOPS = """() => {
  window.tops = new Set();
  const measure = () => {
    const answers = document.getElementById("answers");
    const shown = answers && answers.offsetParent;
    if (shown) tops.add(Math.round(answers.getBoundingClientRect().top + scrollY));
    requestAnimationFrame(measure);
  };
  measure();
}"""


@pytest.mark.parametrize("viewport", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_the_answers_stay_where_they_are(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo, viewport: dict[str, int]
) -> None:
    page = open_page(server.url, viewport=viewport)
    page.add_init_script(f"({TOPS})()")  # in every frame, from the first on
    page.click(f"button[value={point_goal.name}]")
    page.wait_for_selector("#progress:visible")
    page.wait_for_function(SHOWN)
    wish, films = (page.locator(part).bounding_box() for part in ("#wish", "#screens"))
    assert wish["y"] + wish["height"] <= films["y"]  # one wishes before one looks
    person = Person(server, page, point_goal, 2.5)
    page.evaluate("() => showError('The server does not answer. '.repeat(9))")
    person.say("much right" if "left" in person.judge() else "much left")
    while not page.is_visible("#doubt"):
        person.answer()
    assert person.answered() < server.queries
    page.click("#again")
    page.wait_for_function("() => view.turn.repeats === 0 && !busy")
    person.answer(server.queries - person.answered())
    page.wait_for_selector("#result:visible")
    assert len(page.evaluate("() => [...tops]")) == 1


def test_both_halves_of_the_film_are_in_step(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo
) -> None:
    person = begin(open_page, server, point_goal, 1.0)
    page = person.page
    for frame in (0, 7, 24, 3):
        page.evaluate("frame => player.seek(frame)", frame)
        page.wait_for_function(
            "frame => !player.video.seeking && player.frame === frame", arg=frame
        )
    page.evaluate("() => player.seek(24)")
    page.wait_for_function(
        "() => !player.video.seeking && document.querySelector('#frame').value === '24'"
    )
    left, right, race = (coloured(page, side) for side in ("left", "right", "race"))
    # The dot of either side is on its own screen, and both are in the race.
    assert min(left["blue"], right["orange"]) > 20
    assert left["orange"] == right["blue"] == 0
    assert min(race.values()) > 20
    assert sum(race.values()) > 0.9 * max(left["blue"], right["orange"])  # one may hide the other


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


def test_both_robots_in_one_picture(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo
) -> None:
    person = begin(open_page, server, point_goal, 1.0)
    page = person.page

    def seen() -> list[bool]:
        return [page.is_visible(f"#{side}-screen") for side in ("left", "right", "race")]

    assert seen() == [False, False, True]  # which tells more where robots go to places
    assert page.get_attribute("#race", "aria-pressed") == "true"
    page.evaluate("() => player.seek(player.frames - 1)")
    page.wait_for_function("() => player.drawn === player.frames - 1")
    assert min(coloured(page, "race").values()) > 20
    page.keyboard.press("r")
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
    said = {"much left": "Left much better", "left": "Left a bit better", "equal": "Can"}  # 't tell
    said |= {"right": "Right a bit better", "much right": "Right much better"}
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
    assert items[0].split(" Show")[0] in page.text_content("#then")
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
    page.get_by_role("button", name="Show again: pair 2").click()  # from the result
    page.wait_for_selector(".past #then")
    assert page.is_hidden("#result")
    page.click("#back")
    page.wait_for_selector("#result:visible")
    assert page.is_hidden("#right-figure")


@pytest.mark.parametrize("viewport", [DESKTOP, PHONE, LANDSCAPE])
def test_the_films_fill_the_screen(
    open_page: Callable[..., Any], server: Server, point_goal: ModelInfo, viewport: dict[str, int]
) -> None:
    person = begin(open_page, server, point_goal, 2.0, viewport=viewport)
    page, width, height = person.page, viewport["width"], viewport["height"]
    full = "() => document.fullscreenElement !== null"
    for screens in (["#race-screen"], ["#left-screen", "#right-screen"]):
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
        """() => [...document.querySelectorAll('kbd, .note, .hint, figcaption')].map(element => {
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
    # The map's words are above its dots.
    drawn = page.evaluate(
        """() => {
            drawBelief(byId('belief'), { picture: 'place', points: [[0, 0]], weights: [1], unit: 'm',
                estimate: [1, 1], extent: 3.5, words: ['right', 'ahead', 'left', 'back'] });
            const drawn = [...byId('belief').querySelectorAll('.cloud, text')];
            return drawn.map(element => element.textContent || 'dot');
        }"""
    )
    words = ["start", "1 m", "2 m", "3 m", "right", "ahead", "left", "back"]
    assert drawn == ["dot", *words]


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
