"""``sb3-poem train --resume``: go on with what was interrupted."""

import argparse
import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from sb3_poem.cli.experiment import CHECKPOINT

#: Environment steps between two checkpoints of a run that ``--resume`` started, unless ``--save-freq`` says otherwise.
SAVE_FREQ = "100000"


def resumed(arguments: Sequence[str]) -> list[str] | None:
    """
    Replace ``--resume`` by what it means: ``-i CHECKPOINT`` of the last run of the same algorithm, environment and seed, or
    nothing where no such run has left a checkpoint; and checkpoints on the way.

    :param arguments: those of ``train``, ``--algo`` among them
    :return: arguments for rl_zoo3; None if that run has finished already
    :raises ValueError: if ``-i`` is given too
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--algo")
    parser.add_argument("--env", default="CartPole-v1")  # rl_zoo3's default
    parser.add_argument("-f", "--log-folder", default="logs")
    parser.add_argument("--seed", type=int, default=-1)
    parser.add_argument("-i", "--trained-agent", default="")
    given, _ = parser.parse_known_args(arguments)
    if given.trained_agent:
        raise ValueError("--resume finds the checkpoint by itself: leave out either --resume or -i/--trained-agent")
    rest = ["--save-freq", SAVE_FREQ, *(argument for argument in arguments if argument != "--resume")]
    run = last_run(Path(given.log_folder) / given.algo, given.env.replace("/", "-"), given.seed)
    if run is None:
        return rest
    if is_complete(run / f"{given.env.replace('/', '-')}.zip"):
        print(f"{run} has finished already; start another run without --resume, or train it further with -i")
        return None
    return [*rest, "-i", str(run / CHECKPOINT)] if (run / CHECKPOINT).exists() else rest


def is_complete(model: Path) -> bool:
    """
    Whether a training made all its steps. rl_zoo3 saves a model too when an interrupt from the keyboard stops it.

    :param model: the file that it saved last, or would have
    :raises ValueError: if the file is no model
    """
    if not model.exists():
        return False
    try:
        with zipfile.ZipFile(model) as archive:
            data = json.loads(archive.read("data"))
        return int(data["num_timesteps"]) >= int(data["_total_timesteps"])
    except (zipfile.BadZipFile, KeyError, ValueError) as error:
        raise ValueError(f"{model} is truncated, or no model: {error}; remove it to train anew") from error


def last_run(folder: Path, env_name: str, seed: int) -> Path | None:
    """
    The newest run that can be continued, or is done.

    :param folder: of the algorithm's runs
    :param env_name: environment id with - in place of /
    :param seed: as given to the run; negative: any
    """
    runs = [
        run
        for run in folder.glob(f"{env_name}_*")
        if ((run / CHECKPOINT).exists() or (run / f"{env_name}.zip").exists())
        and (seed < 0 or _arguments(run / env_name / "args.yml").get("seed") == seed)
    ]
    return max(runs, key=lambda run: int(run.name.rpartition("_")[2]), default=None)


def _arguments(file: Path) -> dict[str, Any]:
    # rl_zoo3 writes an OrderedDict, which only this loader reads; the file is the user's own
    return dict(yaml.load(file.read_text(), Loader=yaml.UnsafeLoader)) if file.exists() else {}
