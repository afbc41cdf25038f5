"""The web server: the pages, the few requests that they make, and running it all."""

import asyncio
import contextlib
import ipaddress
import json
import logging
import re
import socket
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import jinja2
import uvicorn
from markdown_it import MarkdownIt
from markupsafe import Markup
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from sb3_poem.adaptation.policy import AdaptedPolicy
from sb3_poem.label.access import DEADLINE, Access, AccessMiddleware, Connection
from sb3_poem.label.export import session_record
from sb3_poem.label.families import GROUPS, ModelInfo, describe
from sb3_poem.label.rendering import StorageError
from sb3_poem.label.sessions import FullError, SessionManager
from sb3_poem.label.store import MAX_WISH, RefusedError, Session

_logger = logging.getLogger(__name__)

PAGE = Path(__file__).with_name("page")
#: Pictures of families, which docs/pictures.py makes
ROBOTS = PAGE / "static" / "robots"
DISK_FULL = (
    "This could not be kept: the disk of this server is full, or cannot be written. What you "
    "answered before is safe; tell whoever runs the page, and try again when there is room."
)
LOST = "There is no conversation under this link. Is it whole?"
ERROR_TITLES = {
    404: "There is nothing here",
    503: "All places are taken",
    507: "This could not be kept",
}
SAID_IN_WORDS = (HTTPException, RefusedError, FullError, StorageError)
LARGEST = 2**63 - 1  # of SQLite's whole numbers
# Addresses of nobody, to ask the system from which of its own it would speak to the world.
ELSEWHERE = {socket.AF_INET: "192.0.2.1", socket.AF_INET6: "2001:db8::1"}

SessionEndpoint = Callable[[Request, Session], Awaitable[Response]]


def make_app(
    sessions: SessionManager, access: Access | None = None, instructions: str = ""
) -> Starlette:
    """The ASGI application, which closes the sessions' queue; by default for this machine alone.

    :param instructions: Markdown, which people read before their first question; HTML in it is
        shown as it is written.
    """
    return _Pages(sessions, instructions).application(access or Access())


class _Pages:
    def __init__(self, sessions: SessionManager, instructions: str) -> None:
        self.sessions = sessions
        self.instructions = Markup(MarkdownIt("commonmark", {"html": False}).render(instructions))
        self.store = sessions.store
        self.templates = jinja2.Environment(loader=jinja2.FileSystemLoader(PAGE), autoescape=True)
        self.templates.globals |= {"instructions": self.instructions, "max_wish": MAX_WISH}

    def application(self, access: Access) -> Starlette:
        store, post = self.store, self.action
        app = Starlette(
            routes=[
                Route("/", self.start_page),
                Route("/start", self.start, methods=["POST"]),
                self.route("", self.page),
                self.route("/instructions", self.read),
                self.route("/state", self.state),
                post("/answer", store.add_answer, question=int, preference=str),
                post("/again", store.ask_again, question=int),
                post("/undo", store.undo, answered=int),
                post("/stop", store.stop, stopped=int),
                post("/verdict", store.judge, result=int, verdict=str),
                post("/wish", store.set_wish, wish=str),
                self.route("/video/{number}", self.video),
                self.route("/answers.json", self.answers),
                self.route("/policy.safetensors", self.policy),
                Mount("/static", StaticFiles(directory=PAGE / "static")),
            ],
            middleware=[Middleware(AccessMiddleware, access=access)],
            exception_handlers=dict.fromkeys(SAID_IN_WORDS, self.error),
            lifespan=self.lifespan,
        )
        app.router.redirect_slashes = False  # to http://, behind a proxy with TLS
        return app

    def route(self, path: str, endpoint: SessionEndpoint, method: str = "GET") -> Route:
        """Of requests that belong to the session of the address's token."""

        async def find_session(request: Request) -> Response:
            session = await self.sessions.find(request.path_params["token"])
            if session is None:
                await asyncio.sleep(0.05)
                raise HTTPException(404, LOST)
            return await endpoint(request, session)

        return Route(f"/s/{{token}}{path}", find_session, methods=[method])

    def action(self, path: str, change: Callable[..., object], **fields: type) -> Route:
        """Of requests whose fields change the session; the answer is what is shown next."""

        async def act(request: Request, session: Session) -> Response:
            data = await _fields(request, **fields)
            await asyncio.to_thread(change, session.id, **data)
            return await self.state(request, session)

        return self.route(path, act, "POST")

    @contextlib.asynccontextmanager
    async def lifespan(self, _: Starlette) -> AsyncIterator[None]:
        self.sessions.queue.prepare()
        yield
        await self.sessions.queue.close()

    async def start_page(self, _: Request) -> Response:
        groups: dict[str, list[ModelInfo]] = {group: [] for group in GROUPS}
        for model in self.sessions.models:
            groups[model.description.group].append(model)
        pictures = {file.stem for file in ROBOTS.iterdir()}
        return self._html("start.html", groups=groups, pictures=pictures, sessions=self.sessions)

    async def start(self, request: Request) -> Response:
        fields = parse_qs((await request.body()).decode("utf-8", "replace"))
        token = await self.sessions.begin(fields.get("model", [""])[0])
        return RedirectResponse(f"/s/{token}{'/instructions' if self.instructions else ''}", 303)

    async def read(self, request: Request, session: Session) -> Response:
        if not self.instructions:
            raise HTTPException(404, "There are no instructions.")
        await self.sessions.prepare(session)
        return self._html("instructions.html", token=request.path_params["token"])

    async def page(self, request: Request, session: Session) -> Response:
        token, description = request.path_params["token"], describe(session.env_id)
        return self._html("session.html", session=session, token=token, description=description)

    async def state(self, _: Request, session: Session) -> Response:
        return JSONResponse(await self.sessions.view(session))

    async def video(self, request: Request, session: Session) -> Response:
        number, path = request.path_params["number"], None
        if re.fullmatch("[0-9]{1,18}", number):
            path = await asyncio.to_thread(self.sessions.video, session, int(number))
        if path is None:
            raise HTTPException(404, "There is no such video.")
        # What a turn shows never changes, and only this browser may keep it.
        caching = {"Cache-Control": "private, max-age=86400, immutable"}
        return FileResponse(path, media_type="video/mp4", headers=caching)

    async def answers(self, _: Request, session: Session) -> Response:
        record = await asyncio.to_thread(session_record, self.store, session)
        text = json.dumps(record, indent=1, allow_nan=False) + "\n"
        return _download(text, "answers.json", "application/json")

    async def policy(self, _: Request, session: Session) -> Response:
        content = await asyncio.to_thread(self._adapted_policy, session)
        return _download(content, "adapted_policy.safetensors", "application/octet-stream")

    def _adapted_policy(self, session: Session) -> bytes:
        answered = len(self.store.answers(session.id))
        turn = self.store.turn(session.id, "result", answered)
        if turn is None:
            raise RefusedError("the policy can be downloaded once its result is shown")
        model = self.sessions.load(self.sessions.model_of(session))
        return AdaptedPolicy(model, json.loads(turn["latent"]), answered).to_bytes()

    async def error(self, request: Request, error: Exception) -> Response:
        """A sentence: a page for who opens one, else JSON."""
        words, status, headers = str(error), 409, None
        if isinstance(error, HTTPException):
            words, status, headers = error.detail, error.status_code, error.headers
        elif isinstance(error, StorageError):
            _logger.error("%s", error)
            words, status = DISK_FULL, 507
        elif isinstance(error, FullError):
            status, headers = 503, {"Retry-After": "60"}
        if "text/html" not in request.headers.get("accept", ""):
            return JSONResponse({"error": words}, status, headers)
        title = ERROR_TITLES.get(status, "This did not work")
        values = {"title": title, "words": words, "retry": request.method == "GET"}
        return self._html("error.html", status, headers, **values)

    def _html(
        self, name: str, status: int = 200, headers: Any = None, **values: Any
    ) -> HTMLResponse:
        return HTMLResponse(self.templates.get_template(name).render(**values), status, headers)


