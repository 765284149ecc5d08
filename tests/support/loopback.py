"""An image service on this machine that plays the answers it is given, over real HTTP."""

from __future__ import annotations

import base64
import io
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np
import pytest
from PIL import Image
from websockets.datastructures import Headers
from websockets.http11 import Request
from websockets.server import ServerProtocol


@dataclass(slots=True)
class Answer:
    """One thing that the service says. ``cut``: it closes the connection after half of the body; ``wait_s``: before it says it."""

    body: bytes
    status: int = 200
    headers: dict[str, str] = field(default_factory=dict)
    content_type: str = "application/json"
    cut: bool = False
    wait_s: float = 0.0


@dataclass(slots=True)
class Asked:
    """One request that arrived."""

    method: str
    path: str
    headers: dict[str, str]
    body: bytes


class Service:
    """Answers requests one after the other from ``answers``; the last one is said again and again. ``asked`` is what arrived."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.answers: list[Answer] = []
        self.asked: list[Asked] = []
        self.route: Callable[[Asked], Answer | None] = lambda _: None
        self.pushed: list[
            str | bytes
        ] = []  # messages for everybody who opens a WebSocket; none: there are no WebSockets

    def answer(self, request: Asked) -> Answer:
        """The next one."""
        self.asked.append(request)
        found = self.route(request)
        if found is not None:
            return found
        return self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]


@contextmanager
def serving() -> Iterator[Service]:
    """A service on a free port of the loopback address."""

    class Handler(BaseHTTPRequestHandler):
        def _serve(self) -> None:
            body = self.rfile.read(int(self.headers.get("content-length") or 0))
            headers = {name.lower(): value for name, value in self.headers.items()}
            if headers.get("upgrade") == "websocket" and service.pushed:
                service.asked.append(Asked(method=self.command, path=self.path, headers=headers, body=body))
                self._push()
                return
            answer = service.answer(Asked(method=self.command, path=self.path, headers=headers, body=body))
            time.sleep(answer.wait_s)
            self.send_response(answer.status)
            for name, value in {"content-type": answer.content_type, **answer.headers}.items():
                self.send_header(name, value)
            self.send_header("content-length", str(len(answer.body)))
            self.end_headers()
            self.wfile.write(answer.body[: len(answer.body) // 2] if answer.cut else answer.body)

        def _push(self) -> None:
            protocol = ServerProtocol()
            protocol.send_response(protocol.accept(Request(self.path, Headers(self.headers.items()))))
            for message in service.pushed:
                if isinstance(message, bytes):
                    protocol.send_binary(message)
                else:
                    protocol.send_text(message.encode())
            self.wfile.write(b"".join(protocol.data_to_send()))
            self.rfile.read(2)  # until the client closes
            self.close_connection = True

        do_GET = do_POST = _serve

        def log_message(self, *_: object) -> None:
            """Say nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    service = Service(f"http://127.0.0.1:{server.server_address[1]}")
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield service
    finally:
        server.shutdown()
        server.server_close()


@pytest.fixture
def service(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Service]:
    """A service for one test; the ``KEY`` of the module, if it has one, is in the environment as TEST_KEY."""
    monkeypatch.setenv("TEST_KEY", getattr(request.module, "KEY", "a key"))
    with serving() as found:
        yield found


def drawn(seed: int, width: int = 240, height: int = 160) -> bytes:
    """A PNG of soft patches."""
    coarse = np.random.default_rng(seed).integers(0, 255, (5, 7, 3), dtype=np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC).save(buffer, format="PNG")
    return buffer.getvalue()


def picture(seed: int, **facts: Any) -> Answer:
    """What OpenAI answers with a picture."""
    return said({"created": 1, "data": [{"b64_json": base64.b64encode(drawn(seed)).decode()}], **facts})


def said(content: object, status: int = 200, **headers: str) -> Answer:
    """An answer in JSON."""
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return Answer(body=json.dumps(content).encode(), status=status, headers=named)


def error(status: int, message: str, code: str | None = None, **headers: str) -> Answer:
    """What OpenAI answers when something is wrong."""
    return said({"error": {"message": message, "type": "x", "code": code}}, status, **headers)
