"""The arguments of ``sb3-poem benchmark``. Nothing heavy is imported here."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sb3_poem.benchmark.suites import SUITES

Count = Callable[[int], Any]

EXAMPLES = """\
examples:
  sb3-poem benchmark run --suite smoke
  sb3-poem benchmark run --suite table3 --families HalfCheetahVel --models pretrained --list
  sb3-poem benchmark run --suite shipped --families HalfCheetahVel --export pretrained
  sb3-poem benchmark report --suite smoke --out results
"""


def add_benchmark(commands: Any, count: Count) -> None:
    """Add the command and its two parts.

    :param commands: What ``add_subparsers`` gave
    :param count: gives the type of a whole number of at least so much
    """
    parser = commands.add_parser(
        "benchmark",
        help="run the paper's comparisons and ablations, and report them",
        description="Run suites of comparisons into a store of results, and make tables and figures of it.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parts = parser.add_subparsers(dest="part", required=True, metavar="{run,report}")
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
    _add_run_arguments(run, count)
    _add_report_arguments(report, count)


def _add_store(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--store",
        type=Path,
        default=Path("benchmark.sqlite"),
        metavar="FILE",
        help="results (default: %(default)s)",
    )


def _add_run_arguments(parser: argparse.ArgumentParser, count: Count) -> None:
    what = parser.add_argument_group("what to run")
    what.add_argument("--suite", choices=SUITES, required=True)
    what.add_argument(
        "--families",
        nargs="+",
        metavar="FAMILY",
        help="such as HalfCheetahVel, or ids (default: the suite's)",
    )
    what.add_argument(
        "--methods", nargs="+", metavar="METHOD", help="only these (default: all of the suite)"
    )
    what.add_argument("--seeds", type=count(1), default=3, help="how many (default: %(default)s)")
    what.add_argument("--first-seed", type=count(0), default=0, help="default: %(default)s")
    what.add_argument(
        "--gym-packages",
        nargs="+",
        metavar="MODULE",
        default=[],
        help="modules that register environments",
    )
    what.add_argument(
        "--list", action="store_true", help="only show the plan, and what must be trained for it"
    )

    models = parser.add_argument_group("models")
    models.add_argument(
        "--runs",
        default="logs/benchmark",
        metavar="FOLDER",
        help="trainings and checkpoints (default: %(default)s)",
    )
    models.add_argument(
        "--models",
        nargs="+",
        default=[],
        metavar="FOLDER",
        help="take trained models: <FOLDER>/<Family>/<variant>/seed<seed>[.zip], or <FOLDER>/<Family> as in pretrained/",
    )
    models.add_argument(
        "--model",
        nargs="+",
        default=[],
        metavar="FAMILY:VARIANT:SEED=PATH",
        help="take this trained model: a .zip, a checkpoint, or a folder with one or with a pretrained model",
    )

    models.add_argument(
        "--export",
        type=Path,
        metavar="FOLDER",
        help="with --suite shipped: write the first seed's models to <FOLDER>/<Family>, as in pretrained/",
    )

    budget = parser.add_argument_group("budget, which every record notes")
    budget.add_argument(
        "--tasks", type=count(1), help="test tasks (default: the suite's, 30 but for smoke)"
    )
    budget.add_argument(
        "--episodes",
        type=count(1),
        help="per task and measurement (default: the suite's, 10 but for smoke)",
    )
    budget.add_argument(
        "--timesteps", type=count(1), help="of every training (default: zoo_configs/)"
    )
    budget.add_argument(
        "--params",
        nargs="+",
        default=[],
        metavar="KEY:VALUE",
        help="hyperparameters of every training",
    )
    budget.add_argument(
        "--snapshots",
        type=count(1),
        metavar="N",
        help="measure after every Nth part of a training; 1: at its end only",
    )

    where = parser.add_argument_group("where to run")
    _add_store(where)  # type: ignore[arg-type]
    where.add_argument("--device", default="cpu", help="PyTorch device (default: %(default)s)")
    where.add_argument(
        "--num-threads", type=count(1), default=1, help="of PyTorch (default: %(default)s)"
    )
    where.add_argument(
        "--backend", choices=("local", "ray"), default="local", help="default: %(default)s"
    )
    where.add_argument("--address", help="of a Ray cluster (default: one on this machine)")
    where.add_argument(
        "--cpus-per-trial",
        type=float,
        default=1.0,
        help="with --backend ray (default: %(default)s)",
    )
    where.add_argument(
        "--gpus-per-trial",
        type=float,
        default=0.0,
        help="with --backend ray (default: %(default)s)",
    )
    where.add_argument(
        "--max-failures",
        type=count(0),
        default=3,
        help="retries of a trial with --backend ray (default: %(default)s)",
    )


def _add_report_arguments(parser: argparse.ArgumentParser, count: Count) -> None:
    parser.add_argument(
        "--suite", nargs="+", choices=SUITES, help="default: all of which the store holds cells"
    )
    parser.add_argument(
        "--families", nargs="+", metavar="FAMILY", help="default: all that the store holds"
    )
    parser.add_argument(
        "--seeds",
        nargs="+",
        type=count(0),
        metavar="SEED",
        help="default: all that the store holds",
    )
    parser.add_argument(
        "--format",
        choices=("md", "latex", "csv", "json"),
        default="md",
        help="default: %(default)s",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FOLDER",
        help="write tables, and figures as PNG and PDF (default: print)",
    )
    _add_store(parser)
