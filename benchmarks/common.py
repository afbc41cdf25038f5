"""What the measurements share: arguments, timing in turns, tables, and the files that results are
written to.
"""

import argparse
import json
import re
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from poem_envs.vector import available_cores
from sb3_poem.benchmark.provenance import commit, machine

RESULTS = Path(__file__).parent / "results"
OUT = {"type": Path, "default": RESULTS / "speed", "help": "folder of the results"}


def arguments(description: str | None, /, **options: Any) -> argparse.Namespace:
    """Parse the command line, as a script's docstring describes it.

    :param options: By name, each by its default, a list where there may be several; or by the
        arguments of ``add_argument``, as a dictionary
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, default in {"out": OUT, **options}.items():
        if isinstance(default, dict):
            how = default
        elif isinstance(default, list):
            how = {"type": type(default[0]), "nargs": "+", "default": default}
        else:
            how = {"type": type(default), "default": default}
        parser.add_argument(f"--{name.replace('_', '-')}", **how)
    return parser.parse_args()


def available_device(name: str) -> str:
    """The type of an argument that names a device: one that is there, since results are filed under
    its name.
    """
    import torch

    if name.startswith("cuda") and not torch.cuda.is_available():
        raise argparse.ArgumentTypeError(
            f"{name}: torch {torch.__version__} sees no CUDA device here"
        )
    return name


DEVICE = {"type": available_device, "default": "cpu"}


def seconds_in_turns(
    contenders: dict[str, Callable[[], Any]], repeats: int, warm_up: int = 1
) -> dict[str, list[float]]:
    """The seconds of every timed call of contenders, which do the same amount of work, one after
    the other, again and again, so that a slow minute of the machine hits all of them.
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


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def write(
    name: str,
    title: str,
    sections: Sequence[str],
    data: Any,
    out: Path,
    settings: dict[str, Any],
    threads: int = 1,
) -> None:
    """Write ``<out>/<name>.md`` of sections in Markdown and, unless ``data`` is None, what they
    were made of as ``.json``; print the former. A ``RuntimeError`` if the process has fewer cores
    than the most ``threads`` of a contender, as when it was pinned after it began.
    """
    if available_cores() < threads:
        raise RuntimeError(
            f"{name} was to be measured with {threads} threads, but this process may use "
            f"{available_cores()} core(s) by now; nothing was written, since contenders that share "
            "a core say nothing about threads. Free the cores, or ask for fewer threads."
        )
    words = re.sub(r" --out \S+", "", " ".join(["", *sys.argv[1:]]))
    command = f"python benchmarks/{Path(sys.argv[0]).name}{words}"
    origin = {"command": command, "commit": commit(), "machine": machine(), "settings": settings}
    footer = f"`{command}`, on {origin['machine']}."
    if settings:
        footer += " Settings: " + ", ".join(f"{key} {value}" for key, value in settings.items())
    text = "\n\n".join([f"# {title}", *sections, footer]) + "\n"
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.md").write_text(text)
    if data is not None:
        (out / f"{name}.json").write_text(json.dumps({**origin, "results": data}, indent=1) + "\n")
    print(text, flush=True)
