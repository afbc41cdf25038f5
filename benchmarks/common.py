"""What all benchmarks share: timing in turns, a description of the machine, and the files that
results are written to.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sb3_poem.benchmark.provenance import commit, machine

RESULTS = Path(__file__).parent / "results"
SPEED = RESULTS / "speed"


def arguments(
    description: str | None, add: Callable[[argparse.ArgumentParser], None] | None = None
) -> argparse.Namespace:
    """Parse the command line.

    :param description: The script's docstring
    :param add: Adds the script's own arguments
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=SPEED, help="folder of the results")
    if add is not None:
        add(parser)
    return parser.parse_args()


def available_device(name: str) -> str:
    """The type of an argument that names a device: one that is there, since results are filed under
    its name.

    :raises argparse.ArgumentTypeError: if it is not
    """
    import torch

    if name.startswith("cuda") and not torch.cuda.is_available():
        raise argparse.ArgumentTypeError(
            f"{name}: torch {torch.__version__} sees no CUDA device here"
        )
    return name


def cores() -> int:
    """Cores that this process may use now."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def seconds_in_turns(
    contenders: dict[str, Callable[[], Any]], repeats: int, warm_up: int = 1
) -> dict[str, list[float]]:
    """Time contenders one after the other, again and again, so that a slow minute of the machine
    hits all of them.

    :param contenders: Functions of the same amount of work
    :param repeats: Timed calls of each
    :param warm_up: Calls before that
    :return: Seconds of every call
    """
    for function in contenders.values():
        for _ in range(warm_up):
            function()
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(repeats):
        for name, function in contenders.items():
            started = time.perf_counter()
            function()
            seconds[name].append(time.perf_counter() - started)
    return seconds


def ratio(numerators: Sequence[float], denominators: Sequence[float]) -> float:
    """The median ratio of two contenders' seconds, turn by turn."""
    return statistics.median(a / b for a, b in zip(numerators, denominators, strict=True))


def table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A Markdown table; numbers in three digits."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join([*lines, *("| " + " | ".join(map(_cell, row)) + " |" for row in rows)])


def write(
    name: str,
    title: str,
    sections: Sequence[str],
    data: Any,
    out: Path,
    settings: dict[str, Any],
    threads: int = 1,
) -> None:
    """Write ``<out>/<name>.md`` and ``.json``, and print the former.

    :param name: Of the files
    :param title: Heading
    :param sections: Paragraphs and tables in Markdown
    :param data: What the tables were made of
    :param out: Folder
    :param settings: Of this run, printed below
    :param threads: The most that any contender used
    :raises RuntimeError: if the process has fewer cores than that, as when it was pinned after it
        began
    """
    if cores() < threads:
        raise RuntimeError(
            f"{name} was to be measured with {threads} threads, but this process may use {cores()} core(s) by now; nothing "
            "was written, since contenders that share a core say nothing about threads. "
            "Free the cores, or ask for fewer threads."
        )
    origin = {
        "command": " ".join(
            ["python", f"benchmarks/{Path(sys.argv[0]).name}", *_without_out(sys.argv[1:])]
        ),
        "commit": commit(),
        "machine": machine(),
        "settings": settings,
    }
    footer = (
        f"`{origin['command']}` at {origin['commit']}, on {origin['machine']}. Settings: "
        + ", ".join(f"{key} {value}" for key, value in settings.items())
    )
    text = "\n\n".join([f"# {title}", *sections, footer]) + "\n"
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.md").write_text(text)
    (out / f"{name}.json").write_text(json.dumps({**origin, "results": data}, indent=1) + "\n")
    print(text, flush=True)


def _without_out(words: Sequence[str]) -> list[str]:
    kept, skip = [], False
    for word in words:
        if not skip and word != "--out":
            kept.append(word)
        skip = word == "--out"
    return kept


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else str(value)
