"""One process at a time: locks that the system lets go of when their holder dies, however it dies."""

from __future__ import annotations

import contextlib
import fcntl
from collections.abc import Callable, Iterator
from pathlib import Path


@contextlib.contextmanager
def locked(path: Path, on_wait: Callable[[], None] | None = None) -> Iterator[int]:
    """
    Hold a lock, after waiting for whoever holds it.

    :param path: The lock's file; it stays behind, empty.
    :param on_wait: Called once, if there is a wait.
    :return: A context whose value is the file's descriptor: a child process that inherits it holds the lock as well.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if on_wait is not None:
                on_wait()
            fcntl.flock(file, fcntl.LOCK_EX)
        yield file.fileno()


@contextlib.contextmanager
def try_lock(path: Path) -> Iterator[bool]:
    """
    Hold a lock if nobody else does.

    :param path: See :func:`locked`.
    :return: A context whose value is whether the lock is held here.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
        else:
            yield True
