"""
The command line, ``sb3-poem``: train, enjoy, adapt, label and benchmark.

This file only reads the command; what a command needs is imported when it runs, so that ``sb3-poem --help`` is immediate.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium

from poem_envs.headless import has_display
from sb3_poem import __version__
from sb3_poem.cli.benchmark_arguments import add_benchmark

ZOO_COMMANDS = {
    "train": "meta-train an agent (rl_zoo3's train, with poem_sac and pearl_sac)",
    "enjoy": "watch a trained agent (rl_zoo3's enjoy)",
}
EXAMPLES = """\
examples:
  sb3-poem train --env poem/HalfCheetahVel-v0 --eval-freq 50000 -P
  sb3-poem adapt --model HalfCheetahVel --env poem/HalfCheetahVel-v0 --oracle return
  sb3-poem adapt --model logs/poem_sac/poem-AntGoal-v0_1/poem-AntGoal-v0.zip --env poem/AntGoal-v0 --oracle human
  sb3-poem label
  sb3-poem label export --out answers.parquet
"""
DEFAULT_STORE = Path("label_data")


def _count(minimum: int) -> type[int]:
    def count(text: str) -> int:
        value = int(text)
        if value < minimum:
            raise argparse.ArgumentTypeError(f"must be at least {minimum}, got {value}")
        return value

    count.__name__ = "whole number"
    return count  # type: ignore[return-value]


def _add_adapt_arguments(parser: argparse.ArgumentParser) -> None:
    model = parser.add_argument_group("what to adapt")
    model.add_argument("--model", required=True, help="a model's .zip, a pretrained folder, or the name of a shipped model")
    model.add_argument("--env", help="environment id (default: the one that the model was trained on)")
    model.add_argument(
        "--env-kwargs",
        nargs="+",
        metavar="KEY:VALUE",
        default=[],
        help="arguments of the environment, over those that the model was trained with",
    )
    model.add_argument("--gym-packages", nargs="+", metavar="MODULE", default=[], help="modules that register environments")
    model.add_argument("--device", default="cpu", help="PyTorch device (default: %(default)s)")
    # Small batches: more threads would mostly wait for one another, and for those that simulate.
    model.add_argument("--num-threads", type=_count(1), default=1, help="of PyTorch (default: %(default)s)")

    questions = parser.add_argument_group("the questions and who answers them")
    questions.add_argument("--oracle", choices=("return", "boltzmann", "mistake", "human"), default="return")
    questions.add_argument("--beta", type=float, help="inverse temperature of --oracle boltzmann (default: the paper's)")
    questions.add_argument("--mistake-rate", type=float, default=0.2, help="of --oracle mistake (default: %(default)s)")
    questions.add_argument("--queries", type=_count(1), default=10, help="questions per task (default: %(default)s)")
    questions.add_argument("--inference", choices=("paper", "bayes"), default="bayes", help="default: %(default)s")
    rules = ("worst-case", "information-gain", "random")
    questions.add_argument("--query-rule", choices=rules, help="how questions are chosen (default: the inference rule's own)")
    questions.add_argument(
        "--candidates",
        choices=("prior", "aggregate"),
        help="default: prior; for bayes aggregate where the training tasks are far from it",
    )
    questions.add_argument(
        "--n-candidates", type=_count(2), metavar="N", help="candidate latents (default: 400 for bayes, 100 for paper)"
    )

    tasks = parser.add_argument_group("test tasks")
    tasks.add_argument("--tasks", type=_count(1), help="how many, drawn anew (default: 30; 1 with --oracle human)")
    tasks.add_argument("--task", type=float, nargs="+", metavar="X", help="this one task instead, its numbers one by one")
    tasks.add_argument("--episodes", type=_count(1), default=10, help="per task and evaluation (default: %(default)s)")
    tasks.add_argument("--seed", type=_count(0), default=0, help="of the test tasks and of everything else (default: 0)")
    tasks.add_argument(
        "--record", type=_count(0), nargs="+", metavar="K", help="measure after so many answers (default: each)"
    )

    output = parser.add_argument_group("output")
    output.add_argument(
        "--store", type=Path, metavar="FOLDER", help="keep the answers of --oracle human where those of the page are"
    )
    output.add_argument("--json", type=Path, metavar="FILE", help="write every task's returns, with versions and command")
    output.add_argument("--plot", type=Path, metavar="FILE", help="write the return against the queries (PNG, PDF, SVG)")
    output.add_argument("--video", type=Path, metavar="FILE", help="write one task before and after side by side (MP4, GIF)")


def _add_label_arguments(parser: argparse.ArgumentParser) -> None:
    model = parser.add_argument_group("what is taught")
    model.add_argument(
        "--model", help="a pretrained folder, a folder of such, or the name of a shipped model (default: all that are shipped)"
    )
    model.add_argument("--env", help="environment id (default: the one that the model was trained on)")
    model.add_argument("--env-kwargs", nargs="+", metavar="KEY:VALUE", default=[], help="arguments of the environment")
    model.add_argument("--gym-packages", nargs="+", metavar="MODULE", default=[], help="modules that register environments")
    model.add_argument("--queries", type=_count(1), default=10, help="questions before the result (default: %(default)s)")
    model.add_argument("--inference", choices=("paper", "bayes"), default="bayes", help="default: %(default)s")
    model.add_argument(
        "--mistake-rate", type=float, default=0.05, help="how often people are taken to err (default: %(default)s)"
    )
    model.add_argument("--seed", type=_count(0), help="of every session (default: each has its own)")

    server = parser.add_argument_group("the server")
    server.add_argument("--host", default="127.0.0.1", help="default: %(default)s, which only this machine reaches")
    server.add_argument("--port", type=_count(0), default=7860, help="default: %(default)s; 0 takes a free one")
    password = server.add_mutually_exclusive_group()
    password.add_argument(
        "--auth",
        metavar="USER:PASSWORD",
        help="ask for a name and a password of at least 12 characters; others on this machine see it in the list of processes",
    )
    password.add_argument(
        "--auth-file", type=Path, metavar="FILE", help="read them from a file (default: from SB3_POEM_AUTH, if that is set)"
    )
    server.add_argument("--token", action="store_true", help="let in only who has the link with the token, which is printed")
    server.add_argument("--allow-host", nargs="+", metavar="NAME", default=[], help="further names of this server")
    server.add_argument(
        "--max-sessions", type=_count(1), default=16, help="people who may be at work at once (default: %(default)s)"
    )
    server.add_argument("--workers", type=_count(1), default=2, help="processes that render (default: %(default)s)")
    _add_store_argument(server)

    commands = parser.add_subparsers(dest="label_command", metavar="{export,replay}")
    export = commands.add_parser("export", help="write all answers as a data set", description="Write all answers.")
    _add_store_argument(export, argparse.SUPPRESS)
    export.add_argument("--out", type=Path, nargs="+", required=True, metavar="FILE", help="ends in .jsonl or .parquet")
    export.add_argument("--trajectories", action="store_true", help="with observations, actions and reward features")
    export.add_argument("--undone", action="store_true", help="with answers that were taken back")
    replay = commands.add_parser(
        "replay",
        help="feed recorded answers to another model or rule",
        description="Feed the recorded answers to a model and a rule, and say how well these would have foretold them.",
    )
    # Without defaults of their own: what was given before the subcommand would be overwritten by these.
    own: dict[str, Any] = {"default": argparse.SUPPRESS}
    _add_store_argument(replay, **own)
    replay.add_argument(
        "--model", **own, help="a model's .zip, a pretrained folder, or a shipped model (default: each session's own)"
    )
    replay.add_argument("--inference", choices=("paper", "bayes"), **own, help="default: bayes")
    replay.add_argument("--mistake-rate", type=float, **own, help="default: 0.05")
    replay.add_argument("--seed", type=_count(0), **own, help="of the inference (default: 0)")
    replay.add_argument("--json", type=Path, metavar="FILE", help="write what was foretold, and the latents after each answer")


def _add_store_argument(parser: argparse._ActionsContainer, default: Any = DEFAULT_STORE) -> None:
    parser.add_argument(
        "--store",
        type=Path,
        default=default,
        metavar="FOLDER",
        help=f"where answers and videos are (default: {DEFAULT_STORE})",
    )


def build_parser() -> argparse.ArgumentParser:
    """The parser of ``sb3-poem``; the zoo commands hand their own arguments on to rl_zoo3."""
    parser = argparse.ArgumentParser(
        prog="sb3-poem",
        description="Meta-train agents on families of tasks, and adapt them to hidden tasks from preferences alone.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="{train,enjoy,adapt,label,benchmark}")
    for name, summary in ZOO_COMMANDS.items():
        commands.add_parser(name, help=summary, add_help=False)
    adapt = commands.add_parser(
        "adapt",
        help="adapt a trained agent to unseen tasks by preference queries",
        description="Adapt a trained agent to unseen tasks by preference queries, and print what it earns after each.",
    )
    _add_adapt_arguments(adapt)
    label = commands.add_parser(
        "label",
        help="open the page on which a person answers; export and replay their answers",
        description="Open a web page on which people teach a trained agent their task by comparing videos.",
    )
    _add_label_arguments(label)
    add_benchmark(commands, _count)
    return parser


def offscreen_backend() -> str | None:
    """What MuJoCo could draw with where there is no display: ``"egl"``, ``"osmesa"``, or None."""
    from ctypes.util import find_library

    backends = (("egl", "EGL"), ("osmesa", "OSMesa"))
    return next((backend for backend, library in backends if find_library(library)), None)


def use_offscreen_rendering() -> None:
    """Where there is no display, let MuJoCo draw off screen, unless the user chose. Call before importing it."""
    if not has_display() and "MUJOCO_GL" not in os.environ:
        backend = offscreen_backend()
        if backend is not None:
            os.environ["MUJOCO_GL"] = backend


def can_draw() -> bool:
    """Whether videos can be made here, as far as can be told without trying."""
    return has_display() or offscreen_backend() is not None


def _run(arguments: argparse.Namespace, others: list[str]) -> int:
    from rich.console import Console

    use_offscreen_rendering()
    # PyTorch and its company take seconds.
    loading = Console(stderr=True).status("Loading")
    if arguments.command in ZOO_COMMANDS:
        with loading:
            from sb3_poem.cli.zoo import run_zoo
        run_zoo(arguments.command, others)
    elif arguments.command == "label":
        with loading:
            from sb3_poem.cli.label import run_label
        run_label(arguments)
    elif arguments.command == "benchmark":
        with loading:
            from sb3_poem.cli.benchmark import run_benchmark
        return run_benchmark(arguments)
    else:
        with loading:
            from sb3_poem.cli.adapt import run_adapt
        run_adapt(arguments)
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run ``sb3-poem``.

    :param argv: the arguments (default: those of this process)
    :return: the exit status
    """
    if sys.stdin is None:  # it was closed, and its end is all that there is to read
        sys.stdin = open(os.devnull)  # noqa: SIM115
    parser = build_parser()
    arguments, others = parser.parse_known_args(argv)
    if others and arguments.command not in ZOO_COMMANDS:
        parser.error(f"unrecognized arguments: {' '.join(others)}")
    try:
        return _run(arguments, others)
    except KeyboardInterrupt as stop:
        print(str(stop) or "Interrupted.", file=sys.stderr)
        return 130
    except (ValueError, TypeError, OSError, gymnasium.error.Error) as error:
        # The library says in these what the user gave and what would be right; a developer wants the place as well.
        if os.environ.get("SB3_POEM_TRACEBACK"):
            raise
        print(f"sb3-poem {arguments.command}: error: {error}", file=sys.stderr)
        print("(SB3_POEM_TRACEBACK=1 shows where it was raised)", file=sys.stderr)
        return 1
