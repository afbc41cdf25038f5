"""Checks of hyperparameters before anything starts."""

import difflib
import inspect
from collections.abc import Sequence
from typing import Any

from sb3_poem.loading import ALGORITHMS

# What rl_zoo3 takes out of an entry for itself before the rest goes to the algorithm.
ZOO_KEYS = frozenset(
    {"callback", "env_kwargs", "env_wrapper", "frame_stack", "monitor_kwargs", "n_envs", "n_timesteps"}
    | {"normalize", "vec_env_wrapper"}
)
# What rl_zoo3 gives to the algorithm itself; the same in an entry would be given twice.
FLAG_OF_KEY = {
    "device": "--device",
    "env": "--env",
    "seed": "--seed",
    "tensorboard_log": "-tb",
    "verbose": "--verbose",
}


def check_keys(keys: Sequence[str], algorithm: str, source: str) -> None:
    """
    Compare the keys of an entry of hyperparameters with what rl_zoo3 and the algorithm take.

    :param keys: the entry's keys
    :param algorithm: name of the algorithm
    :param source: where the keys were read, for the message
    :raises ValueError: at the first key that neither takes; the message names it and what resembles it
    """
    known = ZOO_KEYS | {name for name in inspect.signature(ALGORITHMS[algorithm]).parameters if not name.startswith("_")}
    for key in keys:
        if key in FLAG_OF_KEY:
            raise ValueError(f"{key!r} in {source} belongs on the command line: {FLAG_OF_KEY[key]}")
        if key not in known:
            close = difflib.get_close_matches(key, known - set(FLAG_OF_KEY), n=3)
            hint = f"did you mean {' or '.join(map(repr, close))}?" if close else "nor anything like it."
            raise ValueError(f"Unknown key {key!r} in {source}: {algorithm} has no such hyperparameter, {hint}")


def check_numbers(entry: dict[str, Any], source: str) -> None:
    """
    :param entry: hyperparameters
    :param source: where they were read, for the message
    :raises ValueError: if a number was read as text, as YAML reads 1e-3 (but 1.0e-3 as a number)
    """
    for key, value in entry.items():
        if isinstance(value, str):
            try:
                number = float(value)
            except ValueError:
                continue
            raise ValueError(f"{key} in {source} is the text {value!r} to YAML; write {number!r}")
