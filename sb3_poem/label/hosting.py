"""Running the web server: until it is stopped, or in a thread beside a notebook."""

from __future__ import annotations

import contextlib
import ipaddress
import socket
import threading
import time
from functools import partial
from typing import Any

import uvicorn
from starlette.applications import Starlette

from sb3_poem.label.connections import DEADLINE, Connection

# Addresses of nobody, to ask the system from which of its own it would speak to the world.
ELSEWHERE = {socket.AF_INET: "192.0.2.1", socket.AF_INET6: "2001:db8::1"}


def make_server(app: Starlette, host: str, port: int, deadline: float = DEADLINE) -> uvicorn.Server:
    """A server, not yet running.

    :param app: What it serves.
    :param host: Its address.
    :param port: Its port; 0 takes a free one.
    :param deadline: Seconds that a client has for a request.
    :return: The server.
    """
    config = uvicorn.Config(
        app,
        host=host,
        port=port,
        access_log=False,  # the addresses of sessions are their keys
        log_level="warning",
        server_header=False,
        proxy_headers=False,  # nothing depends on what they say
        http=partial(Connection, deadline=deadline),  # type: ignore[arg-type]
        ws="none",
        timeout_keep_alive=15,
        timeout_graceful_shutdown=3,
    )
    return uvicorn.Server(config)


def bind(host: str, port: int) -> socket.socket:
    """Take a port before anything else is started.

    :param host: The address.
    :param port: The port; 0 takes a free one.
    :return: The bound socket.
    :raises ValueError: If there is no such port.
    :raises OSError: If it is taken, or the address is not this machine's.
    """
    if not 0 <= port <= 65535:
        raise ValueError(f"--port {port}: must be between 0 and 65535")
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


def link_host(listener: socket.socket, host: str) -> str:
    """The host of a link to a server.

    :param listener: Where it listens.
    :param host: The address that was asked for.
    :return: It; for one that stands for all of this machine's, such as ``0.0.0.0``, one at which
        the machine is reached.
    """
    if not ipaddress.ip_address(listener.getsockname()[0]).is_unspecified:
        return host.strip("[]")
    for family in (listener.family, socket.AF_INET):  # an IPv6 socket takes IPv4 too
        with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((ELSEWHERE[family], 9))  # sends nothing
            return str(probe.getsockname()[0])
    return "localhost"


class BackgroundServer:
    """A server on loopback in a thread of its own.

    :param app: What it serves.
    :param port: Its port; 0 takes a free one.
    :param deadline: Seconds that a client has for a request.
    :raises RuntimeError: If it does not start.
    """

    def __init__(self, app: Starlette, port: int = 0, deadline: float = DEADLINE) -> None:
        self._listener = bind("127.0.0.1", port)
        self.port: int = self._listener.getsockname()[1]
        self._server = make_server(app, "127.0.0.1", self.port, deadline)
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
