"""What the measurements share: arguments, timing in turns, tables, a server of the page, and the
files that results are written to.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from poem_envs.vector import available_cores
from sb3_poem.benchmark.provenance import commit, machine

RESULTS = Path(__file__).parent / "results"
ZOO = Path(__file__).parents[1] / "zoo_configs"
OUT = {"type": Path, "default": RESULTS / "speed", "help": "folder of the results"}


def arguments(description: str | None, /, **options: Any) -> argparse.Namespace:
    """Parse the command line.

    :param description: The script's docstring
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

    :raises argparse.ArgumentTypeError: if it is not
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
    """Write ``<out>/<name>.md`` and ``.json``, and print the former.

    :param sections: Paragraphs and tables in Markdown
    :param data: What the tables were made of; None writes no JSON
    :param settings: Of this run, printed below
    :param threads: The most that any contender used
    :raises RuntimeError: if the process has fewer cores than that, as when it was pinned after it
        began
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


@contextlib.contextmanager
def label_server(model: str, *words: str) -> Iterator[tuple[subprocess.Popen[str], str, Path]]:
    """``sb3-poem label`` on loopback: its process, its address, and the folder of its store."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-u", "-m", "sb3_poem.cli", "label", "--model", model]
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