def _download(content: str | bytes, name: str, media_type: str) -> Response:
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return Response(content, media_type=media_type, headers=headers)


async def _fields(request: Request, **kinds: type) -> dict[str, Any]:
    """The request's JSON object, which must hold exactly the fields of these kinds."""
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        raise HTTPException(415, "the request must be application/json")
    try:
        data = json.loads(await request.body())
    except (ValueError, RecursionError):
        raise HTTPException(400, "the request is not JSON") from None
    if not isinstance(data, dict) or set(data) != set(kinds):
        names = ", ".join(kinds) or "no fields"
        raise HTTPException(400, f"the request must be a JSON object with {names}")
    for name, kind in kinds.items():
        value: Any = data[name]
        is_kind = isinstance(value, kind) and not isinstance(value, bool)
        if not is_kind or (kind is int and not 0 <= value <= LARGEST):
            what = "a whole number" if kind is int else "a text"
            raise HTTPException(400, f"`{name}` must be {what}")
        if kind is str and any("\ud800" <= character <= "\udfff" for character in value):
            raise HTTPException(400, f"`{name}` holds half a character (a lone surrogate)")
    return data


def make_server(app: Starlette, host: str, port: int, deadline: float = DEADLINE) -> uvicorn.Server:
    """A server, not yet running; ``deadline`` is how many seconds a client has for a request."""
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
    """Take a port (0: a free one) before anything else is started; who comes meanwhile waits."""
    if not 0 <= port <= 65535:
        raise ValueError(f"--port {port}: must be between 0 and 65535")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    both = family is socket.AF_INET6 and socket.has_dualstack_ipv6()
    how: dict[str, Any] = {"family": family, "backlog": 128, "dualstack_ipv6": both}
    try:
        return socket.create_server((host.strip("[]"), port), **how)
    except OSError as error:
        raise OSError(f"--host {host} --port {port}: {error.strerror or error}") from error


def link_host(listener: socket.socket, host: str) -> str:
    """The host of a link to a server; for ``0.0.0.0`` and the like one at which it is reached."""
    if not ipaddress.ip_address(listener.getsockname()[0]).is_unspecified:
        return host.strip("[]")
    for family in (listener.family, socket.AF_INET):  # an IPv6 socket takes IPv4 too
        with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((ELSEWHERE[family], 9))  # sends nothing
            return str(probe.getsockname()[0])
    return "localhost"


class BackgroundServer:
    """A server on loopback in a thread of its own; see :func:`make_server`."""

    def __init__(self, app: Starlette, port: int = 0, deadline: float = DEADLINE) -> None:
        self._listener = bind("127.0.0.1", port)
        self.port: int = self._listener.getsockname()[1]
        self._server = make_server(app, "127.0.0.1", self.port, deadline)
        run = partial(self._server.run, [self._listener])
        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()
        give_up = time.monotonic() + 10.0
        while not self._server.started:
            if not self._thread.is_alive() or time.monotonic() > give_up:
                raise RuntimeError(f"the page's server did not start on port {self.port}")
            time.sleep(0.01)

    def close(self) -> None:
        self._server.should_exit = True
        self._thread.join(timeout=10.0)
        self._listener.close()
