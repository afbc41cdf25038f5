"""Several people at once on the page: the time to the next question, answers per second, memory,
and whether an answer is lost.

``sb3-poem label`` runs on loopback; each person is a thread that watches for a while, answers, and
waits for what comes next.

    python benchmarks/label_load.py --people 8 --seconds 90 --watch 8
"""

import contextlib
import json
import os
import random
import re
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.parse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import requests
from common import arguments

from sb3_poem.adaptation.preference import ANSWERS
from sb3_poem.label.store import Store

POLL_SECONDS = 0.15
# What a person, however slow the machine, waits for at most.
PATIENCE_SECONDS = 120.0


class Person(threading.Thread):
    """Answers at random until the time is up, and notes how long each next question took."""

    def __init__(self, server: str, model: str, watch: float, until: float, seed: int) -> None:
        super().__init__(daemon=True)
        self.server, self.model, self.watch, self.until = server, model, watch, until
        self.random = random.Random(seed)
        self.waits: list[float] = []
        self.given: list[str] = []
        self.token = ""
        self.first = 0.0
        self.error: str | None = None

    def run(self) -> None:
        try:
            self._talk()
        except Exception as error:
            self.error = repr(error)

    def _talk(self) -> None:
        begun = time.monotonic()
        start = self._call("/start", data={"model": self.model})
        self.token = start.headers["Location"].rpartition("/")[2]
        view = self._settled()
        self.first = time.monotonic() - begun
        while time.monotonic() < self.until and view["phase"] == "question":
            time.sleep(self.random.uniform(0.5, 1.5) * self.watch)
            preference = self.random.choice(ANSWERS[view["question"]]).value
            asked = time.monotonic()
            answer = {"question": view["turn"]["id"], "preference": preference}
            self._call(f"/s/{self.token}/answer", json=answer)
            self.given.append(preference)
            view = self._settled()
            # The film itself is part of what a person waits for.
            self._call(f"/s/{self.token}/video/{view['turn']['id']}")
            self.waits.append(time.monotonic() - asked)

    def _settled(self) -> dict[str, Any]:
        deadline = time.monotonic() + PATIENCE_SECONDS
        while time.monotonic() < deadline:
            view: dict[str, Any] = self._call(f"/s/{self.token}/state").json()
            if view["phase"] != "preparing":
                return view
            time.sleep(POLL_SECONDS)
        raise TimeoutError(f"no question within {PATIENCE_SECONDS} s")

    def _call(self, path: str, **posted: Any) -> requests.Response:
        call = requests.post if posted else requests.get
        response = call(f"{self.server}{path}", timeout=60, allow_redirects=False, **posted)
        response.raise_for_status()
        return response


@contextlib.contextmanager
def label_server(model: str, *words: str) -> Iterator[tuple[subprocess.Popen[str], str, Path]]:
    """``sb3-poem label`` on loopback: its process, its address, and the folder of its store."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-u", "-m", "sb3_poem", "label", "--model", model]
        command += ["--port", "0", "--store", folder, *words]
        server = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        try:
            for line in server.stdout or ():
                if found := re.search(r"http://\S+", line):
                    yield server, found.group(), Path(folder)
                    return
            raise RuntimeError("the server did not start")
        finally:
            server.terminate()
            server.wait()


def memory_of(pid: int) -> float:
    """Resident memory of a process, MB."""
    [line] = re.findall(r"VmRSS:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())
    return int(line) / 1024


def lost_answers(folder: Path, people: list[Person]) -> int:
    """Sessions whose answers in the store are not those that were given."""
    store = Store(folder)
    lost = 0
    for person in people:
        session = store.find(person.token)
        rows = [] if session is None else store.answers(session.id)
        lost += [row["preference"] for row in rows] != person.given
    store.close()
    return lost


def main() -> None:
    given = arguments(
        __doc__,
        model="HalfCheetahVel",
        people={"type": int, "default": 8, "choices": range(1, 33), "metavar": "1..32"},
        seconds={"type": float, "default": 90.0, "help": "at most 600"},
        watch={"type": float, "default": 8.0, "help": "mean seconds before an answer"},
        workers=2,
        out={"type": Path, "help": "write the figures to this file, as JSON"},
    )
    if not 0.0 < given.seconds <= 600.0:
        raise SystemExit("--seconds must be at most 600")
    if given.out is not None and given.out.is_dir():
        raise SystemExit(f"--out must be a file, but {given.out} is a folder")
    load = os.getloadavg()[0]  # of other programs
    words = ["--queries", "1000", "--max-sessions", str(given.people + 1)]
    words += ["--workers", str(given.workers)]
    with label_server(given.model, *words) as (server, url, folder):
        place = (f"http://{urllib.parse.urlsplit(url).netloc}", given.model)
        first = Person(*place, 0.0, 0.0, 0)  # one question, so that the workers have loaded all
        first.run()
        if first.error is not None:
            raise RuntimeError(f"the server does not work: {first.error}")
        begun, memory_before = time.monotonic(), memory_of(server.pid)
        until = begun + given.seconds
        people = [Person(*place, given.watch, until, i) for i in range(given.people)]
        for person in people:
            person.start()
        for person in people:
            person.join()
        took = time.monotonic() - begun
        memory = memory_of(server.pid)
        children = Path(f"/proc/{server.pid}/task/{server.pid}/children").read_text().split()
        workers = [memory_of(int(child)) for child in children]
        lost = lost_answers(folder, people)
    waits = sorted(wait for person in people for wait in person.waits)
    result = {
        "people": len(people),
        "seconds": round(took, 1),
        "answers": len(waits),
        "answers_per_second": round(len(waits) / took, 3),
        "to_next_question_median_s": round(statistics.median(waits), 2),
        "to_next_question_95_s": round(waits[min(len(waits) - 1, int(0.95 * len(waits)))], 2),
        "first_question_median_s": round(statistics.median(person.first for person in people), 2),
        "sessions_with_lost_answers": lost,
        "errors": [person.error for person in people if person.error],
        "server_MB": round(memory),
        "server_MB_per_session": round((memory - memory_before) / len(people), 2),
        "workers_MB": [round(value) for value in workers],
        "load_before": load,
    }
    print(json.dumps(result, indent=1))
    if given.out is not None:
        data = {"command": " ".join(sys.argv), **result}
        given.out.write_text(json.dumps(data, indent=1) + "\n")


if __name__ == "__main__":
    main()
