"""The arguments of ``sb3-poem``. Nothing heavy is imported, so that ``--help`` is immediate."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium

from sb3_poem import __version__
from sb3_poem.benchmark.suites import SUITES

OUR_ALGORITHMS = ("poem_sac", "pearl_sac")
COMMANDS = ("train", "enjoy", "record-video", "adapt", "models", "label", "benchmark")
DEFAULT_STORE = Path("label_data")
INFERENCES = ("paper", "bayes")
QUESTIONS = ("pair", "graded", "best-of-four")
EXAMPLES = """\
examples:
  sb3-poem models
  sb3-poem adapt --model HalfCheetahVel --oracle return
  sb3-poem adapt --model HalfCheetahVel --oracle human
  sb3-poem record-video --model HalfCheetahVel --out vel.mp4
  sb3-poem train --env poem/HalfCheetahVel-v0 --eval-freq 50000 -P
  sb3-poem label
"""

Group = argparse._ActionsContainer


def build_parser() -> argparse.ArgumentParser:
    """The parser of ``sb3-poem``; ``train`` hands its arguments on to rl_zoo3."""
    parser = argparse.ArgumentParser(
        prog="sb3-poem",
        description="Meta-train agents on families of tasks, and adapt them to hidden tasks from "
        "preferences alone.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    known = "{" + ",".join(COMMANDS) + "}"
    commands = parser.add_subparsers(dest="command", required=True, metavar=known)
    train = "meta-train an agent (rl_zoo3's train, with poem_sac and pearl_sac)"
    commands.add_parser("train", help=train, add_help=False)
    told = "watch a trained agent after adaptation (with another --algo: rl_zoo3's enjoy)"
    enjoy = _add_command(commands, "enjoy --model HalfCheetahVel", told)
    _add_show_arguments(enjoy)
    _option(enjoy, "-n --n-timesteps", "show so many steps, in whole episodes", _count(1))
    _switch(enjoy, "--no-render", "without a window: only say what the episodes earn")
    record = _add_command(
        commands,
        "record-video --model HalfCheetahVel --out vel.mp4",
        "film a trained agent before and after adaptation, side by side",
        "Film a trained agent before and after adaptation to a task, side by side from the same "
        "start; or the one policy of --known-task, of --queries 0, or that --model holds.",
    )
    _add_show_arguments(record)
    _file(record, "--out", "the video (.mp4 or .gif)", required=True)
    told = "adapt a trained agent to unseen tasks by preference queries, and say what it earns"
    adapt = _add_command(commands, "adapt --model HalfCheetahVel --oracle human", told)
    _add_adapt_arguments(adapt)
    _add_command(commands, "models", "list the trained models that ship")
    told = "open the page on which people answer; export and replay their answers"
    _add_label_arguments(_add_command(commands, "label --model HalfCheetahVel --port 8000", told))
    _add_benchmark(commands)
    return parser


def _add_command(
    commands: Any, example: str, summary: str, description: str | None = None
) -> argparse.ArgumentParser:
    """Add the command that the example begins with."""
    name, _, arguments = example.partition(" ")
    told = description or f"{summary[0].upper()}{summary[1:]}."
    parser: argparse.ArgumentParser = commands.add_parser(name, help=summary, description=told)
    parser.epilog = f"example: {parser.prog} {arguments}"
    return parser


def _option(
    group: Group, flags: str, told: str, kind: Any = None, default: Any = None, **how: Any
) -> Any:
    """Add an option that takes values; its default, if it has one, is told with the rest."""
    if default not in (None, [], argparse.SUPPRESS):
        told = f"{told} (default: %(default)s)" if told else "default: %(default)s"
    return group.add_argument(*flags.split(), help=told, type=kind, default=default, **how)


def _switch(group: Group, flag: str, told: str) -> None:
    group.add_argument(flag, help=told, action="store_true")


def _file(group: Group, flag: str, told: str, metavar: str = "FILE", **how: Any) -> None:
    _option(group, flag, told, Path, metavar=metavar, **how)


def _several(group: Group, flag: str, told: str, metavar: str) -> None:
    _option(group, flag, told, nargs="+", default=[], metavar=metavar)


def _count(minimum: int) -> Callable[[str], int]:
    def count(text: str) -> int:
        value = int(text)
        if value < minimum:
            raise argparse.ArgumentTypeError(f"must be at least {minimum}, got {value}")
        if value >= 2**63:  # which no database keeps
            raise argparse.ArgumentTypeError(f"must be less than 2^63, got {value}")
        return value

    count.__name__ = "whole number"
    return count


def _rate(text: str) -> float:
    if not 0.0 <= (value := float(text)) <= 0.5:
        raise argparse.ArgumentTypeError(f"must be from 0 to 0.5, got {text}")
    return value


_rate.__name__ = "number"


def _add_environment(group: Group, default: str) -> None:
    env = _option(group, "--env", f"environment id (default: {default})")
    env.completer = _complete_env
    told = "arguments of the environment, over those that the model was trained with"
    _several(group, "--env-kwargs", told, "KEY:VALUE")
    _several(group, "--gym-packages", "modules that register environments", "MODULE")


def _add_torch(group: Group) -> None:
    _option(group, "--device", "PyTorch device", default="cpu")
    # Small batches: more threads would mostly wait for one another, and for those that simulate.
    _option(group, "--num-threads", "of PyTorch", _count(1), 1)


def _add_model(group: Group, told: str, required: bool = False) -> None:
    told = f"a model's .zip, a pretrained folder, a shipped model's name, user/name on {told}"
    _option(group, "--model", told, required=required).completer = _complete_model


def _complete_model(prefix: str, **_: Any) -> list[str]:
    """Shipped models, and what is on the disk."""
    from argcomplete.completers import FilesCompleter

    from sb3_poem.resources import pretrained_names

    return [*pretrained_names(), *FilesCompleter()(prefix)]


def _complete_env(**_: Any) -> list[str]:
    return [name for name in gymnasium.registry if name.startswith("poem/")]


def _add_show_arguments(parser: argparse.ArgumentParser) -> None:
    """Those of ``enjoy`` and ``record-video``: a policy, and the task on which it is shown."""
    model = parser.add_argument_group("what to show")
    _add_model(model, "the Hugging Face Hub, or a policy that adapt --save wrote")
    _add_environment(model, "the model's; without --model the last run of it in --folder is shown")
    _add_torch(model)
    _option(model, "--algo", "of that run", default=OUR_ALGORITHMS[0])
    _option(model, "-f --folder", "of the runs", default="logs")
    _option(model, "--exp-id", "number of that run; 0: the last one", _count(0), 0)

    policy = parser.add_argument_group("the policy, which is adapted to a hidden task first")
    _option(policy, "--queries", "questions, answered by the true return", _count(0), 10)
    _switch(policy, "--known-task", "instead the best of many policies for the task")
    _add_task(policy, "to show, and to measure returns by")


def _add_task(group: Group, episodes: str) -> None:
    told = "the task, its numbers one by one (default: drawn)"
    _option(group, "--task", told, float, nargs="+", metavar="X")
    _option(group, "--seed", "of tasks and of everything else", _count(0), 0)
    _option(group, "--episodes", episodes, _count(1), 10)


def _add_adapt_arguments(parser: argparse.ArgumentParser) -> None:
    model = parser.add_argument_group("what to adapt")
    _add_model(model, "the Hugging Face Hub", required=True)
    _add_environment(model, "the model's")
    _add_torch(model)

    questions = parser.add_argument_group("the questions and who answers them")
    oracles = ("return", "boltzmann", "mistake", "human")
    told = "a program that knows the task, and answers by the return, or errs; or you"
    _option(questions, "--oracle", told, default="return", choices=oracles)
    _option(questions, "--beta", "of --oracle boltzmann (default: the paper's)", float)
    _option(questions, "--mistake-rate", "of --oracle mistake (default: 0.2)", _rate)
    told = "left or right; graded: much better, too; or which of four is best (default: pair)"
    _option(questions, "--question", told, choices=QUESTIONS)
    told = "from what differences on an oracle says better and much better, as shares of the spread"
    thresholds: dict[str, Any] = {"nargs": 2, "metavar": ("BETTER", "MUCH")}
    told += " of returns (default: 0.1 0.7)"
    _option(questions, "--thresholds", told, float, **thresholds)
    _switch(questions, "--infer-noise", "infer how often answers err, not be told it (bayes)")
    _option(questions, "--queries", "questions per task", _count(1), 10)
    _option(questions, "--inference", "", default="bayes", choices=INFERENCES)
    rules = ("worst-case", "information-gain", "random")
    _option(questions, "--query-rule", "default: the inference rule's own", choices=rules)
    told = "default: prior; for bayes aggregate where the training tasks are far from it"
    _option(questions, "--candidates", told, choices=("prior", "aggregate"))
    told = "candidate latents (default: 400 for bayes, 100 for paper)"
    _option(questions, "--n-candidates", told, _count(2), metavar="N")

    tasks = parser.add_argument_group("test tasks")
    _option(tasks, "--tasks", "how many (default: 30; 1 with --oracle human)", _count(1))
    _add_task(tasks, "per task and evaluation")
    told = "measure after so many answers, and after the last one (default: after each)"
    _option(tasks, "--record", told, _count(0), nargs="+", metavar="K")

    output = parser.add_argument_group("output")
    told = f"where the answers of --oracle human are kept (default: {DEFAULT_STORE})"
    _file(output, "--store", told, "FOLDER")
    _switch(output, "--resume", "go on with the answers that the same command has in --store")
    _file(output, "--save", "write the policy of the one task that was adapted (.safetensors)")
    _file(output, "--json", "write every task's returns, with versions and command")
    _file(output, "--plot", "write the return against the queries (PNG, PDF, SVG)")
    _file(output, "--video", "write one task before and after side by side (MP4, GIF)")


def _add_label_arguments(parser: argparse.ArgumentParser) -> None:
    model = parser.add_argument_group("what is taught")
    told = "a pretrained folder or one of such, a shipped model's name, or user/name on the Hugging"
    _option(model, "--model", f"{told} Face Hub (default: all that are shipped)")
    _add_environment(model, "the model's")
    _option(model, "--queries", "questions before the result", _count(1), 10)
    _option(model, "--inference", "", default="bayes", choices=INFERENCES)
    told = "left or right; graded: how much better, too; or which of four is best (default: graded"
    _option(model, "--question", f"{told}; paper: pair)", choices=QUESTIONS)
    _option(model, "--mistake-rate", "of people (default: inferred)", _rate)
    _option(model, "--seed", "of every session (default: each has its own)", _count(0))
    _file(model, "--instructions", "text or Markdown that people read before the first question")

    server = parser.add_argument_group("the server")
    _option(server, "--host", "by default for this machine alone", default="127.0.0.1")
    _option(server, "--port", "0 takes a free one", _count(0), 7860)
    password = server.add_mutually_exclusive_group()
    told = "ask for a name and a password of at least 12 characters; others on this machine see it"
    _option(password, "--auth", f"{told} in the list of processes", metavar="USER:PASSWORD")
    _file(password, "--auth-file", "a file with them (default: SB3_POEM_AUTH, if that is set)")
    _switch(server, "--token", "let in only who has the link with the token, which is printed")
    _several(server, "--allow-host", "further names of this server", "NAME")
    _option(server, "--max-sessions", "people who may be at work at once", _count(1), 16)
    _option(server, "--workers", "processes that render", _count(1), 2)
    _file(server, "--store", "where answers and videos are", "FOLDER", default=DEFAULT_STORE)

    commands = parser.add_subparsers(dest="label_command", metavar="{export,replay}")
    # Of what the page has too, no defaults: they would overwrite what was given before the part.
    own: dict[str, Any] = {"default": argparse.SUPPRESS}
    example = "export --out answers.jsonl answers.parquet"
    export = _add_command(commands, example, "write all answers as a data set")
    _file(export, "--store", f"default: {DEFAULT_STORE}", "FOLDER", **own)
    told = "ends in .jsonl or .parquet; with --format minari a data set's name, as answers-v0"
    _file(export, "--out", told, nargs="+", required=True)
    told = "minari: a data set of episodes for each environment (default: --out's suffix)"
    _option(export, "--format", told, choices=("jsonl", "parquet", "minari"))
    told = "with observations, actions and reward features, which minari always has"
    _switch(export, "--trajectories", told)
    _switch(export, "--undone", "with answers that were taken back")
    told = "modules that register environments, for --format minari"
    _option(export, "--gym-packages", told, nargs="+", metavar="MODULE", **own)
    told = "feed recorded answers to a model and a rule, and say how well these foretell them"
    replay = _add_command(commands, "replay --inference paper --json replay.json", told)
    _file(replay, "--store", f"default: {DEFAULT_STORE}", "FOLDER", **own)
    told = "a model's .zip, a pretrained folder, or a shipped model (default: each session's own)"
    _option(replay, "--model", told, **own)
    _option(replay, "--inference", "default: bayes", choices=INFERENCES, **own)
    _option(replay, "--mistake-rate", "default: inferred", _rate, **own)
    _option(replay, "--seed", "of the inference (default: 0)", _count(0), **own)
    _file(replay, "--json", "write what was foretold, and the latents after each answer")


def _add_benchmark(commands: Any) -> None:
    told = "run the paper's comparisons and ablations, report them, and run cells again"
    parser = _add_command(commands, "benchmark run --suite smoke", told)
    parts = parser.add_subparsers(dest="part", required=True, metavar="{run,report,verify}")
    told = "train what is missing, adapt, evaluate; goes on where it was interrupted"
    _add_run_arguments(_add_command(parts, "run --suite smoke", told))
    told = "write the tables and figures of what the store holds"
    report = _add_command(parts, "report --suite smoke --out results", told)
    everything = "default: all that the store holds"
    _option(report, "--suite", everything, nargs="+", choices=SUITES)
    told = "default: with --suite all that the store holds, else each suite's own"
    _option(report, "--families", told, nargs="+", metavar="FAMILY")
    _option(report, "--seeds", everything, _count(0), nargs="+", metavar="SEED")
    _option(report, "--format", "", default="md", choices=("md", "latex", "csv", "json"))
    _file(report, "--out", "write tables, and figures as PNG and PDF (default: print)", "FOLDER")
    _add_results(report)
    verify = _add_command(
        parts,
        "verify --cell 1f0c9a --models pretrained",
        "run a finished cell again, and say what differs",
        "Run a finished cell again, and compare every number that the store holds of it, but for "
        "times. The exit status is 1 if anything differs.",
    )
    told = "its key, or the beginning of it (default: only list the store's cells)"
    _option(verify, "--cell", told, metavar="ID")
    _add_models(verify)
    _add_results(verify)


def _add_results(group: Group) -> None:
    _file(group, "--store", "results", default=Path("benchmark.sqlite"))


def _add_models(group: Group) -> None:
    _several(group, "--gym-packages", "modules that register environments", "MODULE")
    told = "trainings and checkpoints"
    _option(group, "--runs", told, default="logs/benchmark", metavar="FOLDER")
    told = "take trained models: <FOLDER>/<Family>/<variant>/seed<seed>[.zip], or <FOLDER>/<Family>"
    _several(group, "--models", f"{told} as in pretrained/", "FOLDER")
    told = "take this trained model, a file or a folder"
    _several(group, "--model", told, "FAMILY:VARIANT:SEED=PATH")


def _add_run_arguments(parser: argparse.ArgumentParser) -> None:
    what = parser.add_argument_group("what to run")
    _option(what, "--suite", "", choices=SUITES, required=True)
    told = "such as HalfCheetahVel, or ids (default: the suite's)"
    _option(what, "--families", told, nargs="+", metavar="FAMILY")
    _option(what, "--methods", "default: all of the suite", nargs="+", metavar="METHOD")
    _option(what, "--seeds", "how many", _count(1), 3)
    _option(what, "--first-seed", "", _count(0), 0)
    _switch(what, "--list", "only show the plan, and what must be trained for it")

    models = parser.add_argument_group("models")
    _add_models(models)
    told = "with --suite shipped: write the first seed's models to <FOLDER>/<Family>"
    _file(models, "--export", told, "FOLDER")

    budget = parser.add_argument_group("budget, which every record notes")
    _option(budget, "--tasks", "test tasks (default: the suite's)", _count(1))
    _option(budget, "--episodes", "per task and measurement (default: the suite's)", _count(1))
    _option(budget, "--timesteps", "of every training (default: zoo_configs/)", _count(1))
    _several(budget, "--params", "hyperparameters of every training", "KEY:VALUE")
    told = "measure after every Nth part of a training; 1: at its end only"
    _option(budget, "--snapshots", told, _count(1), metavar="N")

    where = parser.add_argument_group("where to run")
    _add_results(where)
    _add_torch(where)
    _option(where, "--backend", "", default="local", choices=("local", "ray"))
    _option(where, "--address", "of a Ray cluster (default: one on this machine)")
    _option(where, "--cpus-per-trial", "with --backend ray", float, 1.0)
    _option(where, "--gpus-per-trial", "with --backend ray", float, 0.0)
    _option(where, "--max-failures", "retries of a trial with --backend ray", _count(0), 3)
