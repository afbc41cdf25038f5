"""Checks of hyperparameters before anything starts."""

import contextlib
import difflib
import importlib.util
import inspect
import os
from collections.abc import Mapping
from typing import Any

from sb3_poem.loading import ALGORITHMS
from sb3_poem.pearl_sac.arguments import UNSUPPORTED

# What rl_zoo3 takes out of an entry for itself before the rest goes to the algorithm.
ZOO_KEYS = frozenset({"callback", "env_kwargs", "monitor_kwargs", "n_envs", "n_timesteps"})
# What rl_zoo3 gives to the algorithm itself; the same in an entry would be given twice.
FLAG_OF_KEY = {
    **{"device": "--device", "env": "--env", "seed": "--seed", "verbose": "--verbose"},
    "tensorboard_log": "-tb",
}


def check_entry(entry: Mapping[str, Any], algorithm: str, source: str) -> None:
    """Refuse keys of an entry (of what ``source`` names) that neither rl_zoo3 nor the algorithm
    takes, and numbers that are none, or were read as text, as YAML reads 1e-3 (but not 1.0e-3).
    """
    parameters = inspect.signature(ALGORITHMS[algorithm]).parameters
    known = {name for name in parameters if not name.startswith("_")} - {"unsupported"} | ZOO_KEYS
    for key in sorted(entry):
        if key in FLAG_OF_KEY:
            raise ValueError(f"{key!r} in {source} belongs on the command line: {FLAG_OF_KEY[key]}")
        if key in UNSUPPORTED:
            raise ValueError(f"{key!r} in {source} is not for {algorithm}: {UNSUPPORTED[key]}")
        if key not in known:
            close = difflib.get_close_matches(key, known - set(FLAG_OF_KEY), n=3)
            names = " or ".join(map(repr, close))
            alike = f"did you mean {names}?" if close else "nor anything like it."
            raise ValueError(
                f"Unknown key {key!r} in {source}: {algorithm} has no such hyperparameter, {alike}"
            )
        kind = parameters[key].annotation if key in parameters else None
        _check_value(f"{key} in {source}", key, entry[key], kind)


def _check_value(what: str, key: str, value: Any, kind: Any) -> None:
    if isinstance(value, str) and (number := _number(value)) is not None:
        raise ValueError(f"{what} is the text {value!r}; write {number!r}")
    if key in ("n_envs", "n_timesteps"):
        fits, wanted = isinstance(value, (int, float)) and value >= 1, "a positive number"
    elif key == "learning_rate":
        fits = not isinstance(value, str) or _number(value.partition("_")[2]) is not None
        wanted = "a number, or 'lin_' and a number"
    else:
        fits = kind not in (int, float) or isinstance(value, (int, kind))
        wanted = "a whole number" if kind is int else "a number"
    if not fits:
        raise ValueError(f"{what} must be {wanted}, got {value!r}")


def _number(text: str) -> float | None:
    with contextlib.suppress(ValueError):
        return float(text)
    return None


def check_config(config: str) -> None:
    """Refuse a ``-c`` that is neither a file nor, as rl_zoo3 takes it, a Python module."""
    if config.endswith((".yml", ".yaml", ".py")):
        if not os.path.isfile(config):
            raise ValueError(f"-c {config}: there is no such file")
        return
    found = None
    with contextlib.suppress(ImportError, ValueError):
        found = importlib.util.find_spec(config)
    if found is None:
        raise ValueError(
            f"-c {config}: there is no such module; the name of a file ends in .yml, .yaml or .py"
        )
