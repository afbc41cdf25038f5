"""Writing files so that what was there before survives a failure, and reading JSON."""

import contextlib
import json
import os
import uuid
from collections.abc import Callable
from io import BufferedWriter
from pathlib import Path
from typing import Any


def write_atomically(path: str | Path, content: bytes | Callable[[BufferedWriter], object]) -> None:
    """Write a file, and missing folders, completely or not at all: a crash, a kill or a full disk
    leaves the previous file whole. Of a link the file is written to which it leads. ``content`` may
    be a function that writes to an open file.
    """
    target = Path(os.path.realpath(path))
    temporary = target.parent / f".{target.name}.{uuid.uuid4().hex}"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "xb") as file:  # with the permissions that the user's umask leaves
            content(file) if callable(content) else file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        before = "what was there before, if anything, is untouched"
        message = f"could not write {path} ({error.strerror}); {before}"
        raise OSError(error.errno, message) from error
    finally:  # an interrupt from the keyboard leaves nothing behind either
        with contextlib.suppress(OSError):
            os.unlink(temporary)
    with contextlib.suppress(OSError):  # not every file system lets a folder be synchronised
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def write_json_atomically(path: str | os.PathLike[str], data: dict[str, Any]) -> None:
    """Write JSON, so that the file is always the old one or the whole new one; makes folders."""
    write_atomically(Path(path), json.dumps(data, indent=1, allow_nan=False).encode())


def read_json(path: str | os.PathLike[str], what: str) -> dict[str, Any]:
    """Read a JSON object; a ``ValueError`` if the file is truncated, or not ``what``."""
    return parse_json(Path(path).read_bytes(), f"{os.fspath(path)} is not {what}")


def parse_json(text: str | bytes, message: str) -> dict[str, Any]:
    """A JSON object as data; ``message`` begins that of a ``ValueError``."""
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{message}: {error}") from error
    if not isinstance(data, dict):
        raise ValueError(f"{message}: it holds a {type(data).__name__}, not an object")
    return data
