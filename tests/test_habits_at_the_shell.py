"""What people type at the command line who know rl_zoo3."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from first_hour import (
    ENTRY,
    check_outcome,
    check_works,
    config_file,
    names,
    runs,
    shell,
    works,
)
from meta_toys import POINT_GOAL

from sb3_poem import POEMSAC
from sb3_poem.resources import pretrained_names


def said(*arguments: object) -> str:
    done = shell(*arguments)
    assert done.status == 0, done.err
    return " ".join((done.out + done.err).split())


def train(folder: Path, *flags: object, env_id: str = POINT_GOAL) -> str:
    given = ("-c", config_file(folder, env_id), "-f", folder / "logs", "--eval-freq", -1)
    return said("train", "--env", env_id, *given, *flags)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a training with many flags, whose outcomes are looked at one by one."""
    folder = tmp_path_factory.mktemp("run")
    flags = ["-params", "gamma:0.9", "policy_kwargs:dict(net_arch=[8])", "-n", 450, "--seed", 0]
    flags += ["-P", "-tb", folder / "tb", "--save-freq", 150, "--eval-freq", 450]
    flags += ["--eval-episodes", 1, "--env-kwargs", "step_length:0.1"]
    (folder / "printed").write_text(train(folder, *flags))
    return folder


def first(folder: Path, number: int = 1) -> Path:
    return folder / f"logs/poem_sac/poem-PointGoal-v0_{number}"


def result(folder: Path, number: int = 1) -> POEMSAC:
    return POEMSAC.load(first(folder, number) / "poem-PointGoal-v0.zip")


FLAGS = [
    works("-n", lambda run: result(run).num_timesteps, 450),
    works(
        "-params", lambda run: (result(run).gamma, result(run).policy.net_arch["pi"]), (0.9, [8])
    ),
    works("-c", lambda run: result(run).batch_size, ENTRY["batch_size"]),
    works("--seed", lambda run: result(run).seed, 0),
    works("--env-kwargs", lambda run: dict(result(run).env_kwargs), {"step_length": 0.1}),
    works(
        "--save-freq",
        lambda run: names(first(run)),
        {"checkpoint.zip", "rl_model_150_steps.zip"}.issubset,
    ),
    works("--eval-freq", lambda run: names(first(run), "best*"), ["best_model.zip"]),
    works("-tb", lambda run: len(runs(run / "tb")), 1),
    works("--progress", lambda run: "450/450" in (run / "printed").read_text()),
]


def trained_further(folder: Path) -> tuple[int, int]:
    train(folder)
    train(folder, "-i", first(folder) / "poem-PointGoal-v0.zip", "-n", 150)
    return result(folder)._n_updates, result(folder, 2)._n_updates


def searched(folder: Path) -> bool:
    flags = ("--n-trials", 1, "--n-evaluations", 1, "--eval-episodes", 1, "--no-optim-plots")
    train(folder, "-optimize", "-n", 50, "--seed", 38, "--sampler", "random", *flags)
    (report,) = (folder / "logs/poem_sac").glob("report_*.csv")
    return "COMPLETE" in report.read_text()


def own_module(folder: Path) -> bool:
    """In the working folder, as beside a user's own scripts."""
    lines = ("import gymnasium", "import first_hour")
    lines += ("gymnasium.register('Mine-v0', first_hour.Toy, max_episode_steps=10)",)
    (folder / "my_families.py").write_text("\n".join(lines))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [path for path in sys.path if path not in ("", ".")])
        try:
            train(folder, "--gym-packages", "my_families", "-n", 60, env_id="Mine-v0")
        finally:
            gym.registry.pop("Mine-v0", None)
            sys.modules.pop("my_families", None)
    return (folder / "logs/poem_sac/Mine-v0_1/Mine-v0.zip").is_file()


def as_a_module(_: Path) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["sb3-poem", "--version"])
        with pytest.raises(SystemExit) as stop:
            runpy.run_module("sb3_poem", run_name="__main__")
    return stop.value.code


def enjoyed(folder: Path, *flags: object) -> str:
    train(folder)
    return said("enjoy", "--env", POINT_GOAL, "-f", folder / "logs", "--no-render", *flags)


def recorded(folder: Path) -> list[str]:
    flags = ("--queries", 1, "--episodes", 1, "--out", folder / "a.gif")
    said("record-video", "--model", "PointGoal", *flags)
    return names(folder)


ADAPT = ("adapt", "--model", "PointGoal", "--tasks", 2, "--queries", 1, "--episodes", 1)

COMMANDS = [
    works("train -i", trained_further, (6, 9)),
    works("train -optimize", searched),
    works("train --gym-packages", own_module),
    works(
        "train --algo",
        lambda f: train(f, "--algo", "pearl_sac") and (f / "logs/pearl_sac").is_dir(),
    ),
    works("enjoy", lambda f: "answers" in enjoyed(f, "--queries", 2, "--episodes", 1)),
    works("enjoy -n --exp-id", lambda f: len(enjoyed(f, "-n", 50, "--exp-id", 1)) > 0),
    works(
        "adapt",
        lambda f: "task known" in said(*ADAPT, "--json", f / "a.json") and names(f),
        ["a.json"],
    ),
    works("record-video", recorded, ["a.gif"]),
    works(
        "models", lambda _: [name for name in pretrained_names() if name not in said("models")], []
    ),
    works("python -m sb3_poem", as_a_module, 0),
]


@pytest.fixture(autouse=True)
def working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(("call", "outcome"), COMMANDS)
def test_works(call: Callable[[Path], Any], outcome: Any, tmp_path: Path) -> None:
    check_works(call, outcome, tmp_path)


@pytest.mark.parametrize(("call", "outcome"), FLAGS)
def test_flags_of_train(call: Callable[[Path], Any], outcome: Any, run: Path) -> None:
    check_outcome(call(run), outcome)
