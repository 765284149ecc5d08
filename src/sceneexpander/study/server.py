"""The server of a study: each participant's page, videos and answers, for whoever has the participant's link.

There are no cookies and no accounts: the token in the address is all the authority there is, so a foreign page cannot act in a
participant's name. Requests that name another host or come from another origin are refused before anything else.
"""

from __future__ import annotations

import hashlib
import socket
from collections.abc import Awaitable, Callable, MutableMapping, Sequence
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import Depends, FastAPI, HTTPException, Request
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse, PlainTextResponse, Response
from fastapi.telemetry import TelemetryConfig
from pydantic import BaseModel, ConfigDict, Field
from starlette.datastructures import MutableHeaders

from sceneexpander.artifacts.store import to_plain
from sceneexpander.errors import UserError
from sceneexpander.study.document import ANSWERS_NAME, Participant, Study
from sceneexpander.study.spec import MOST_METHODS
from sceneexpander.study.store import AnswerStore, RefusedError
from sceneexpander.viewer.gate import reason_to_refuse

MOST_BYTES = 16 * 1024  # of a request
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",  # not no-referrer: browsers would then hide the origin of our own requests
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Robots-Tag": "noindex",
}
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class Nothing(_Body):
    """A request that says no more than its address."""


class OpenedScreen(_Body):
    """A screen was shown."""

    screen: str = Field(max_length=16)


class GivenAnswer(_Body):
    """Ranks of the videos of a screen, 1 for the best."""

    screen: str = Field(max_length=16)
    ranks: dict[str, int] = Field(max_length=MOST_METHODS)


class _Gate:
    """Refuses foreign hosts and origins, and bodies without a length or with too much of one; gives every answer its headers."""

    def __init__(self, app: Any, allowed: Sequence[str]) -> None:
        self._app = app
        self._allowed = allowed

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        answer = self._refusal(scope) if scope["type"] == "http" else PlainTextResponse("no\n", 403)

        async def protected(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.update(_HEADERS)
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        await (self._app if answer is None else answer)(scope, receive, protected)

    def _refusal(self, scope: Message) -> Response | None:
        def headers(wanted: bytes) -> list[str]:
            return [value.decode("latin-1") for name, value in scope["headers"] if name == wanted]

        port = (scope.get("server") or ("", 0))[1]
        reason = reason_to_refuse(headers(b"host"), headers(b"origin"), port, self._allowed, server="study")
        if reason is not None:
            return PlainTextResponse(f"{reason}; whoever serves it can allow a name with --allow-host\n", 403)
        if scope["method"] in ("GET", "HEAD"):
            return None
        lengths = headers(b"content-length")
        if len(lengths) != 1 or not lengths[0].isdecimal():
            return PlainTextResponse("the length is missing\n", 411)
        if len(lengths[0]) > 9 or int(lengths[0]) > MOST_BYTES:
            return PlainTextResponse("too much\n", 413)
        # What forms of foreign pages can send without asking is never JSON.
        if headers(b"content-type") != ["application/json"]:
            return PlainTextResponse("not JSON\n", 415)
        return None


def make_app(study: Study, folder: Path, store: AnswerStore, hosts: Sequence[str] = ()) -> FastAPI:
    """The server as an ASGI application.

    Args:
        study: as built, in ``folder``.
        folder: with pages and videos.
        store: of the answers.
        hosts: names besides the loopback ones that it answers to, as `check_authority` gives them.
    """
    # Addresses hold tokens, and nothing about participants leaves this machine: no traces of requests, whatever the environment asks for.
    silent: TelemetryConfig = {
        "tracing": False,
        "metrics": False,
        "logs": False,
        "operation_spans": False,
        "auto_configure": False,
    }
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None, telemetry=silent)
    app.add_middleware(_Gate, allowed=tuple(hosts))
    by_token = {participant.token_sha256: participant for participant in study.participants}

    def known(token: str) -> Participant:
        found = by_token.get(hashlib.sha256(token.encode()).hexdigest())
        if found is None:
            raise HTTPException(404, "no study has this link; please check that it was copied whole")
        return found

    # FastAPI reads annotations of the functions below from their module, where a local name is unknown: hence defaults.
    who = Depends(known)

    @app.exception_handler(RefusedError)
    def refuse(_: Request, error: RefusedError) -> JSONResponse:
        return JSONResponse({"detail": error.reason, "wait_s": error.wait_s}, error.status)

    @app.get("/")
    def root() -> PlainTextResponse:
        return PlainTextResponse("A study is held here. Please open the link that you were given.\n")

    @app.get("/p/{token}/")
    def page(participant: Participant = who) -> HTMLResponse:
        return HTMLResponse((folder / "pages" / f"{participant.name}.html").read_bytes())

    @app.get("/p/{token}/videos/{name}.mp4")
    def video(name: str, participant: Participant = who) -> FileResponse:
        if not any(name in screen.videos for screen in participant.screens):
            raise HTTPException(404, "no such video")
        path = folder / "videos" / f"{name}.mp4"
        return FileResponse(path, media_type="video/mp4", headers={"Cache-Control": "private, max-age=86400"})

    @app.get("/p/{token}/api/state")
    def state(participant: Participant = who) -> JSONResponse:
        return JSONResponse(to_plain(store.progress(participant)))

    @app.post("/p/{token}/api/consent")
    def consent(_: Nothing, participant: Participant = who) -> JSONResponse:
        return JSONResponse(to_plain(store.consent(participant)))

    @app.post("/p/{token}/api/open")
    def open_screen(body: OpenedScreen, participant: Participant = who) -> JSONResponse:
        return JSONResponse(to_plain(store.open_screen(participant, body.screen)))

    @app.post("/p/{token}/api/answer")
    def answer(body: GivenAnswer, participant: Participant = who) -> JSONResponse:
        return JSONResponse(to_plain(store.submit(participant, body.screen, body.ranks)))

    @app.post("/p/{token}/api/withdraw")
    def withdraw(_: Nothing, participant: Participant = who) -> JSONResponse:
        return JSONResponse(to_plain(store.withdraw(participant)))

    return app


def bind(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 is any free one. Raises `UserError` if the address cannot be used."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
    except OSError as error:
        listener.close()
        reason = error.strerror or str(error)
        raise UserError(f"port {port} cannot be opened ({reason})", where=host, fix="choose another --port") from None
    return listener


def make_server(folder: Path, hosts: Sequence[str] = ()) -> uvicorn.Server:
    """A server of the study in a folder, after comparing all its files with their digests; run it with a socket of `bind`.

    Raises:
        UserError: the study or its answers are damaged.
    """
    study = Study.load(folder, files=True)
    app = make_app(study, folder, AnswerStore(folder / ANSWERS_NAME, study), hosts)
    # Addresses hold tokens: they are not written into a log. What proxies say about clients is of no use here.
    config = uvicorn.Config(
        app, access_log=False, log_level="warning", proxy_headers=False, server_header=False, lifespan="off"
    )
    return uvicorn.Server(config)
