"""A scripted person at the page in a real browser, who looks at nothing but true returns."""

from __future__ import annotations

import importlib.util
import json
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from label_world import make_sessions

from sb3_poem import Bayes
from sb3_poem.adaptation import PreferenceAdapter, ReturnOracle, evaluate_episodes
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.label.families import ModelInfo
from sb3_poem.label.rendering import load_shown_model
from sb3_poem.label.server import bind, make_app, make_server
from sb3_poem.label.store import Store

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
NO_PLAYWRIGHT = importlib.util.find_spec("playwright") is None
#: The marks of a file of such tests.
BROWSER = [
    pytest.mark.skipif(NO_PLAYWRIGHT, reason="the Python package playwright is not installed"),
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium: apt-get install chromium"),
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
