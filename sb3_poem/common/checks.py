"""Checks of numbers that users and files give."""

from typing import Any

import numpy as np


def check_whole(name: str, value: Any, least: int, most: int | None = None) -> None:
    """Refuse what is no whole number, or too small, or too large.

    :param name: Of the argument
    :param value: NumPy's whole numbers are taken too; True and False are none
    :raises ValueError: names the argument and its value
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ValueError(f"`{name}` must be a whole number, but is {value!r}")
    if value < least:
        raise ValueError(f"`{name}` must be at least {least}, but is {value}")
    if most is not None and value > most:
        raise ValueError(f"`{name}` must be at most {most}, but is {value}")
