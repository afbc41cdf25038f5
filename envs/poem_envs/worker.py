"""The process in which a part of a :class:`~poem_envs.process_vector.ProcessFamilyVector`'s copies
live.

Started as ``python -m poem_envs.worker <file descriptor>``; it ends when the other end of the
connection is closed.
"""

from __future__ import annotations

import pickle
import signal
import sys
import traceback
from multiprocessing.connection import Connection
from typing import Any

import cloudpickle

from poem_envs.process_vector import CopyGroup


def serve(connection: Connection) -> None:
    """Answer calls of a group's methods, the first of which makes the group, until the connection
    is closed.
    """
    group: CopyGroup | None = None
    while True:
        try:
            method, arguments = pickle.loads(connection.recv_bytes())
        except (EOFError, ConnectionResetError):
            break
        answer: tuple[bool, Any]
        try:
            if method == "__init__":
                make, first = arguments
                group, result = CopyGroup(pickle.loads(make)(), first), None
            else:
                result = getattr(group, method)(*arguments)
            answer = True, result
        except Exception as error:
            answer = False, (str(error), traceback.format_exc())
        try:
            connection.send_bytes(cloudpickle.dumps(answer))
        except (BrokenPipeError, ConnectionResetError):
            break
    if group is not None:
        group.close()


if __name__ == "__main__":
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C reaches all processes; the parent's end ends this one
    serve(Connection(int(sys.argv[1])))
