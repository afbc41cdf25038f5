"""A newcomer's first hour: models that are made once, and the command line within this process."""

from __future__ import annotations

import contextlib
import functools
import io
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import pytest
import yaml
from meta_toys import EPOCH, POINT_GOAL, Walk, small
from stable_baselines3 import SAC

from sb3_poem import PEARLSAC, POEMSAC, cli

#: What ``sb3-poem`` turns into a sentence: what the library says of a user's mistake.
MISTAKES = (ValueError, TypeError, OSError, gym.error.Error)

#: Hyperparameters with which ``sb3-poem train`` is done at once; an epoch has 150 steps.
ENTRY: dict[str, Any] = {
    "policy": "MlpPolicy",
    "n_timesteps": 300,
    "n_envs": 6,
    "n_train_tasks": 6,
    "gradient_steps": 3,
    "meta_batch_size": 4,
    "batch_size": 16,
    "context_size": 16,
    "policy_kwargs": "dict(net_arch=[16, 16])",
}


class Toy(Walk):
    """A family as a user writes it."""


def made(env: Any = POINT_GOAL, **arguments: Any) -> POEMSAC:
    return small(POEMSAC, env, **arguments)


@functools.cache
def trained(algorithm: type[PEARLSAC] = POEMSAC) -> Any:
    """A model after two epochs. Rows leave it as it is."""
    return small(algorithm).learn(2 * EPOCH)


@functools.cache
def foreign() -> SAC:
    """SB3's own SAC, which is what many have."""
    return SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [4]}, buffer_size=10)


def write_entry(path: Path, env_id: str = POINT_GOAL, **changes: Any) -> Path:
    """A file of hyperparameters: :data:`ENTRY` with changes."""
    path.write_text(yaml.safe_dump({env_id: {**ENTRY, **changes}}))
    return path


def config_file(folder: Path, env_id: str = POINT_GOAL, **changes: Any) -> str:
    """The same in a folder of its own."""
    folder.mkdir(exist_ok=True)
    return str(write_entry(folder / "my.yml", env_id, **changes))


class Outcome(NamedTuple):
    """What a command did."""

    status: int
    out: str
    err: str


def shell(*arguments: object) -> Outcome:
    """``sb3-poem`` with these arguments, within this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = cli.main([str(argument) for argument in arguments])
        except SystemExit as stop:  # of argparse
            status = stop.code if isinstance(stop.code, int) else 1
    return Outcome(status, out.getvalue(), err.getvalue())


def refused(name: str, call: Callable[[Path], Any], words: str, error: Any = MISTAKES) -> Any:
    """A row that ends in an error.

    :param name: Of the row
    :param call: What is typed; gets a folder
    :param words: Regular expressions with ... between them, each to be found in the message
    :param error: The error's type, or types
    """
    return pytest.param(call, words, error, id=name)


def check_words(message: str, words: str) -> None:
    """Whether a message says what is wrong, and what would be right."""
    missing = [word for word in words.split("...") if not re.search(word, message, re.DOTALL)]
    assert not missing, message


def works(name: str, call: Callable[[Path], Any], outcome: Any = True) -> Any:
    """A row.

    :param name: Of the row
    :param call: What is typed; gets an empty folder
    :param outcome: What it gives, or a function that says whether that is right
    """
    return pytest.param(call, outcome, id=name)


def check_works(call: Callable[[Path], Any], outcome: Any, folder: Path) -> None:
    """Whether a row of :func:`works` does, without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        value = call(folder)
    if callable(outcome) and not isinstance(outcome, type):
        assert outcome(value), value
    else:
        assert value == outcome


def names(folder: Path, pattern: str = "*") -> list[str]:
    return sorted(path.name for path in folder.glob(pattern) if path.is_file())


def runs(folder: Path) -> list[str]:
    """Of TensorBoard."""
    return [path.parent.name for path in folder.rglob("events.out.tfevents*")]
