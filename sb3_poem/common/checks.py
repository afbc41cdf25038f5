"""Checks of numbers that users and files give."""

from collections.abc import Sequence
from typing import Any

import numpy as np


def check_whole(name: str, value: Any, least: int, most: int | None = None) -> None:
    """Refuse what is no whole number in the range; NumPy's are, True and False are not."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ValueError(f"`{name}` must be a whole number, but is {value!r}")
    if value < least:
        raise ValueError(f"`{name}` must be at least {least}, but is {value}")
    if most is not None and value > most:
        raise ValueError(f"`{name}` must be at most {most}, but is {value}")


def check_whole_numbers(
    name: str, values: Sequence[int], least: int, most: int | None = None
) -> tuple[int, ...]:
    """Refuse what holds others than whole numbers in the range, or none; they come back ascending,
    each once.
    """
    if np.shape(values) in ((), (0,)):
        raise ValueError(f"`{name}` must hold at least one whole number, but is {values!r}")
    for value in values:
        check_whole(name, value, least, most)
    return tuple(sorted(map(int, set(values))))


def check_number(
    name: str,
    value: Any,
    low: float = -np.inf,
    high: float = np.inf,
    *,
    above: float = -np.inf,
    below: float = np.inf,
) -> None:
    """Refuse what is no finite number from ``low`` to ``high``, or not ``above`` and ``below``
    others; True and False are none.
    """
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not (number and np.isfinite(value)):
        raise ValueError(f"`{name}` must be a finite number, but is {value!r}")
    if value < low:
        raise ValueError(f"`{name}` must be at least {low:g}, but is {value}")
    if value > high:
        raise ValueError(f"`{name}` must be at most {high:g}, but is {value}")
    if not above < value < below:
        bound = f"above {above:g}" if value <= above else f"below {below:g}"
        raise ValueError(f"`{name}` must be {bound}, but is {value}")


def check_number_or_auto(name: str, value: Any, low: float = -np.inf) -> None:
    """Refuse what is neither a number from ``low`` on nor "auto" (or "auto_" and such a number)."""
    if not isinstance(value, str):
        return check_number(name, value, low)
    word, _, start = value.partition("_")
    try:
        known = word == "auto" and (not start or float(start) > 0)
    except ValueError:
        known = False
    if not known:
        raise ValueError(f'`{name}` must be a number or "auto", but is {value!r}')


def as_observations(observation: Any, shape: tuple[int, ...]) -> np.ndarray:
    """An observation of this shape, or several, as an array; refuse what people take for one."""
    if isinstance(observation, tuple) and any(isinstance(part, dict) for part in observation):
        given = "what reset() of a Gymnasium environment returns: obs, info = env.reset()"
        raise ValueError(f"`observation` must be an array, but is {given}")
    if isinstance(observation, dict):
        raise TypeError(f"`observation` must be an array of shape {shape}, but is a dictionary")
    array = np.asarray(observation)
    if array.shape != shape and array.shape[1:] != shape:
        taken = f"the policy takes {shape}, or several of them"
        raise ValueError(f"observation has shape {array.shape}, but {taken}")
    return array


def check_choice(name: str, value: Any, allowed: Sequence[object]) -> None:
    """Refuse an option's value that is none of those allowed."""
    if value not in allowed:
        raise ValueError(f"`{name}` must be one of {tuple(allowed)}, but is {value!r}")
