"""Who gets in, and with how much: names, passwords, cross-site requests, sizes, waiting, crowds."""

import asyncio
import base64
import contextlib
import hmac
import ipaddress
import re
from dataclasses import dataclass
from typing import Any

import h11
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.flow_control import service_unavailable
from uvicorn.protocols.http.h11_impl import H11Protocol

MAX_BODY = 16 * 1024  # bytes of a request
# With the server's port, since a browser sends what one server of a host has set to all of them.
COOKIE = "sb3_poem_access_{port}"
LOOPBACK = frozenset(("localhost", "127.0.0.1", "[::1]"))
# Somebody who guesses a password gets so many answers a second on each connection.
PAUSE_AFTER_WRONG_PASSWORD = 0.5
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",  # the address of a session is its key
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
}
CONTENT_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "media-src 'self' blob:; connect-src 'self'; form-action 'self'; base-uri 'none'; "
    "frame-ancestors {ancestors}"
)
# Seconds for a request, headers and body, and between two requests.
DEADLINE = 10.0
# How often a connection is looked at within them.
LOOKS = 20
MAX_CONNECTIONS = 256
# Of one address: a browser opens six, and a class behind one router has one address.
MAX_OF_ADDRESS = 64
# Who has just come may say first what they want.
GRACE = 0.1
TOO_SLOW = (
    b"HTTP/1.1 408 Request Timeout\r\nConnection: close\r\nContent-Type: text/plain\r\n\r\n"
    b"the request took too long to arrive\n"
)


@dataclass(frozen=True)
class Access:
    """Who gets in.

    :param user: With ``password``, the name that a browser asks for.
    :param token: What the first address must carry as ``?token=``; a cookie remembers it.
    :param hosts: Host names under which the server answers when neither is asked for, so that no
        foreign page can reach it by a name of its own (DNS rebinding).
    :param embedded: Whether pages of other origins may show this one in a frame (a notebook does).
    """

    user: str | None = None
    password: str | None = None
    token: str | None = None
    hosts: frozenset[str] = LOOPBACK
    embedded: bool = False


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address, or a name."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


