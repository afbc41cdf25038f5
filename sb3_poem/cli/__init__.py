"""The command line, ``sb3-poem``: train, enjoy, record-video, adapt, models, label and benchmark.

This file only reads the command; what a command needs is imported when it runs, so that ``sb3-poem
--help`` is immediate.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium

from poem_envs.headless import can_draw, choose_headless_backend
from sb3_poem import __version__
from sb3_poem.cli.benchmark_arguments import add_benchmark

OUR_ALGORITHMS = ("poem_sac", "pearl_sac")
EXAMPLES = """\
examples:
  sb3-poem models
  sb3-poem adapt --model HalfCheetahVel --oracle return
  sb3-poem adapt --model HalfCheetahVel --oracle human
  sb3-poem record-video --model HalfCheetahVel --out vel.mp4
  sb3-poem train --env poem/HalfCheetahVel-v0 --eval-freq 50000 -P
  sb3-poem label
"""
TRAIN_EXAMPLE = "example: sb3-poem train --env poem/PointGoal-v0 -P"
DEFAULT_STORE = Path("label_data")
COMMANDS = ("train", "enjoy", "record-video", "adapt", "models", "label", "benchmark")
# Where the function ``run_<command>`` is, if not in the module of the command's name.
MODULES = {"enjoy": "show", "record-video": "show"}


def _count(minimum: int) -> type[int]:
    def count(text: str) -> int:
        value = int(text)
        if value < minimum:
            raise argparse.ArgumentTypeError(f"must be at least {minimum}, got {value}")
        return value

    count.__name__ = "whole number"
    return count  # type: ignore[return-value]


def _complete_model(prefix: str, **_: Any) -> list[str]:
    """Shipped models, and what is on the disk."""
    from argcomplete.completers import FilesCompleter

    from sb3_poem.resources import pretrained_names

    return [*pretrained_names(), *FilesCompleter()(prefix)]


def _complete_env(**_: Any) -> list[str]:
    return [name for name in gymnasium.registry if name.startswith("poem/")]


def _add_subject_arguments(
    model: argparse._ActionsContainer, model_help: str, env_help: str, required: bool = False
) -> None:
    for flag, help_text, complete, needed in (
        ("--model", model_help, _complete_model, required),
        ("--env", env_help, _complete_env, False),
    ):
        action: Any = model.add_argument(flag, help=help_text, required=needed)
        action.completer = complete
    model.add_argument(
        "--env-kwargs",
        nargs="+",
        metavar="KEY:VALUE",
        default=[],
        help="arguments of the environment, over those that the model was trained with",
    )
    model.add_argument(
        "--gym-packages",
        nargs="+",
        metavar="MODULE",
        default=[],
        help="modules that register environments",
    )
    model.add_argument("--device", default="cpu", help="PyTorch device (default: %(default)s)")
    # Small batches: more threads would mostly wait for one another, and for those that simulate.
    model.add_argument(
        "--num-threads", type=_count(1), default=1, help="of PyTorch (default: %(default)s)"
    )


def _add_show_arguments(parser: argparse.ArgumentParser) -> None:
    """Those of ``enjoy`` and ``record-video``: a policy, and the task on which it is shown."""
    model = parser.add_argument_group("what to show")
    _add_subject_arguments(
        model,
        "a model's .zip, a pretrained folder, a shipped model's name, or a policy that adapt --save wrote",
        "environment id (default: the model's); without --model: the last run of it in --folder",
    )
    model.add_argument(
        "--algo", default=OUR_ALGORITHMS[0], help="of that run (default: %(default)s)"
    )
    model.add_argument("-f", "--folder", default="logs", help="of the runs (default: %(default)s)")
    model.add_argument(
        "--exp-id", type=_count(0), default=0, help="number of that run (default: the last one)"
    )

    policy = parser.add_argument_group("the policy, which is adapted to a hidden task first")
    policy.add_argument(
        "--queries",
        type=_count(0),
        default=10,
        help="questions, answered by the true return (default: %(default)s)",
    )
    policy.add_argument(
        "--known-task", action="store_true", help="instead the best of many policies for the task"
    )
    policy.add_argument(
        "--task",
        type=float,
        nargs="+",
        metavar="X",
        help="the task, its numbers one by one (default: drawn)",
    )
    policy.add_argument(
        "--seed", type=_count(0), default=0, help="of the task and of everything else (default: 0)"
    )
    policy.add_argument(
        "--episodes",
        type=_count(1),
        default=10,
        help="to show, and to measure returns by (default: %(default)s)",
    )


def _add_adapt_arguments(parser: argparse.ArgumentParser) -> None:
    model = parser.add_argument_group("what to adapt")
    _add_subject_arguments(
        model,
        "a model's .zip, a pretrained folder, or the name of a shipped model",
        "environment id (default: the one that the model was trained on)",
        required=True,
    )

    questions = parser.add_argument_group("the questions and who answers them")
    questions.add_argument(
        "--oracle", choices=("return", "boltzmann", "mistake", "human"), default="return"
    )
    questions.add_argument(
        "--beta",
        type=float,
        help="inverse temperature of --oracle boltzmann (default: the paper's)",
    )
    questions.add_argument(
        "--mistake-rate", type=float, default=0.2, help="of --oracle mistake (default: %(default)s)"
    )
    questions.add_argument(
        "--queries", type=_count(1), default=10, help="questions per task (default: %(default)s)"
    )
    questions.add_argument(
        "--inference", choices=("paper", "bayes"), default="bayes", help="default: %(default)s"
    )
    rules = ("worst-case", "information-gain", "random")
    questions.add_argument(
        "--query-rule",
        choices=rules,
        help="how questions are chosen (default: the inference rule's own)",
    )
    questions.add_argument(
        "--candidates",
        choices=("prior", "aggregate"),
        help="default: prior; for bayes aggregate where the training tasks are far from it",
    )
    questions.add_argument(
        "--n-candidates",
        type=_count(2),
        metavar="N",
        help="candidate latents (default: 400 for bayes, 100 for paper)",
    )

    tasks = parser.add_argument_group("test tasks")
    tasks.add_argument(
        "--tasks", type=_count(1), help="how many, drawn anew (default: 30; 1 with --oracle human)"
    )
    tasks.add_argument(
        "--task",
        type=float,
        nargs="+",
        metavar="X",
        help="this one task instead, its numbers one by one",
    )
    tasks.add_argument(
        "--episodes",
        type=_count(1),
        default=10,
        help="per task and evaluation (default: %(default)s)",
    )
    tasks.add_argument(
        "--seed",
        type=_count(0),
        default=0,
        help="of the test tasks and of everything else (default: 0)",
    )
    tasks.add_argument(
        "--record",
        type=_count(0),
        nargs="+",
        metavar="K",
        help="measure after so many answers (default: each)",
    )

    output = parser.add_argument_group("output")
    output.add_argument(
        "--store",
        type=Path,
        metavar="FOLDER",
        help=f"where the answers of --oracle human are kept, as those of the page (default: {DEFAULT_STORE})",
    )
    output.add_argument(
        "--resume",
        action="store_true",
        help="go on with the answers that the same command has in --store, if any",
    )
    output.add_argument(
        "--save",
        type=Path,
        metavar="FILE",
        help="write the policy of the one task that was adapted (.safetensors)",
    )
    output.add_argument(
        "--json",
        type=Path,
        metavar="FILE",
        help="write every task's returns, with versions and command",
    )
    output.add_argument(
        "--plot",
        type=Path,
        metavar="FILE",
        help="write the return against the queries (PNG, PDF, SVG)",
    )
    output.add_argument(
        "--video",
        type=Path,
        metavar="FILE",
        help="write one task before and after side by side (MP4, GIF)",
    )


def _add_label_arguments(parser: argparse.ArgumentParser) -> None:
    model = parser.add_argument_group("what is taught")
    model.add_argument(
        "--model",
        help="a pretrained folder, a folder of such, or the name of a shipped model (default: all that are shipped)",
    )
    model.add_argument(
        "--env", help="environment id (default: the one that the model was trained on)"
    )
    model.add_argument(
        "--env-kwargs",
        nargs="+",
        metavar="KEY:VALUE",
        default=[],
        help="arguments of the environment",
    )
    model.add_argument(
        "--gym-packages",
        nargs="+",
        metavar="MODULE",
        default=[],
        help="modules that register environments",
    )
    model.add_argument(
        "--queries",
        type=_count(1),
        default=10,
        help="questions before the result (default: %(default)s)",
    )
    model.add_argument(
        "--inference", choices=("paper", "bayes"), default="bayes", help="default: %(default)s"
    )
    model.add_argument(
        "--mistake-rate",
        type=float,
        default=0.05,
        help="how often people are taken to err (default: %(default)s)",
    )
    model.add_argument(
        "--seed", type=_count(0), help="of every session (default: each has its own)"
    )

    server = parser.add_argument_group("the server")
    server.add_argument(
        "--host", default="127.0.0.1", help="default: %(default)s, which only this machine reaches"
    )
    server.add_argument(
        "--port", type=_count(0), default=7860, help="default: %(default)s; 0 takes a free one"
    )
    password = server.add_mutually_exclusive_group()
    password.add_argument(
        "--auth",
        metavar="USER:PASSWORD",
        help="ask for a name and a password of at least 12 characters; others on this machine see it in the list of processes",
    )
    password.add_argument(
        "--auth-file",
        type=Path,
        metavar="FILE",
        help="read them from a file (default: from SB3_POEM_AUTH, if that is set)",
    )
    server.add_argument(
        "--token",
        action="store_true",
        help="let in only who has the link with the token, which is printed",
    )
    server.add_argument(
        "--allow-host", nargs="+", metavar="NAME", default=[], help="further names of this server"
    )
    server.add_argument(
        "--max-sessions",
        type=_count(1),
        default=16,
        help="people who may be at work at once (default: %(default)s)",
    )
    server.add_argument(
        "--workers", type=_count(1), default=2, help="processes that render (default: %(default)s)"
    )
    _add_store_argument(server)

    commands = parser.add_subparsers(dest="label_command", metavar="{export,replay}")
    export = _add_command(
        commands,
        "export",
        "write all answers as a data set",
        "Write all answers.",
        "sb3-poem label export --out answers.jsonl answers.parquet",
    )
    _add_store_argument(export, argparse.SUPPRESS)
    export.add_argument(
        "--out",
        type=Path,
        nargs="+",
        required=True,
        metavar="FILE",
        help="ends in .jsonl or .parquet",
    )
    export.add_argument(
        "--trajectories", action="store_true", help="with observations, actions and reward features"
    )
    export.add_argument("--undone", action="store_true", help="with answers that were taken back")
    replay = _add_command(
        commands,
        "replay",
        "feed recorded answers to another model or rule",
        "Feed the recorded answers to a model and a rule, and say how well these would have foretold them.",
        "sb3-poem label replay --inference paper --json replay.json",
    )
    # Without defaults of their own: what was given before the subcommand would be overwritten by
    # these.
    own: dict[str, Any] = {"default": argparse.SUPPRESS}
    _add_store_argument(replay, **own)
    replay.add_argument(
        "--model",
        **own,
        help="a model's .zip, a pretrained folder, or a shipped model (default: each session's own)",
    )
    replay.add_argument("--inference", choices=("paper", "bayes"), **own, help="default: bayes")
    replay.add_argument("--mistake-rate", type=float, **own, help="default: 0.05")
    replay.add_argument("--seed", type=_count(0), **own, help="of the inference (default: 0)")
    replay.add_argument(
        "--json",
        type=Path,
        metavar="FILE",
        help="write what was foretold, and the latents after each answer",
    )


def _add_store_argument(parser: argparse._ActionsContainer, default: Any = DEFAULT_STORE) -> None:
    parser.add_argument(
        "--store",
        type=Path,
        default=default,
        metavar="FOLDER",
        help=f"where answers and videos are (default: {DEFAULT_STORE})",
    )


def _add_command(
    commands: Any, name: str, summary: str, description: str, example: str
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(
        name, help=summary, description=description, epilog=f"example: {example}"
    )
    return parser


def build_parser() -> argparse.ArgumentParser:
    """The parser of ``sb3-poem``; the zoo commands hand their own arguments on to rl_zoo3."""
    parser = argparse.ArgumentParser(
        prog="sb3-poem",
        description="Meta-train agents on families of tasks, and adapt them to hidden tasks from preferences alone.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(
        dest="command", required=True, metavar="{" + ",".join(COMMANDS) + "}"
    )
    commands.add_parser(
        "train",
        help="meta-train an agent (rl_zoo3's train, with poem_sac and pearl_sac)",
        add_help=False,
    )
    enjoy = _add_command(
        commands,
        "enjoy",
        "watch a trained agent after adaptation",
        "Adapt a trained agent to a task, and show it in a window. With another --algo this is rl_zoo3's enjoy.",
        "sb3-poem enjoy --model HalfCheetahVel",
    )
    _add_show_arguments(enjoy)
    enjoy.add_argument(
        "-n", "--n-timesteps", type=_count(1), help="show so many steps, in whole episodes"
    )
    enjoy.add_argument(
        "--no-render", action="store_true", help="without a window: only say what the episodes earn"
    )
    record = _add_command(
        commands,
        "record-video",
        "film a trained agent before and after adaptation",
        "Adapt a trained agent to a task, and film it before and after side by side from the same "
        "start. Where there is only one policy (--known-task, --queries 0, or a policy as --model), "
        "film that.",
        "sb3-poem record-video --model HalfCheetahVel --out vel.mp4",
    )
    _add_show_arguments(record)
    record.add_argument(
        "--out", type=Path, required=True, metavar="FILE", help="the video (.mp4 or .gif)"
    )
    adapt = _add_command(
        commands,
        "adapt",
        "adapt a trained agent to unseen tasks by preference queries",
        "Adapt a trained agent to unseen tasks by preference queries, and print what it earns after each.",
        "sb3-poem adapt --model HalfCheetahVel --oracle human",
    )
    _add_adapt_arguments(adapt)
    _add_command(
        commands,
        "models",
        "list the trained models that ship",
        "List the trained models that ship.",
        "sb3-poem models",
    )
    label = _add_command(
        commands,
        "label",
        "open the page on which a person answers; export and replay their answers",
        "Open a web page on which people teach a trained agent their task by comparing videos.",
        "sb3-poem label --model HalfCheetahVel --port 8000",
    )
    _add_label_arguments(label)
    add_benchmark(commands, _count)
    return parser


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


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``sb3-poem``.

    :param argv: the arguments (default: those of this process)
    :return: the exit status
    """
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
    except (ValueError, TypeError, OSError, EOFError, gymnasium.error.Error) as error:
        # The library says in these what the user gave and what would be right; a developer wants
        # the place as well.
        if os.environ.get("SB3_POEM_TRACEBACK"):
            raise
        print(f"sb3-poem {arguments.command}: error: {error}", file=sys.stderr)
        print("(SB3_POEM_TRACEBACK=1 shows where it was raised)", file=sys.stderr)
        return 1
