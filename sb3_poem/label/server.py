"""The web server: the start page, the page of a conversation, and the few requests that it makes."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import re
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import jinja2
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import (
    FileResponse,
    HTMLResponse,
    JSONResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
)
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from sb3_poem.label.access import Access, Gate
from sb3_poem.label.export import session_record
from sb3_poem.label.families import describe
from sb3_poem.label.sessions import Conversations, FullError
from sb3_poem.label.store import RefusedError, Session
from sb3_poem.label.videos import StorageError

_logger = logging.getLogger(__name__)

PAGE = Path(__file__).with_name("page")
MAX_WISH = 2000
LONGEST_TOKEN = 64
DISK_FULL = (
    "This could not be kept: the disk of this server is full, or cannot be written. What you answered before is safe; "
    "tell whoever runs the page, and try again when there is room."
)
# SQLite's whole numbers.
LARGEST = 2**63 - 1


def make_app(conversations: Conversations, access: Access | None = None) -> Starlette:
    """The application.

    :param conversations: The sessions that it serves; they are closed with it.
    :param access: Who gets in; None lets in who reaches the server by a name of this machine.
    :return: An ASGI application.
    """
    return _Pages(conversations).application(Access() if access is None else access)


class _Pages:
    def __init__(self, conversations: Conversations) -> None:
        self.conversations = conversations
        self.templates = jinja2.Environment(loader=jinja2.FileSystemLoader(PAGE), autoescape=True)

    def application(self, access: Access) -> Starlette:
        routes = [
            Route("/", self.start_page),
            Route("/start", self.start, methods=["POST"]),
            Route("/s/{token}", self.page),
            Route("/s/{token}/state", self.session(self.state)),
            Route("/s/{token}/answer", self.session(self.answer), methods=["POST"]),
            Route("/s/{token}/undo", self.session(self.undo), methods=["POST"]),
            Route("/s/{token}/stop", self.session(self.stop), methods=["POST"]),
            Route("/s/{token}/verdict", self.session(self.verdict), methods=["POST"]),
            Route("/s/{token}/wish", self.session(self.wish), methods=["POST"]),
            Route("/s/{token}/video/{number}", self.session(self.video)),
            Route("/s/{token}/answers.json", self.session(self.answers)),
            Route("/s/{token}/policy.safetensors", self.session(self.policy)),
            Mount("/static", StaticFiles(directory=PAGE / "static")),
        ]
        app = Starlette(
            routes=routes,
            middleware=[Middleware(Gate, access=access)],
            exception_handlers=dict.fromkeys(
                (HTTPException, RefusedError, FullError, StorageError), _say
            ),
            lifespan=self.lifespan,
        )
        app.router.redirect_slashes = False  # to http://, behind a proxy with TLS
        return app

    @contextlib.asynccontextmanager
    async def lifespan(self, _: Starlette) -> AsyncIterator[None]:
        self.conversations.workshop.prepare()
        yield
        await self.conversations.workshop.close()

    async def start_page(self, _: Request) -> Response:
        choices = list(self.conversations.catalogue.values())
        return self._html("start.html", choices=choices, n_queries=self.conversations.n_queries)

    async def start(self, request: Request) -> Response:
        fields = parse_qs((await request.body()).decode("utf-8", "replace"))
        token = await self.conversations.begin(fields.get("model", [""])[0])
        return RedirectResponse(f"/s/{token}", 303)

    async def page(self, request: Request) -> Response:
        session = await self._find(request)
        return self._html(
            "session.html", session=session, description=describe(session.env_id), max_wish=MAX_WISH
        )

    def session(
        self, handler: Callable[[Request, Session], Awaitable[Response]]
    ) -> Callable[[Request], Awaitable[Response]]:
        """A handler of requests that belong to the session of the address's token."""

        async def handle(request: Request) -> Response:
            return await handler(request, await self._find(request))

        return handle

    async def state(self, _: Request, session: Session) -> Response:
        return JSONResponse(await self.conversations.view(session))

    async def answer(self, request: Request, session: Session) -> Response:
        data = await _fields(request, question=int, preference=str)
        await self.conversations.answer(session, data["question"], data["preference"])
        return JSONResponse(await self.conversations.view(session))

    async def undo(self, request: Request, session: Session) -> Response:
        data = await _fields(request, answered=int)
        await asyncio.to_thread(self.conversations.store.undo, session.id, data["answered"])
        return JSONResponse(await self.conversations.view(session))

    async def stop(self, request: Request, session: Session) -> Response:
        await _fields(request)
        await asyncio.to_thread(self.conversations.store.stop, session.id)
        return JSONResponse(await self.conversations.view(session))

    async def verdict(self, request: Request, session: Session) -> Response:
        data = await _fields(request, result=int, verdict=str)
        if data["verdict"] not in ("yes", "not quite"):
            raise RefusedError('a verdict must be "yes" or "not quite"')
        await asyncio.to_thread(
            self.conversations.store.judge, session.id, data["result"], data["verdict"]
        )
        return JSONResponse(await self.conversations.view(session))

    async def wish(self, request: Request, session: Session) -> Response:
        data = await _fields(request, wish=str)
        if len(data["wish"]) > MAX_WISH:
            raise RefusedError(f"what you wish for may be {MAX_WISH} characters long at most")
        await asyncio.to_thread(self.conversations.store.set_wish, session.id, data["wish"])
        return JSONResponse({})

    async def video(self, request: Request, session: Session) -> Response:
        number = re.fullmatch("[0-9]{1,18}", request.path_params["number"])
        path = (
            None
            if number is None
            else await asyncio.to_thread(self.conversations.video, session, int(number[0]))
        )
        if path is None:
            raise HTTPException(404)
        # What a turn shows never changes, and only this browser may keep it.
        return FileResponse(
            path,
            media_type="video/mp4",
            headers={"Cache-Control": "private, max-age=86400, immutable"},
        )

    async def answers(self, _: Request, session: Session) -> Response:
        record = await asyncio.to_thread(session_record, self.conversations.store, session)
        text = json.dumps(record, indent=1, allow_nan=False) + "\n"
        headers = {"Content-Disposition": 'attachment; filename="answers.json"'}
        return Response(text, media_type="application/json", headers=headers)

    async def policy(self, _: Request, session: Session) -> Response:
        content = await asyncio.to_thread(self._adapted_policy, session)
        headers = {"Content-Disposition": 'attachment; filename="adapted_policy.safetensors"'}
        return Response(content, media_type="application/octet-stream", headers=headers)

    def _adapted_policy(self, session: Session) -> bytes:
        from sb3_poem.adaptation.policy import AdaptedPolicy

        answered = len(self.conversations.store.answers(session.id))
        turn = self.conversations.store.turn(session.id, "result", answered)
        choice = self.conversations.catalogue.get(session.model)
        if turn is None or choice is None:
            raise RefusedError("the policy can be downloaded once its result is shown")
        return AdaptedPolicy(
            self.conversations.load(choice), json.loads(turn["latent"]), answered
        ).to_bytes()

    async def _find(self, request: Request) -> Session:
        token = request.path_params["token"]
        session = await self.conversations.find(token) if len(token) <= LONGEST_TOKEN else None
        if session is None:
            await asyncio.sleep(0.05)
            raise HTTPException(404, "There is no conversation under this link. Is it whole?")
        return session

    def _html(self, name: str, **values: Any) -> HTMLResponse:
        return HTMLResponse(self.templates.get_template(name).render(**values))