class AccessMiddleware:
    """ASGI middleware in front of everything."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self.app = app
        self.access = access
        policy = CONTENT_POLICY.format(ancestors="*" if access.embedded else "'none'")
        self._headers = {**HEADERS, "Content-Security-Policy": policy}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                outgoing = MutableHeaders(scope=message)
                for name, value in self._headers.items():
                    outgoing.setdefault(name, value)
            await send(message)

        request, answer = Request(scope), self.app
        try:
            answer = await self._admit(request) or self.app
            _check_length(request)
        except HTTPException as error:
            answer = PlainTextResponse(f"{error.detail}\n", error.status_code, error.headers)
        with contextlib.suppress(ClientDisconnect):  # before the whole body was there
            await answer(scope, receive, send_with_headers)

    async def _admit(self, request: Request) -> Response | None:
        """None lets a request in; a redirect takes the token out of its address."""
        access, headers = self.access, request.headers
        is_guarded = access.password is not None or access.token is not None
        if not is_guarded and _host_name(headers.get("host", "")) not in access.hosts:
            raise HTTPException(421, "this server does not answer under this host name")
        if request.method not in ("GET", "HEAD") and _is_cross_site(headers):
            raise HTTPException(403, "requests from other sites are refused")
        if not is_guarded:
            return None

        authorization, given, cookie = headers.get("authorization", ""), "", ""
        if access.password is not None:
            credentials = f"{access.user or ''}:{access.password}"
            if _is_same(_basic_credentials(authorization), credentials):
                return None
        if access.token is not None:
            name = COOKIE.format(port=request.scope["server"][1])
            cookie = request.cookies.get(name, "")
            if _is_same(cookie, access.token):
                return None
            given = request.query_params.get("token", "")
            if _is_same(given, access.token):
                # One slash: what follows two is another host.
                response = RedirectResponse("/" + request.scope["path"].lstrip("/"), 303)
                # Not "strict": a link that is clicked in somebody's mail would not be let in.
                # Requests of other sites that write are refused in any case.
                how: dict[str, Any] = {"httponly": True, "samesite": "lax"}
                response.set_cookie(name, access.token, max_age=30 * 86400, **how)
                return response
        if authorization or cookie or given:
            await asyncio.sleep(PAUSE_AFTER_WRONG_PASSWORD)
        asks = {"WWW-Authenticate": 'Basic realm="sb3-poem", charset="UTF-8"'}
        needs = "this page needs the link with its token, or the password, of whoever started it"
        raise HTTPException(401, needs, None if access.password is None else asks)


def _check_length(request: Request) -> None:
    """Refuse a body that is too long, or does not say how long it is."""
    length = request.headers.get("content-length", "0")
    if "transfer-encoding" in request.headers:
        raise HTTPException(411, "a request must say how long it is, by Content-Length")
    if not re.fullmatch("[0-9]{1,9}", length) or int(length) > MAX_BODY:
        raise HTTPException(413, f"a request may hold {MAX_BODY} bytes at most")


def _host_name(host: str) -> str:
    """Without the port."""
    match = re.match(r"\[[^\]]*\]|[^:]*", host)
    return match[0].lower() if match else ""


def _is_cross_site(headers: Headers) -> bool:
    site, origin = headers.get("sec-fetch-site"), headers.get("origin")
    if site is not None:
        return site not in ("same-origin", "none")
    host = headers.get("host", "").lower()
    return origin is not None and origin.partition("://")[2].lower() != host


def _basic_credentials(authorization: str) -> str:
    """``USER:PASSWORD`` of the header; nothing of another one."""
    scheme, _, credentials = authorization.partition(" ")
    try:
        decoded = base64.b64decode(credentials, validate=True).decode()
    except ValueError:  # no base64, or no UTF-8 in it
        return ""
    return decoded if scheme.lower() == "basic" else ""


def _is_same(given: str, right: str) -> bool:
    return hmac.compare_digest(given.encode("utf-8", "surrogatepass"), right.encode())


class Connection(H11Protocol):
    """A connection that ends when the server has waited too long for its client: for the rest of a
    request, for another one, or for an answer to be taken. Where there are too many, the one that
    was waited for longest ends, and none whose answer is being made: whoever sends a whole request
    at once is served, whatever else comes from their address.

    Of an answer some must be taken within thrice the deadline, in seconds.
    """

    def __init__(self, *, deadline: float = DEADLINE, **options: Any) -> None:
        super().__init__(**options)
        self.deadline = deadline
        self.network = ""
        self.since = 0.0
        self._steps = 0  # answers that were made, and parts of them that were taken
        self._state: object = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.network = network_of(self.client[0] if self.client else "")
        self._look()
        self.loop.call_later(GRACE, self._make_room)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._timer.cancel()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._steps += 1

    def resume_writing(self) -> None:
        super().resume_writing()
        self._steps += 1

    def send_400_response(self, msg: str) -> None:
        """See uvicorn, which goes on with the answer that it had begun."""
        if self.cycle is not None:
            self.cycle.disconnected = True
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            super().send_400_response(msg)
        else:
            self._end()

    def _awaited(self) -> str | None:
        """What the server waits for from the client; notes since when."""
        untaken, awaited = self.transport.get_write_buffer_size(), None
        if untaken > 0:
            awaited = "answer taken"
        elif self.conn.their_state is h11.SEND_BODY:
            awaited = "request"
        elif self.conn.their_state is h11.IDLE:
            has_begun = self.cycle is None or self.conn.trailing_data[0]
            awaited = "request" if has_begun else "another request"
        state = (awaited, self._steps, untaken)
        if state != self._state:
            self._state, self.since = state, self.loop.time()
        return awaited

    def _look(self) -> None:
        """End the connection if nothing has changed for too long, else look again."""
        awaited = self._awaited()
        limit = self.deadline * (3 if awaited == "answer taken" else 1)
        if awaited is None or self.loop.time() < self.since + limit:
            self._timer = self.loop.call_later(self.deadline / LOOKS, self._look)
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
        awaited = [one for one in crowd if one._awaited() is not None]
        if awaited:
            min(awaited, key=lambda one: one.since)._end()
        else:  # all answers are being made: this one's next request is told to come later
            self.app = service_unavailable  # type: ignore[assignment]


def network_of(host: str) -> str:
    """What counts as one address: one of IPv4, and of IPv6 a household's network of 64 bits."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host
    if isinstance(address, ipaddress.IPv4Address):
        return host
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(ipaddress.IPv6Address(int(address) >> 64 << 64))
