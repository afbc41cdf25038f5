"""How long does a person wait for the next pair? Answers left and right in turn, in Chromium, and
prints every wait.

python benchmarks/label_browser.py [--model HalfCheetahVel] [--answers 9] [--watch 6] [--screenshot
FILE]
"""

import json
import os
import shutil
import time

from common import arguments, label_server
from playwright.sync_api import sync_playwright

PATIENCE = 300_000  # milliseconds


def waits(
    url: str, answers: int, watch: float, screenshot: str | None
) -> tuple[float, list[float]]:
    """Seconds until the first question can be answered, and from every answer until the next one
    can be.
    """
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        page = browser.new_page(viewport={"width": 1200, "height": 900})
        page.goto(url)
        started = time.perf_counter()
        page.locator(".choices button").first.click()
        page.wait_for_selector('#board[data-phase="question"]', timeout=PATIENCE)
        first, seconds = time.perf_counter() - started, []
        for i in range(answers):
            page.wait_for_timeout(1000.0 * watch)
            started = time.perf_counter()
            page.keyboard.press("ArrowLeft" if i % 2 else "ArrowRight")
            counted = "i => document.getElementById('count').textContent.startsWith(String(i + 2))"
            page.wait_for_function(counted, arg=i)
            shown = "() => document.getElementById('progress').hidden"
            page.wait_for_function(shown, timeout=PATIENCE)
            seconds.append(time.perf_counter() - started)
        if screenshot:
            page.screenshot(path=screenshot)
        browser.close()
    return first, seconds


def main() -> None:
    given = arguments(
        __doc__,
        model="HalfCheetahVel",
        answers={"type": int, "default": 9, "choices": range(1, 10), "metavar": "1..9"},
        watch={"type": float, "default": 6.0, "help": "seconds before each answer"},
        screenshot={"help": "a PNG of the page at the end"},
    )
    os.environ.setdefault("MUJOCO_GL", "egl")
    with label_server(given.model) as (_, url, _):
        first, seconds = waits(url, given.answers, given.watch, given.screenshot)
    waited = [round(value, 2) for value in seconds]
    print(json.dumps({"first_question_s": round(first, 1), "next_pair_s": waited}))


if __name__ == "__main__":
    main()
