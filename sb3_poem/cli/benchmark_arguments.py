"""The arguments of ``sb3-poem benchmark``. Nothing heavy is imported here."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sb3_poem.benchmark.suites import SUITES

Count = Callable[[int], Any]
DEFAULT = "default: %(default)s"

EXAMPLES = """\
examples:
  sb3-poem benchmark run --suite smoke
  sb3-poem benchmark run --suite table3 --families HalfCheetahVel --models pretrained --list
  sb3-poem benchmark run --suite shipped --families HalfCheetahVel --export pretrained
  sb3-poem benchmark report --suite smoke --out results
  sb3-poem benchmark verify --cell 1f0c9a
"""


def add_benchmark(commands: Any, count: Count) -> None:
    """Add the command; ``count`` gives the type of a whole number of at least so much."""
    parser = commands.add_parser(
        "benchmark",
        help="run the paper's comparisons and ablations, and report them",
        description="Run suites of comparisons into a store of results, make tables and figures of "
        "it, and run what it holds again.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parts = parser.add_subparsers(dest="part", required=True, metavar="{run,report,verify}")
    run = parts.add_parser(
        "run",
        help="train what is missing, adapt, evaluate; goes on where it was interrupted",
        epilog="example: sb3-poem benchmark run --suite smoke",
    )
    report = parts.add_parser(
        "report",
        help="write the tables and figures of what the store holds",
        epilog="example: sb3-poem benchmark report --suite smoke --out results",
    )
    verify = parts.add_parser(
        "verify",
        help="run a finished cell again, and say what differs",
        description="Run a finished cell again, and compare every number that the store holds of "
        "it, but for times: on the same kind of machine they are the same bit for bit. The exit "
        "status is 1 if anything differs.",
        epilog="example: sb3-poem benchmark verify --cell 1f0c9a --models pretrained",
    )
    _add_run_arguments(run, count)
    _add_report_arguments(report, count)
    told = "its key, or the beginning of it (default: only list the store's cells)"
    verify.add_argument("--cell", metavar="ID", help=told)
    _add_models(verify.add_argument)
    _add_store(verify.add_argument)


def _add_store(add: Any) -> None:
    default = Path("benchmark.sqlite")
    add("--store", type=Path, default=default, metavar="FILE", help=f"results ({DEFAULT})")


def _add_models(add: Any) -> None:
    several: dict[str, Any] = {"nargs": "+", "default": []}
    modules = "modules that register environments"
    add("--gym-packages", metavar="MODULE", help=modules, **several)
    runs = f"trainings and checkpoints ({DEFAULT})"
    add("--runs", default="logs/benchmark", metavar="FOLDER", help=runs)
    add(
        "--models",
        metavar="FOLDER",
        help="take trained models: <FOLDER>/<Family>/<variant>/seed<seed>[.zip], or "
        "<FOLDER>/<Family> as in pretrained/",
        **several,
    )
    add(
        "--model",
        metavar="FAMILY:VARIANT:SEED=PATH",
        help="take this trained model: a .zip, a checkpoint, or a folder with one or with a "
        "pretrained model",
        **several,
    )


def _add_run_arguments(parser: argparse.ArgumentParser, count: Count) -> None:
    several: dict[str, Any] = {"nargs": "+", "default": []}
    add = parser.add_argument_group("what to run").add_argument
    add("--suite", choices=SUITES, required=True)
    families = "such as HalfCheetahVel, or ids (default: the suite's)"
    add("--families", nargs="+", metavar="FAMILY", help=families)
    add("--methods", nargs="+", metavar="METHOD", help="only these (default: all of the suite)")
    add("--seeds", type=count(1), default=3, help=f"how many ({DEFAULT})")
    add("--first-seed", type=count(0), default=0, help=DEFAULT)
    add("--list", action="store_true", help="only show the plan, and what must be trained for it")

    add = parser.add_argument_group("models").add_argument
    _add_models(add)
    add(
        "--export",
        type=Path,
        metavar="FOLDER",
        help="with --suite shipped: write the first seed's models to <FOLDER>/<Family>, as in "
        "pretrained/",
    )

    add = parser.add_argument_group("budget, which every record notes").add_argument
    tasks = "test tasks (default: the suite's, 30 but for smoke)"
    episodes = "per task and measurement (default: the suite's, 10 but for smoke)"
    snapshots = "measure after every Nth part of a training; 1: at its end only"
    add("--tasks", type=count(1), help=tasks)
    add("--episodes", type=count(1), help=episodes)
    add("--timesteps", type=count(1), help="of every training (default: zoo_configs/)")
    add("--params", metavar="KEY:VALUE", help="hyperparameters of every training", **several)
    add("--snapshots", type=count(1), metavar="N", help=snapshots)

    add = parser.add_argument_group("where to run").add_argument
    _add_store(add)
    add("--device", default="cpu", help=f"PyTorch device ({DEFAULT})")
    add("--num-threads", type=count(1), default=1, help=f"of PyTorch ({DEFAULT})")
    add("--backend", choices=("local", "ray"), default="local", help=DEFAULT)
    add("--address", help="of a Ray cluster (default: one on this machine)")
    with_ray = f"with --backend ray ({DEFAULT})"
    add("--cpus-per-trial", type=float, default=1.0, help=with_ray)
    add("--gpus-per-trial", type=float, default=0.0, help=with_ray)
    add("--max-failures", type=count(0), default=3, help=f"retries of a trial {with_ray}")


def _add_report_arguments(parser: argparse.ArgumentParser, count: Count) -> None:
    add, everything = parser.add_argument, "default: all that the store holds"
    suites = "default: all of which the store holds cells"
    add("--suite", nargs="+", choices=SUITES, help=suites)
    add("--families", nargs="+", metavar="FAMILY", help=everything)
    add("--seeds", nargs="+", type=count(0), metavar="SEED", help=everything)
    add("--format", choices=("md", "latex", "csv", "json"), default="md", help=DEFAULT)
    out = "write tables, and figures as PNG and PDF (default: print)"
    add("--out", type=Path, metavar="FOLDER", help=out)
    _add_store(add)
