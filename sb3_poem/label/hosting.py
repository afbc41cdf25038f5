"""Running the web server: until it is stopped, or in a thread beside a notebook."""

from __future__ import annotations

import socket
import threading
import time
from typing import Any

import uvicorn
from starlette.applications import Starlette

# Connections at once; beyond it the server says that it is busy.
MAX_CONNECTIONS = 256


def make_server(app: Starlette, host: str, port: int) -> uvicorn.Server:
    """
    A server, not yet running.

    :param app: What it serves.
    :param host: Its address.
    :param port: Its port; 0 takes a free one.
    :return: The server.
    """
    config = uvicorn.Config(
        app,
        host=host,
        port=port,
        access_log=False,  # the addresses of sessions are their keys
        log_level="warning",
        server_header=False,
        ws="none",
        limit_concurrency=MAX_CONNECTIONS,
        timeout_keep_alive=15,
        timeout_graceful_shutdown=3,
    )
    return uvicorn.Server(config)


def bind(host: str, port: int) -> socket.socket:
    """
    Take a port before anything else is started.

    :param host: The address.
    :param port: The port; 0 takes a free one.
    :return: The bound socket.
    :raises OSError: If it is taken, or the address is not this machine's.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host.strip("[]"), port))
        listener.listen(128)  # who comes while the server starts waits, and is not turned away
    except OSError as error:
        listener.close()
        raise OSError(f"--host {host} --port {port}: {error.strerror or error}") from error
    return listener


class BackgroundServer:
    """
    A server on loopback in a thread of its own.

    :param app: What it serves.
    :param port: Its port; 0 takes a free one.
    :raises RuntimeError: If it does not start.
    """

    def __init__(self, app: Starlette, port: int = 0) -> None:
        self._listener = bind("127.0.0.1", port)
        self.port: int = self._listener.getsockname()[1]
        self._server = make_server(app, "127.0.0.1", self.port)
        arguments: dict[str, Any] = {"sockets": [self._listener]}
        self._thread = threading.Thread(target=self._server.run, kwargs=arguments, daemon=True)
        self._thread.start()
        deadline = time.monotonic() + 10.0
        while not self._server.started:
            if not self._thread.is_alive() or time.monotonic() > deadline:
                raise RuntimeError(f"the page's server did not start on port {self.port}")
            time.sleep(0.01)

    def close(self) -> None:
        """Stop it."""
        self._server.should_exit = True
        self._thread.join(timeout=10.0)
        self._listener.close()
