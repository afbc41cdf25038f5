"""The command line, ``sb3-poem``: train, enjoy, record-video, adapt, models, label and benchmark.

What a command needs is imported when it runs.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import gymnasium

from poem_envs.headless import can_draw, choose_headless_backend
from sb3_poem.cli.arguments import COMMANDS, OUR_ALGORITHMS, build_parser

__all__ = ["COMMANDS", "build_parser", "main"]
TRAIN_EXAMPLE = "example: sb3-poem train --env poem/PointGoal-v0 -P"
# Where the function ``run_<command>`` is, if not in the module of the command's name.
MODULES = {"enjoy": "show", "record-video": "show"}


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``sb3-poem`` with these arguments or the process's own; returns the exit status."""
    if sys.stdin is None:  # it was closed, and its end is all that there is to read
        sys.stdin = open(os.devnull)  # noqa: SIM115
    parser = build_parser()
    if "_ARGCOMPLETE" in os.environ:  # a shell asks how the line may go on
        import argcomplete

        argcomplete.autocomplete(parser)
    given = list(sys.argv[1:] if argv is None else argv)
    arguments = parser.parse_args(given[:1] if _is_zoo(given) else given)
    arguments.given = given
    try:
        return _run(arguments)
    except KeyboardInterrupt as stop:
        print(str(stop) or "Interrupted.", file=sys.stderr)
        return 130
    except (ValueError, TypeError, OSError, EOFError, ImportError, gymnasium.error.Error) as error:
        # These say what the user gave and what would be right; a developer wants the place, too.
        if os.environ.get("SB3_POEM_TRACEBACK"):
            raise
        print(f"sb3-poem {arguments.command}: error: {error}", file=sys.stderr)
        print("(SB3_POEM_TRACEBACK=1 shows where it was raised)", file=sys.stderr)
        return 1


def _is_zoo(given: Sequence[str]) -> bool:
    """Whether the command is rl_zoo3's, which reads its own arguments."""
    if given[:1] != ["enjoy"]:
        return given[:1] == ["train"]
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--algo", default=OUR_ALGORITHMS[0])
    return parser.parse_known_args(given)[0].algo not in OUR_ALGORITHMS


def _run(arguments: argparse.Namespace) -> int:
    from rich.console import Console

    if can_draw():
        choose_headless_backend()  # before anything imports MuJoCo
    command, is_zoo = arguments.command, _is_zoo(arguments.given)
    name = "zoo" if is_zoo else MODULES.get(command, command)
    # PyTorch and its company take seconds.
    with Console(stderr=True).status("Loading"):
        module: Any = import_module(f"sb3_poem.cli.{name}")
    if not is_zoo:
        return getattr(module, f"run_{command.replace('-', '_')}")(arguments) or 0
    given = arguments.given[1:]
    try:
        module.run_zoo(command, given)
    finally:
        if command == "train" and {"-h", "--help"} & set(given):
            print(f"\n{TRAIN_EXAMPLE}")
    return 0
