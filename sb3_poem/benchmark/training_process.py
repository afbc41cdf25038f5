"""``python -m sb3_poem.benchmark.training_process train ...``: the command line's ``train`` as a
child of the benchmark.

It ends with its parent: a benchmark that was killed leaves no training behind.
"""

import contextlib
import ctypes
import os
import runpy
import signal
import sys

PR_SET_PDEATHSIG = 1


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


if __name__ == "__main__":
    end_with_parent(int(sys.argv[1]))
    del sys.argv[1]
    runpy.run_module("sb3_poem.cli", run_name="__main__")
