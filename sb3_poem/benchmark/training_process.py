"""``python -m sb3_poem.benchmark.training_process PARENT SESSION train ...``: the command line's
``train`` as a child of the benchmark.

It ends with its parent, so that a benchmark that was killed leaves no training behind, and notes how
long it took.
"""

import contextlib
import ctypes
import os
import runpy
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from sb3_poem.adaptation.state import write_json_atomically

PR_SET_PDEATHSIG = 1
LOOK_SECONDS = 2.0


def end_with_parent(parent: int) -> None:
    """Ask the system to kill this process when its parent is gone; where it cannot, nothing
    happens.

    :param parent: The parent's process id, which may be gone already.
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit("the benchmark that started this training is gone")


@contextlib.contextmanager
def timed(session: Path) -> Iterator[None]:
    """Write to a file how long the training took, by the clock and of the processor (all threads):
    at its end, and whenever there is a new checkpoint, since what comes after the last one is lost
    with a process that is killed.
    """
    started = time.monotonic()

    def note() -> None:
        times = {"seconds": time.monotonic() - started, "cpu_seconds": sum(os.times()[:4])}
        write_json_atomically(session, times)

    def last_checkpoint() -> float:
        files = session.parents[1].glob("*/*/checkpoint.zip")
        return max((file.stat().st_mtime for file in files), default=0.0)

    def look() -> None:
        seen = last_checkpoint()
        while not over.wait(LOOK_SECONDS):
            if last_checkpoint() > seen:
                seen = last_checkpoint()
                note()

    over = threading.Event()
    watcher = threading.Thread(target=look, daemon=True)
    write_json_atomically(session, {"seconds": 0.0, "cpu_seconds": 0.0})
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()
        note()


if __name__ == "__main__":
    end_with_parent(int(sys.argv[1]))
    with timed(Path(sys.argv[2])):
        del sys.argv[1:3]
        runpy.run_module("sb3_poem.cli", run_name="__main__")
