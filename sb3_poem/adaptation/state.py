"""Adaptation state as JSON: files that are whole or absent."""

import json
import os
from pathlib import Path
from typing import Any

from sb3_poem.common.files import write_atomically


def write_json_atomically(path: str | os.PathLike[str], data: dict[str, Any]) -> None:
    """Write JSON, so that the file is always the old one or the whole new one; makes folders."""
    write_atomically(Path(path), json.dumps(data, indent=1, allow_nan=False).encode())


def read_json(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a JSON object; a ``ValueError`` if the file is truncated, or holds none."""
    return parse_json(Path(path).read_text(encoding="utf-8"), f"{os.fspath(path)} is")


def parse_json(text: str, this_is: str) -> dict[str, Any]:
    """A saved adaptation as data; ``this_is`` begins the message of a ``ValueError``."""
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{this_is} not a saved adaptation: {error}") from error
    if not isinstance(data, dict):
        holds = f"it holds a {type(data).__name__}, not an object"
        raise ValueError(f"{this_is} not a saved adaptation: {holds}")
    return data
