"""rl_zoo3's train and enjoy with this package's algorithms, environments and hyperparameters."""

import argparse
import re
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import gymnasium as gym
import yaml
from rl_zoo3 import ALGOS
from rl_zoo3 import enjoy as zoo_enjoy
from rl_zoo3 import train as zoo_train
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import StoreDict

from poem_envs.headless import has_display
from poem_envs.registration import ids_like
from sb3_poem.cli.experiment import TrainingInterrupted, make_experiment
from sb3_poem.cli.hyperparams import SAMPLERS, convert_params
from sb3_poem.cli.needs import check_device, import_packages
from sb3_poem.loading import ALGORITHMS
from sb3_poem.pearl_sac.saving import CHECKPOINT, check_archive, facts_of

# Those of our own that differ from rl_zoo3's; what the user gives comes later, and wins.
DEFAULTS = {
    "train": ["--algo", "poem_sac", "--eval-freq", "100000", "--eval-episodes", "2"],
    "enjoy": ["--folder", "logs"],
}
TRAIN_EXAMPLE = "example: sb3-poem train --env poem/PointGoal-v0 -P"
#: What comes after an environment's name in that of a run's folder: a number and what -uuid adds
RUN = re.compile(r"(\d+)(_[0-9a-f-]{36})?")
RESUME = "--resume: go on with the last run of this algorithm, environment and seed, if unfinished"


def register_algorithms() -> None:
    """Make our algorithms known to rl_zoo3, in this process."""
    ALGOS.update(ALGORITHMS)
    HYPERPARAMS_SAMPLER.update(SAMPLERS)
    HYPERPARAMS_CONVERTER.update(dict.fromkeys(ALGORITHMS, convert_params))


class CheckedPairs(StoreDict):
    """rl_zoo3's ``KEY:VALUE`` arguments, with an error that names what is no Python."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: Any = None) -> None:
        for pair in values:
            key, colon, text = pair.partition(":")
            if not colon:
                meant = f"; did you mean {pair.replace('=', ':', 1)}?" * ("=" in pair)
                raise ValueError(f"{option_string} {pair}: must have the form KEY:VALUE{meant}")
            try:
                super().__call__(parser, namespace, [pair], option_string)
            except Exception as error:  # whatever the text raises
                raise ValueError(
                    f"{option_string} {pair}: must have the form KEY:VALUE with a Python value, "
                    f"and {text!r} is none ({error}); text needs quotes, as in \"{key}:'{text}'\""
                ) from error


def parse(command: str, arguments: Sequence[str]) -> argparse.Namespace:
    """What matters here of the arguments of rl_zoo3's "train" or "enjoy", with its defaults."""
    parser = argparse.ArgumentParser(f"sb3-poem {command}", add_help=False, allow_abbrev=False)
    for flags in (("-params", "--hyperparams"), ("--env-kwargs",), ("--eval-env-kwargs",)):
        parser.add_argument(*flags, nargs="+", action=CheckedPairs)
    parser.add_argument("--gym-packages", nargs="+", default=[])
    parser.add_argument("--env")
    parser.add_argument("--algo", default="poem_sac")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--seed", type=int, default=-1)
    parser.add_argument("-f", "--log-folder", default="logs")
    parser.add_argument("-i", "--trained-agent")
    parser.add_argument("-n", "--n-timesteps", type=int, default=-1)
    given = parser.parse_known_args(arguments)[0]
    if given.env is None:
        raise ValueError("--env is missing: --env poem/PointGoal-v0, say")
    return given


def check_arguments(given: argparse.Namespace) -> None:
    """Refuse what rl_zoo3 would stumble over; import ``--gym-packages``."""
    import_packages(given.gym_packages)
    check_device(given.device)
    if given.trained_agent:
        if not given.trained_agent.endswith(".zip") or not Path(given.trained_agent).is_file():
            what = "there is no such file of a model, which ends in .zip"
            raise ValueError(f"-i {given.trained_agent}: {what}")
        facts = facts_of(given.trained_agent)
        if facts.get("keeps_experience"):
            total = facts["_total_timesteps"]
            if given.n_timesteps not in (-1, total):
                raise ValueError(
                    f"-n {given.n_timesteps}: {given.trained_agent} goes on to its own {total} "
                    "steps; leave -n out, and train the finished model further with -i"
                )
        elif given.algo in ALGORITHMS:
            check_archive(given.trained_agent, ALGORITHMS[given.algo], {})
    if given.env not in gym.registry:
        hint = ids_like(given.env) or "; name the module that registers it by --gym-packages"
        raise ValueError(f"--env {given.env}: there is no such environment{hint}")


