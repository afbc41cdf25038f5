"""How long does a person wait for the next pair? Answers left and right in turn, in Chromium, and
prints every wait.

python benchmarks/label_browser.py [--model HalfCheetahVel] [--answers 9] [--watch 6] [--screenshot
FILE]
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time

from playwright.sync_api import sync_playwright


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
        page.wait_for_selector('#board[data-phase="question"]', timeout=300_000)
        first, seconds = time.perf_counter() - started, []
        for i in range(answers):
            page.wait_for_timeout(1000.0 * watch)
            started = time.perf_counter()
            page.keyboard.press("ArrowLeft" if i % 2 else "ArrowRight")
            page.wait_for_function(
                "i => document.getElementById('count').textContent.startsWith(String(i + 2))", arg=i
            )
            page.wait_for_function(
                "() => document.getElementById('progress').hidden", timeout=300_000
            )
            seconds.append(time.perf_counter() - started)
        if screenshot:
            page.screenshot(path=screenshot)
        browser.close()
    return first, seconds


def main() -> None:
    """Start a server, answer, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", default="HalfCheetahVel")
    parser.add_argument("--answers", type=int, default=9, choices=range(1, 10), metavar="1..9")
    parser.add_argument("--watch", type=float, default=6.0, help="seconds before each answer")
    parser.add_argument("--screenshot", help="a PNG of the page at the end")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            "-m",
            "sb3_poem.cli",
            "label",
            "--model",
            arguments.model,
            "--port",
            "0",
            "--store",
            folder,
        ]
        environment = {"MUJOCO_GL": "egl", **os.environ, "PYTHONUNBUFFERED": "1"}
        server = subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        try:
            assert server.stdout is not None
            url = next(
                found for line in server.stdout if (found := re.search(r"http://\S+", line))
            ).group()
            first, seconds = waits(url, arguments.answers, arguments.watch, arguments.screenshot)
        finally:
            server.terminate()
            server.wait()
    print(
        json.dumps(
            {
                "first_question_s": round(first, 1),
                "next_pair_s": [round(value, 2) for value in seconds],
            }
        )
    )


if __name__ == "__main__":
    main()