async def _fields(request: Request, **kinds: type) -> dict[str, Any]:
    """The request's JSON object, which must hold exactly the fields of these kinds."""
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        raise HTTPException(415, "the request must be application/json")
    try:
        data = json.loads(await request.body())
    except (ValueError, RecursionError):
        raise HTTPException(400, "the request is not JSON") from None
    if not isinstance(data, dict) or set(data) != set(kinds):
        raise HTTPException(
            400, f"the request must be a JSON object with {', '.join(kinds) or 'no fields'}"
        )
    for name, kind in kinds.items():
        if type(data[name]) is not kind or (kind is int and not 0 <= data[name] <= LARGEST):
            raise HTTPException(
                400, f"`{name}` must be {'a whole number' if kind is int else 'a text'}"
            )
        if kind is str and any("\ud800" <= character <= "\udfff" for character in data[name]):
            raise HTTPException(400, f"`{name}` holds half a character (a lone surrogate)")
    return data


async def _say(request: Request, error: Exception) -> Response:
    """A sentence: plain for who sees it as a page, else JSON."""
    words, headers = str(error), None
    if isinstance(error, HTTPException):
        words, status, headers = error.detail, error.status_code, error.headers
    elif isinstance(error, StorageError):
        _logger.error("%s", error)
        words, status = DISK_FULL, 507
    elif isinstance(error, FullError):
        status, headers = 503, {"Retry-After": "60"}
    else:
        status = 409
    if "text/html" in request.headers.get("accept", ""):
        return PlainTextResponse(f"{words}\n", status, headers)
    return JSONResponse({"error": words}, status, headers)
