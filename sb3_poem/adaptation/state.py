"""JSON files that are whole or absent."""

import json
import os
from pathlib import Path
from typing import Any

from sb3_poem.common.files import write_atomically


def write_json_atomically(path: str | os.PathLike[str], data: dict[str, Any]) -> None:
    """Write JSON, so that the file is always the old one or the whole new one; makes folders."""
    write_atomically(Path(path), json.dumps(data, indent=1, allow_nan=False).encode())


def read_json(path: str | os.PathLike[str], what: str) -> dict[str, Any]:
    """Read a JSON object; a ``ValueError`` if the file is truncated, or not ``what``."""
    text = Path(path).read_text(encoding="utf-8")
    return parse_json(text, f"{os.fspath(path)} is not {what}")


def parse_json(text: str, message: str) -> dict[str, Any]:
    """A JSON object as data; ``message`` begins that of a ``ValueError``."""
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{message}: {error}") from error
    if not isinstance(data, dict):
        raise ValueError(f"{message}: it holds a {type(data).__name__}, not an object")
    return data
