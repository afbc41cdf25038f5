"""One process at a time: locks that the system lets go of when their holder dies, however it dies."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

from filelock import lock_descriptor


@contextlib.contextmanager
def locked(path: Path, on_wait: Callable[[], None] | None = None) -> Iterator[int]:
    """Hold a lock, after waiting for whoever holds it.

    :param path: The lock's file; it stays behind, empty.
    :param on_wait: Called once, if there is a wait.
    :return: A context whose value is the file's descriptor: a child process that inherits it holds
        the lock as well.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        if not lock_descriptor(file.fileno(), blocking=False):
            if on_wait is not None:
                on_wait()
            lock_descriptor(file.fileno())
        yield file.fileno()


@contextlib.contextmanager
def try_lock(path: Path) -> Iterator[bool]:
    """Hold a lock if nobody else does.

    :param path: See :func:`locked`.
    :return: A context whose value is whether the lock is held here.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        yield lock_descriptor(file.fileno(), blocking=False)
