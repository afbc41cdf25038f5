"""Writing files so that what was there before survives a failure."""

import contextlib
import os
import uuid
from collections.abc import Callable
from io import BufferedWriter
from pathlib import Path


def write_atomically(path: str | Path, content: bytes | Callable[[BufferedWriter], object]) -> None:
    """Write a file, and missing folders, completely or not at all: a crash, a kill or a full disk
    leaves the previous file whole. ``content`` may be a function that writes to an open file.
    """
    path = Path(path)
    temporary = path.parent / f".{path.name}.{uuid.uuid4().hex}"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "xb") as file:  # with the permissions that the user's umask leaves
            content(file) if callable(content) else file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        before = "what was there before, if anything, is untouched"
        message = f"could not write {path} ({error.strerror}); {before}"
        raise OSError(error.errno, message) from error
    finally:  # an interrupt from the keyboard leaves nothing behind either
        with contextlib.suppress(OSError):
            os.unlink(temporary)
    with contextlib.suppress(OSError):  # not every file system lets a folder be synchronised
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
