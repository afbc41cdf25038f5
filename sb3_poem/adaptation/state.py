"""Adaptation state as JSON: arrays bit for bit, generators, and files that are whole or absent."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from sb3_poem.common.files import write_atomically


def plain(data: dict[str, Any]) -> dict[str, Any]:
    """Options with Python's numbers for NumPy's, which JSON does not know.

    :param data: By name.
    :return: The same.
    """
    return {
        name: value.item() if isinstance(value, np.generic) else value
        for name, value in data.items()
    }


def generator_state(rng: np.random.Generator) -> dict[str, Any]:
    """A generator's state as JSON-ready data.

    :param rng: A PCG64 generator, as ``numpy.random.default_rng`` makes it.
    :return: The state.
    """
    return dict(rng.bit_generator.state)


def generator_from_state(state: dict[str, Any]) -> np.random.Generator:
    """Read what :func:`generator_state` wrote.

    :return: A generator that continues where the other one stood.
    :raises ValueError: If it is no such state.
    """
    rng = np.random.default_rng(0)
    try:
        rng.bit_generator.state = state
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"not the state of a PCG64 generator: {error}") from error
    return rng


def write_json_atomically(path: str | os.PathLike[str], data: dict[str, Any]) -> None:
    """Write JSON so that the file is either the old one or the whole new one, whatever happens in
    between.

    :param path: The file; missing folders are made.
    :param data: What to write.
    :raises OSError: If it cannot be written.
    """
    write_atomically(Path(path), json.dumps(data, indent=1, allow_nan=False).encode())


def read_json(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a JSON object.

    :param path: The file.
    :return: The object.
    :raises ValueError: If the file is truncated, or is no JSON object.
    """
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{os.fspath(path)} is not a saved adaptation: {error}") from error
    if not isinstance(data, dict):
        raise ValueError(
            f"{os.fspath(path)} is not a saved adaptation: it holds a {type(data).__name__}, not an object"
        )
    return data
