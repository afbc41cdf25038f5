"""Connections: how long the server waits for a client, and who goes when there are too many."""

from __future__ import annotations

import asyncio
import ipaddress
from typing import Any

import h11
from uvicorn.protocols.http.flow_control import service_unavailable
from uvicorn.protocols.http.h11_impl import H11Protocol

# Seconds for a request, headers and body, and between two requests.
DEADLINE = 10.0
MAX_CONNECTIONS = 256
# Of one address: a browser opens six, and a class behind one router has one address.
MAX_OF_ADDRESS = 64
# Who has just come may say first what they want.
GRACE = 0.1
TOO_SLOW = (
    b"HTTP/1.1 408 Request Timeout\r\nConnection: close\r\nContent-Type: text/plain\r\n\r\n"
    b"the request took too long to arrive\n"
)


class Connection(H11Protocol):
    """A connection that ends when the server has waited too long for its client: for the rest of a
    request, for another one, or for an answer to be taken. Where there are too many, the one that
    was waited for longest ends, and none whose answer is being made: whoever sends a whole request
    at once is served, whatever else comes from their address.

    :param deadline: Seconds for a request, and between two; of an answer some must be taken within
        thrice as many.
    :param options: See uvicorn.
    """

    def __init__(self, *, deadline: float = DEADLINE, **options: Any) -> None:
        super().__init__(**options)
        self.deadline = deadline
        self.network = ""
        self.since = 0.0
        self.awaited: str | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._untaken = 0  # bytes

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """See asyncio."""
        super().connection_made(transport)
        self.network = network_of(self.client[0] if self.client else "")
        self._watch()
        self.loop.call_later(GRACE, self._make_room)

    def connection_lost(self, exc: Exception | None) -> None:
        """See asyncio."""
        super().connection_lost(exc)
        self._await(None)

    def data_received(self, data: bytes) -> None:
        """See asyncio."""
        super().data_received(data)
        self._watch()

    def on_response_complete(self) -> None:
        """See uvicorn."""
        super().on_response_complete()
        self._watch()

    def send_400_response(self, msg: str) -> None:
        """See uvicorn, which goes on with the answer that it had begun."""
        if self.cycle is not None:
            self.cycle.disconnected = True
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            super().send_400_response(msg)
        else:
            self._end()

    def pause_writing(self) -> None:
        """See asyncio."""
        super().pause_writing()
        self._watch()

    def resume_writing(self) -> None:
        """See asyncio."""
        super().resume_writing()
        self._await(None)  # a part was taken; the next has its own time
        self._watch()

    def _awaited_from_client(self) -> str | None:
        if self.transport.get_write_buffer_size() > 0:
            return "answer taken"
        if self.conn.their_state is h11.SEND_BODY:
            return "request"
        if self.conn.their_state is h11.IDLE:
            return (
                "request" if self.cycle is None or self.conn.trailing_data[0] else "another request"
            )
        return None

    def _watch(self) -> None:
        awaited = self._awaited_from_client()
        if awaited != self.awaited:
            self._await(awaited)

    def _await(self, awaited: str | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self.awaited, self.since = awaited, self.loop.time()
        if awaited is not None:
            self._start_timer()

    def _start_timer(self) -> None:
        self._untaken = self.transport.get_write_buffer_size()
        self._timer = self.loop.call_later(
            self.deadline * (3 if self._untaken else 1), self._too_late
        )

    def _too_late(self) -> None:
        if self._awaited_from_client() != self.awaited:  # an answer that was taken without a word
            self._watch()
            return
        if 0 < self.transport.get_write_buffer_size() < self._untaken:
            self._start_timer()
            return
        if self.conn.their_state is h11.SEND_BODY and self.conn.our_state is h11.SEND_RESPONSE:
            self.transport.write(TOO_SLOW)
        self._end()

    def _end(self) -> None:
        self.connections.discard(self)
        self.transport.abort()

    def _make_room(self) -> None:
        crowd = [one for one in self.connections if isinstance(one, Connection)]
        neighbours = [one for one in crowd if one.network == self.network]
        if len(neighbours) > MAX_OF_ADDRESS:
            crowd = neighbours
        elif len(crowd) <= MAX_CONNECTIONS:
            return
        awaited = [one for one in crowd if one.awaited is not None]
        if awaited:
            min(awaited, key=lambda one: one.since)._end()
        else:  # all answers are being made: this one's next request is told to come later
            self.app = service_unavailable  # type: ignore[assignment]


def network_of(host: str) -> str:
    """What counts as one address.

    :param host: A client's address.
    :return: It; of IPv6 the network of 64 bits that one household is given.
    """
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host
    if isinstance(address, ipaddress.IPv4Address):
        return host
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(ipaddress.IPv6Address(int(address) >> 64 << 64))
