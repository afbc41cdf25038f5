"""Checks of hyperparameters before anything starts."""

import contextlib
import difflib
import importlib.util
import inspect
import os
from collections.abc import Sequence
from typing import Any

from sb3_poem.loading import ALGORITHMS
from sb3_poem.pearl_sac.arguments import UNSUPPORTED

# What rl_zoo3 takes out of an entry for itself before the rest goes to the algorithm.
ZOO_KEYS = frozenset({"callback", "env_kwargs", "monitor_kwargs", "n_envs", "n_timesteps"})
# What rl_zoo3 gives to the algorithm itself; the same in an entry would be given twice.
FLAG_OF_KEY = {
    "device": "--device",
    "env": "--env",
    "seed": "--seed",
    "tensorboard_log": "-tb",
    "verbose": "--verbose",
}


def check_keys(keys: Sequence[str], algorithm: str, source: str) -> None:
    """Compare the keys of an entry of hyperparameters with what rl_zoo3 and the algorithm take.

    :param keys: the entry's keys
    :param algorithm: name of the algorithm
    :param source: where the keys were read, for the message
    :raises ValueError: at the first key that neither takes; the message names it and what resembles
        it
    """
    arguments = set(inspect.signature(ALGORITHMS[algorithm]).parameters) - {"unsupported"}
    known = ZOO_KEYS | {name for name in arguments if not name.startswith("_")}
    for key in keys:
        if key in FLAG_OF_KEY:
            raise ValueError(f"{key!r} in {source} belongs on the command line: {FLAG_OF_KEY[key]}")
        if key in UNSUPPORTED:
            raise ValueError(f"{key!r} in {source} is not for {algorithm}: {UNSUPPORTED[key]}")
        if key not in known:
            close = difflib.get_close_matches(key, known - set(FLAG_OF_KEY), n=3)
            hint = (
                f"did you mean {' or '.join(map(repr, close))}?"
                if close
                else "nor anything like it."
            )
            raise ValueError(
                f"Unknown key {key!r} in {source}: {algorithm} has no such hyperparameter, {hint}"
            )


def check_numbers(entry: dict[str, Any], algorithm: str, source: str) -> None:
    """:param entry: hyperparameters
    :param algorithm: name of the algorithm
    :param source: where they were read, for the message
    :raises ValueError: if a number is none, or was read as text, as YAML reads 1e-3 (but 1.0e-3 as
        a number)
    """
    parameters = inspect.signature(ALGORITHMS[algorithm]).parameters
    for key, value in entry.items():
        kind = parameters[key].annotation if key in parameters else None
        if isinstance(value, str) and (number := _number(value)) is not None:
            raise ValueError(f"{key} in {source} is the text {value!r}; write {number!r}")
        if key in ("n_envs", "n_timesteps"):
            fits, wanted = isinstance(value, (int, float)) and value >= 1, "a positive number"
        elif key == "learning_rate":
            fits = not isinstance(value, str) or _number(value.partition("_")[2]) is not None
            wanted = "a number, or 'lin_' and a number"
        else:
            fits = kind not in (int, float) or isinstance(value, (int, kind))
            wanted = "a whole number" if kind is int else "a number"
        if not fits:
            raise ValueError(f"{key} in {source} must be {wanted}, got {value!r}")


def _number(text: str) -> float | None:
    with contextlib.suppress(ValueError):
        return float(text)
    return None


def check_config(config: str) -> None:
    """:param config: what ``-c`` names: a file, or a Python module as rl_zoo3 takes it
    :raises ValueError: if there is neither
    """
    if not config.endswith((".yml", ".yaml", ".py")):
        with contextlib.suppress(ImportError, ValueError):
            if importlib.util.find_spec(config) is not None:
                return
        raise ValueError(
            f"-c {config}: there is no such module; the name of a file ends in .yml, .yaml or .py"
        )
    if not os.path.isfile(config):
        raise ValueError(f"-c {config}: there is no such file")
