"""The command line, ``sb3-poem``. What a command needs is imported when it runs."""

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
    is_zoo = _is_zoo(given)
    arguments = parser.parse_args(given[:1] if is_zoo else given)
    arguments.given = given
    try:
        return _run(arguments, is_zoo)
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


def _run(arguments: argparse.Namespace, is_zoo: bool) -> int:
    from rich.console import Console

    if can_draw():
        choose_headless_backend()  # before anything imports MuJoCo
    command = arguments.command
    name = "zoo" if is_zoo else MODULES.get(command, command)
    # PyTorch and its company take seconds.
    with Console(stderr=True).status("Loading"):
        module: Any = import_module(f"sb3_poem.cli.{name}")
    if is_zoo:
        module.run_zoo(command, arguments.given[1:])
        return 0
    return getattr(module, f"run_{command.replace('-', '_')}")(arguments) or 0