def resumed(given: argparse.Namespace, arguments: Sequence[str]) -> list[str] | None:
    """Replace ``--resume`` by ``-i CHECKPOINT`` of the last run of the same algorithm, environment
    and seed, or by nothing where none has left one; None if that run has finished already.
    """
    if given.trained_agent:
        either = "leave out either --resume or -i/--trained-agent"
        raise ValueError(f"--resume finds the checkpoint by itself: {either}")
    rest = [argument for argument in arguments if argument != "--resume"]
    folder, env_name = Path(given.log_folder) / given.algo, given.env.replace("/", "-")
    run = last_run(folder, env_name, given.seed)
    if run is None:
        which = given.env if given.seed < 0 else f"{given.env} with seed {given.seed}"
        print(f"--resume: {folder} has no checkpoint of {which}; training begins from zero")
        return rest
    files = [run / f"{env_name}.zip", *run.glob(CHECKPOINT)]  # older, if the last updates lack
    if all(map(is_complete, files)):
        other = "start another run without --resume, or train it further with -i"
        print(f"{run} has finished already; {other}")
        return None
    return [*rest, "-i", str(run / CHECKPOINT)]


def resume_command(arguments: Sequence[str]) -> str:
    """The command that goes on with a run that was given these arguments and left a checkpoint."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("-i", "--trained-agent")
    parser.add_argument("--resume", action="store_true")
    return shlex.join(["sb3-poem", "train", *parser.parse_known_args(arguments)[1], "--resume"])


def is_complete(model: Path) -> bool:
    """Whether a training made all its steps; an interrupted one has a model's file, too."""
    if not model.exists():
        return False
    facts = facts_of(model)
    if "_total_timesteps" not in facts:
        raise ValueError(f"{model} is truncated, or no model; remove it")
    return int(facts["num_timesteps"]) >= int(facts["_total_timesteps"])


def last_run(folder: Path, env_name: str, seed: int) -> Path | None:
    """The newest run in an algorithm's folder that is done or can go on; of a seed, if not -1."""
    runs = []
    for run in folder.glob(f"{env_name}_*"):
        if found := RUN.fullmatch(run.name.removeprefix(f"{env_name}_")):
            runs.append((int(found[1]), run.stat().st_mtime, run))  # -uuid gives many one number
    for *_, run in sorted(runs, reverse=True):
        began = (run / CHECKPOINT).exists() or is_complete(run / f"{env_name}.zip")
        if began and (seed < 0 or _seed(run / env_name / "args.yml") == seed):
            return run
    return None


def _seed(file: Path) -> int | None:
    # rl_zoo3 writes an OrderedDict, which only this loader reads; the file is the user's own
    arguments = yaml.load(file.read_text(), Loader=yaml.UnsafeLoader) if file.exists() else {}
    return dict(arguments).get("seed")


def run_zoo(command: str, arguments: Sequence[str]) -> None:
    """Run rl_zoo3's "train" or "enjoy" with our algorithms registered and defaults of our own."""
    register_algorithms()
    trains, asks_help = command == "train", bool({"-h", "--help"} & set(arguments))
    if not trains and not has_display() and not asks_help and "--no-render" not in arguments:
        raise OSError("there is no display to draw on: add --no-render")
    if asks_help:
        print(f"Defaults here: {' '.join(DEFAULTS[command])}\n{RESUME * trains}\n")
    given = [*DEFAULTS[command], *arguments]
    if trains and "--resume" in arguments and not asks_help:
        if (continued := resumed(parse(command, given), given)) is None:
            return
        given = continued
    if not asks_help:
        check_arguments(parse(command, given))
    try:
        with (  # what rl_zoo3's programs read, and what they make
            mock.patch.object(sys, "argv", [f"sb3-poem {command}", *given]),
            mock.patch.object(zoo_train, "ExperimentManager", make_experiment),
        ):
            zoo_train.train() if trains else zoo_enjoy.enjoy()
    except TrainingInterrupted as stop:
        message, is_saved = stop.args
        again = "the same command begins again"
        if is_saved:
            again = f"go on with: {resume_command(arguments)}"
        raise KeyboardInterrupt(f"{message}; {again}") from None
    except AssertionError as error:
        # rl_zoo3 asserts on what the user gave; an assertion without words is a defect.
        if not str(error):
            raise
        raise ValueError(str(error)) from error
    finally:
        if trains and asks_help:
            print(f"\n{TRAIN_EXAMPLE}")
