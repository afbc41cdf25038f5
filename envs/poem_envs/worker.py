"""The process of a ``RemoteGroup``: ``python -m poem_envs.worker <file descriptor>``."""

from __future__ import annotations

import pickle
import signal
import sys
import traceback
from multiprocessing.connection import Connection
from typing import Any

import cloudpickle

from poem_envs.processes import CopyGroup


def serve(connection: Connection) -> None:
    """Answer calls of a group's methods, the first of which makes the group."""
    group: CopyGroup | None = None
    while True:
        try:
            call = connection.recv_bytes()
            answer: tuple[bool, Any]
            try:
                method, arguments = pickle.loads(call)
                if method == "__init__":
                    group, answer = CopyGroup(*arguments), (True, None)
                else:
                    answer = True, getattr(group, method)(*arguments)
            except Exception as error:
                answer = False, (str(error), traceback.format_exc())
            connection.send_bytes(cloudpickle.dumps(answer))
        except (EOFError, BrokenPipeError, ConnectionResetError):
            break
    if group is not None:
        group.close()


if __name__ == "__main__":
    # Ctrl-C reaches all processes; the parent's end ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    serve(Connection(int(sys.argv[1])))
