"""``sb3-poem train --resume``: go on with what was interrupted."""

import argparse
import json
import shlex
import zipfile
from collections.abc import Sequence
from pathlib import Path

import yaml

from sb3_poem.cli.experiment import CHECKPOINT


def resumed(arguments: Sequence[str]) -> list[str] | None:
    """Replace ``--resume`` in the arguments of ``train`` by what it means: ``-i CHECKPOINT`` of the
    last run of the same algorithm, environment and seed, or nothing, and a word about it, where
    none has left a checkpoint. None if that run has finished already.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--algo")
    parser.add_argument("--env", default="CartPole-v1")  # rl_zoo3's default
    parser.add_argument("-f", "--log-folder", default="logs")
    parser.add_argument("--seed", type=int, default=-1)
    parser.add_argument("-i", "--trained-agent")
    given, _ = parser.parse_known_args(arguments)
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
    if is_complete(run / f"{env_name}.zip"):
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
    try:
        with zipfile.ZipFile(model) as archive:
            data = json.loads(archive.read("data"))
        return int(data["num_timesteps"]) >= int(data["_total_timesteps"])
    except (zipfile.BadZipFile, KeyError, ValueError) as error:
        raise ValueError(f"{model} is truncated, or no model: {error}; remove it") from error


def last_run(folder: Path, env_name: str, seed: int) -> Path | None:
    """The newest run in an algorithm's folder that can be continued, or is done, of an environment
    (with - in place of /), and unless it is negative of a seed.
    """

    def number(run: Path) -> int:
        return int(run.name.removeprefix(env_name).split("_")[1])

    for run in sorted(folder.glob(f"{env_name}_*"), key=number, reverse=True):
        if seed >= 0 and _seed(run / env_name / "args.yml") != seed:
            continue
        if (run / CHECKPOINT).exists() or is_complete(run / f"{env_name}.zip"):
            return run
    return None


def _seed(file: Path) -> int | None:
    # rl_zoo3 writes an OrderedDict, which only this loader reads; the file is the user's own
    arguments = yaml.load(file.read_text(), Loader=yaml.UnsafeLoader) if file.exists() else {}
    return dict(arguments).get("seed")
