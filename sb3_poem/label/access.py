"""Who gets in, and with how much: host names, passwords, cross-site requests, sizes, and what a
browser may do with a page.
"""

from __future__ import annotations

import asyncio
import base64
import hmac
import ipaddress
import re
from dataclasses import dataclass, field
from urllib.parse import parse_qs

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MAX_BODY = 16 * 1024
# With the server's port, since a browser sends what one server of a host has set to all of them.
COOKIE = "sb3_poem_access_{port}"
LOOPBACK = ("localhost", "127.0.0.1", "[::1]")
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
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; media-src 'self' blob:; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors {ancestors}"
)


@dataclass(frozen=True)
class Access:
    """Who gets in.

    :param user: With ``password``, the name that a browser asks for.
    :param password: See there.
    :param token: What the first address must carry as ``?token=``; a cookie remembers it.
    :param hosts: Host names under which the server answers when neither is asked for, so that no
        foreign page can reach it by a name of its own (DNS rebinding).
    :param embedded: Whether pages of other origins may show this one in a frame (a notebook does).
    """

    user: str | None = None
    password: str | None = None
    token: str | None = None
    hosts: frozenset[str] = field(default_factory=lambda: frozenset(LOOPBACK))
    embedded: bool = False

    @property
    def is_guarded(self) -> bool:
        """Whether a password or a token is asked for."""
        return self.password is not None or self.token is not None


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address.

    :param host: A name or an address.
    :return: Whether it is loopback.
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


class Gate:
    """ASGI middleware in front of everything.

    :param app: What is behind it.
    :param access: Who gets in.
    :param max_body: Largest body of a request, bytes.
    """

    def __init__(self, app: ASGIApp, access: Access, max_body: int = MAX_BODY) -> None:
        self.app = app
        self.access = access
        self.max_body = max_body
        ancestors = "*" if access.embedded else "'none'"
        self._headers = {
            **HEADERS,
            "Content-Security-Policy": CONTENT_POLICY.format(ancestors=ancestors),
        }

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """See ASGI."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                outgoing = MutableHeaders(scope=message)
                for name, value in self._headers.items():
                    outgoing.setdefault(name, value)
            await send(message)

        refusal = await self._refusal(scope, headers)
        if refusal is not None:
            await refusal(scope, receive, send_with_headers)
            return
        body = await self._body(headers, receive) if scope["method"] not in ("GET", "HEAD") else b""
        if isinstance(body, Response):
            await body(scope, receive, send_with_headers)
            return
        if body is None:
            return
        sent = False

        async def receive_body() -> Message:
            nonlocal sent
            if sent:
                return await receive()
            sent = True
            return {"type": "http.request", "body": body, "more_body": False}

        await self.app(scope, receive_body, send_with_headers)

    async def _refusal(self, scope: Scope, headers: Headers) -> Response | None:
        if (
            not self.access.is_guarded
            and _host_name(headers.get("host", "")) not in self.access.hosts
        ):
            return PlainTextResponse("this server does not answer under this host name\n", 421)
        if scope["method"] not in ("GET", "HEAD") and _is_cross_site(headers):
            return PlainTextResponse("requests from other sites are refused\n", 403)
        if self.access.is_guarded:
            return await self._ask_who(scope, headers)
        return None

    async def _ask_who(self, scope: Scope, headers: Headers) -> Response | None:
        access, authorization = self.access, headers.get("authorization", "")
        if access.password is not None and _has_password(
            authorization, access.user or "", access.password
        ):
            return None
        given = cookies = None
        if access.token is not None:
            name = COOKIE.format(port=scope["server"][1])
            cookies = _cookies(headers, name)
            if any(_same(cookie, access.token) for cookie in cookies):
                return None
            given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
            if _same(given, access.token):
                # One slash: what follows two is another host.
                response = RedirectResponse("/" + scope["path"].lstrip("/"), 303)
                # Not "strict": a link that is clicked in somebody's mail would not be let in.
                # Requests of other sites that write are refused in any case.
                response.set_cookie(
                    name, access.token, httponly=True, samesite="lax", max_age=30 * 86400
                )
                return response
        if authorization or cookies or given:
            await asyncio.sleep(PAUSE_AFTER_WRONG_PASSWORD)
        asks = (
            {"WWW-Authenticate": 'Basic realm="sb3-poem", charset="UTF-8"'}
            if access.password is not None
            else {}
        )
        return PlainTextResponse(
            "this page needs the link with its token, or the password, of whoever started it\n",
            401,
            asks,
        )

    async def _body(self, headers: Headers, receive: Receive) -> bytes | Response | None:
        """The body; a refusal where it is too large, of which no more than the limit is read; None
        of who has left.
        """
        too_large = PlainTextResponse(f"a request may hold {self.max_body} bytes at most\n", 413)
        length = headers.get("content-length", "0")
        if not re.fullmatch("[0-9]{1,9}", length) or int(length) > self.max_body:
            return too_large
        body = b""
        while True:
            message = await receive()
            if message["type"] == "http.disconnect":
                return None
            body += message.get("body", b"")
            if len(body) > self.max_body:
                return too_large
            if not message.get("more_body", False):
                return body


def _host_name(host: str) -> str:
    return (
        host[: host.index("]") + 1]
        if host.startswith("[") and "]" in host
        else host.partition(":")[0]
    ).lower()


def _is_cross_site(headers: Headers) -> bool:
    site = headers.get("sec-fetch-site")
    if site is not None:
        return site not in ("same-origin", "none")
    origin = headers.get("origin")
    return (
        origin is not None and origin.partition("://")[2].lower() != headers.get("host", "").lower()
    )


def _has_password(authorization: str, user: str, password: str) -> bool:
    scheme, _, credentials = authorization.partition(" ")
    if scheme.lower() != "basic":
        return False
    try:
        given = base64.b64decode(credentials, validate=True).decode("utf-8")
    except ValueError:  # no base64, or no UTF-8 in it
        return False
    return _same(given, f"{user}:{password}")


def _cookies(headers: Headers, name: str) -> list[str]:
    pairs = (pair.strip().partition("=") for pair in headers.get("cookie", "").split(";"))
    return [value for key, _, value in pairs if key == name]


def _same(given: str, right: str) -> bool:
    return hmac.compare_digest(given.encode("utf-8", "surrogatepass"), right.encode("utf-8"))
