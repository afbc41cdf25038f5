"""What the benchmarks share: contenders that take turns, and results with what made them."""

import json
import os
import platform
import shlex
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
PACKAGES = ("torch", "stable-baselines3", "gymnasium", "mujoco", "numpy")


def take_turns(contenders: Mapping[str, Callable[[], Any]], turns: int, warm_up: int = 1) -> dict[str, float]:
    """Seconds that each contender takes: the median of its turns, with every round giving each of them one.

    :param contenders: What to time
    :param turns: Rounds that count
    :param warm_up: Rounds before them
    """
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for turn in range(warm_up + turns):
        for name, run in contenders.items():
            started = time.perf_counter()
            run()
            if turn >= warm_up:
                seconds[name].append(time.perf_counter() - started)
    return {name: statistics.median(values) for name, values in seconds.items()}


def machine() -> str:
    """The processor as it describes itself."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    fields = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    special = [flag for flag in ("avx2", "avx512f", "avx512_bf16", "amx_bf16") if flag in fields.get("flags", "").split()]
    name = fields.get("model name", platform.processor() or platform.machine())
    return f"{name}, {len(os.sched_getaffinity(0))} cores, {' '.join(special)}"


def write_results(
    name: str,
    description: str | None,
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    results: Any,
    seconds: float,
) -> None:
    """Write ``results/<name>.json`` and ``.md``, and print the table.

    :param description: What is measured, and how
    :param header: Columns of the table
    :param rows: Its cells
    :param results: Everything that was measured, for the JSON
    :param seconds: How long the benchmark took
    """
    git = ["git", "describe", "--always", "--dirty", "--exclude", "*"]
    made_by = {
        "command": shlex.join(["python", *(os.path.relpath(part) if Path(part).exists() else part for part in sys.argv)]),
        "commit": subprocess.run(git, capture_output=True, text=True, cwd=RESULTS.parent).stdout.strip(),
        "machine": machine(),
        "versions": {package: version(package) for package in PACKAGES},
        "seconds": round(seconds),
    }
    table = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header), *("| " + " | ".join(row) + " |" for row in rows)]
    versions = ", ".join(f"{package} {number}" for package, number in made_by["versions"].items())  # type: ignore[union-attr]
    text = [f"# {name.replace('-', ' ').capitalize()}", "", (description or "").strip(), "", *table, ""]
    text += [f"`{made_by['command']}` at {made_by['commit']}; {made_by['machine']}; {versions}; {made_by['seconds']} s."]
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps({**made_by, "results": results}, indent=1))
    (RESULTS / f"{name}.md").write_text("\n".join(text) + "\n")
    print("\n".join(table))
