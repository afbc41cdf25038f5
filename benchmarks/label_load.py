"""Several people at once on the page: the time to the next question, answers per second, memory,
and whether an answer is lost.

``sb3-poem label`` runs on loopback; each person is a thread that watches for a while, answers, and
waits for what comes next.

    python benchmarks/label_load.py --people 8 --seconds 90 --watch 8
"""

from __future__ import annotations

import argparse
import http.client
import json
import random
import re
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.parse
from pathlib import Path
from typing import Any

from sb3_poem.label.store import Store

POLL_SECONDS = 0.15
# What a person, however slow the machine, waits for at most.
PATIENCE_SECONDS = 120.0


class Person(threading.Thread):
    """Answers at random until the time is up, and notes how long each next question took."""

    def __init__(self, port: int, model: str, watch: float, until: float, seed: int) -> None:
        super().__init__(daemon=True)
        self.port, self.model, self.watch, self.until = port, model, watch, until
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
        self.token = self._start()
        view = self._settled()
        self.first = time.monotonic() - begun
        while time.monotonic() < self.until and view["phase"] == "question":
            time.sleep(self.random.uniform(0.5, 1.5) * self.watch)
            preference = self.random.choice(("left", "right", "equal"))
            asked = time.monotonic()
            self._send(
                f"/s/{self.token}/answer",
                {"question": view["turn"]["id"], "preference": preference},
            )
            self.given.append(preference)
            view = self._settled()
            # The film itself is part of what a person waits for.
            self._get(f"/s/{self.token}/video/{view['turn']['id']}")
            self.waits.append(time.monotonic() - asked)

    def _settled(self) -> dict[str, Any]:
        deadline = time.monotonic() + PATIENCE_SECONDS
        while time.monotonic() < deadline:
            view = json.loads(self._get(f"/s/{self.token}/state"))
            if view["phase"] != "preparing":
                return view
            time.sleep(POLL_SECONDS)
        raise TimeoutError(f"no question within {PATIENCE_SECONDS} s")

    def _start(self) -> str:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        body = urllib.parse.urlencode({"model": self.model})
        connection.request(
            "POST", "/start", body, {"Content-Type": "application/x-www-form-urlencoded"}
        )
        location = connection.getresponse().headers["Location"]
        connection.close()
        return location.rpartition("/")[2]

    def _send(self, path: str, data: dict[str, Any]) -> None:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        connection.request("POST", path, json.dumps(data), {"Content-Type": "application/json"})
        response = connection.getresponse()
        if response.status != 200:
            raise RuntimeError(f"{path} was answered {response.status}: {response.read().decode()}")
        connection.close()

    def _get(self, path: str) -> bytes:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        connection.request("GET", path)
        response = connection.getresponse()
        content = response.read()
        connection.close()
        if response.status != 200:
            raise RuntimeError(f"{path} was answered {response.status}")
        return content


def _wait_until_warm(port: int, model: str) -> None:
    """One question, so that the workers have loaded everything."""
    first = Person(port, model, 0.0, 0.0, 0)
    first.run()
    if first.error is not None:
        raise RuntimeError(f"the server does not work: {first.error}")


def memory_of(pid: int) -> float:
    """Resident memory of a process, MB."""
    line = next(
        line
        for line in Path(f"/proc/{pid}/status").read_text().splitlines()
        if line.startswith("VmRSS")
    )
    return int(line.split()[1]) / 1024


def children_of(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def busy_share(seconds: float = 2.0) -> float:
    """How much of all processors other programs use, before the measurement."""

    def read() -> tuple[int, int]:
        values = [
            int(value) for value in Path("/proc/stat").read_text().splitlines()[0].split()[1:]
        ]
        return sum(values), values[3] + values[4]

    total, idle = read()
    time.sleep(seconds)
    total_after, idle_after = read()
    return 1.0 - (idle_after - idle) / (total_after - total)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", default="HalfCheetahVel")
    parser.add_argument("--people", type=int, default=8, choices=range(1, 33), metavar="1..32")
    parser.add_argument("--seconds", type=float, default=90.0, help="at most 600")
    parser.add_argument(
        "--watch",
        type=float,
        default=8.0,
        help="mean seconds for which a person watches a question's films",
    )
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, help="write the figures as JSON")
    arguments = parser.parse_args()
    if not 0.0 < arguments.seconds <= 600.0:
        parser.error("--seconds must be at most 600")
    if arguments.out is not None and arguments.out.is_dir():
        parser.error(f"--out must be a file, but {arguments.out} is a folder")

    others = busy_share()
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
        command += [
            "--queries",
            "1000",
            "--max-sessions",
            str(arguments.people + 1),
            "--workers",
            str(arguments.workers),
        ]
        server = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert server.stdout is not None
        match = re.search(r":(\d+)", server.stdout.readline().partition("127.0.0.1")[2])
        assert match is not None, "the server did not start"
        port = int(match[1])
        try:
            _wait_until_warm(port, arguments.model)
            memory_before = memory_of(server.pid)
            until = time.monotonic() + arguments.seconds
            people = [
                Person(port, arguments.model, arguments.watch, until, seed)
                for seed in range(arguments.people)
            ]
            begun = time.monotonic()
            for person in people:
                person.start()
            for person in people:
                person.join()
            took = time.monotonic() - begun
            memory = memory_of(server.pid)
            workers = [memory_of(child) for child in children_of(server.pid)]
        finally:
            server.terminate()
            server.wait()
        store = Store(folder)
        lost = 0
        for person in people:
            session = store.find(person.token)
            kept = (
                [] if session is None else [row["preference"] for row in store.answers(session.id)]
            )
            lost += kept != person.given
        store.close()
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
        "busy_with_other_programs_before": round(others, 2),
    }
    print(json.dumps(result, indent=1))
    if arguments.out is not None:
        arguments.out.write_text(
            json.dumps({"command": " ".join(sys.argv), **result}, indent=1) + "\n"
        )


if __name__ == "__main__":
    main()
