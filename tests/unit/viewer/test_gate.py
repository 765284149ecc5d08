"""The live viewer, asked over a real socket: it answers its own pages and programs of this machine, and nobody else."""

from __future__ import annotations

import http.client
import socket
from collections.abc import Iterator

import pytest

from sceneexpander.errors import UserError
from sceneexpander.viewer.gate import check_authority, gate, reason_to_refuse
from tests.worlds.wall import made_reconstruction

viser = pytest.importorskip("viser")
TUNNEL = "box.example:9000"

# Host and Origin of a request, {port} being the viewer's; whether it passes.
OWN = [
    ("127.0.0.1:{port}", None),
    ("localhost:{port}", None),
    ("LocalHost:{port}", "http://LOCALHOST:{port}"),
    ("[::1]:{port}", "http://[::1]:{port}"),
    ("127.0.0.1:{port}", "http://127.0.0.1:{port}"),
    ("127.0.0.1:{port}", "http://localhost:{port}"),
    (TUNNEL, "https://" + TUNNEL),
]
FOREIGN = [
    ("127.0.0.1:{port}", "http://evil.example"),
    ("127.0.0.1:{port}", "http://evil.example:{port}"),
    ("127.0.0.1:{port}", "http://127.0.0.1"),
    ("127.0.0.1:{port}", "http://127.0.0.1:1"),
    ("127.0.0.1:{port}", "http://127.0.0.1:{port}.evil.example"),
    ("127.0.0.1:{port}", "http://evil.example/http://127.0.0.1:{port}"),
    ("127.0.0.1:{port}", "http://user@127.0.0.1:{port}"),
    ("127.0.0.1:{port}", "null"),
    ("127.0.0.1:{port}", "file://"),
    ("127.0.0.1:{port}", ""),
    ("evil.example", None),
    ("evil.example:{port}", None),
    ("evil.example:{port}", "http://evil.example:{port}"),
    ("evil.example:{port}", "http://127.0.0.1:{port}"),
    ("127.0.0.1.evil.example:{port}", None),
    ("127.0.0.1", None),
    ("127.0.0.1:1", None),
    ("0.0.0.0:{port}", None),
    ("box.example", None),
    ("", None),
]


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    from sceneexpander.viewer.live import LiveViewer

    viewer = LiveViewer([made_reconstruction()], {}, title="room", port=0, limit=10**6, hosts=[TUNNEL])
    yield viewer.port
    viewer.stop()


def status(port: int, headers: list[tuple[str, str]], *, upgrade: bool) -> int:
    """Status of a request with exactly these headers; of a WebSocket's handshake with ``upgrade``."""
    if upgrade:
        headers = [*headers, ("Upgrade", "websocket"), ("Connection", "Upgrade"), ("Sec-WebSocket-Version", "13")]
        headers += [
            ("Sec-WebSocket-Key", "dGhlIHNhbXBsZSBub25jZQ=="),
            ("Sec-WebSocket-Protocol", f"viser-v{viser.__version__}"),
        ]
    text = "GET / HTTP/1.1\r\n" + "".join(f"{name}: {value}\r\n" for name, value in headers) + "\r\n"
    with socket.create_connection(("127.0.0.1", port), timeout=20) as connection:
        connection.sendall(text.encode())
        answer = http.client.HTTPResponse(connection)
        answer.begin()
        return answer.status


def headers_of(host: str, origin: str | None, port: int) -> list[tuple[str, str]]:
    named = [("Host", host)] + ([] if origin is None else [("Origin", origin)])
    return [(name, value.format(port=port)) for name, value in named]


@pytest.mark.parametrize("upgrade", [False, True], ids=["page", "websocket"])
@pytest.mark.parametrize(("host", "origin"), OWN)
def test_its_own_pages_and_local_programs_are_answered(port: int, host: str, origin: str | None, upgrade: bool) -> None:
    assert status(port, headers_of(host, origin, port), upgrade=upgrade) == (101 if upgrade else 200)


@pytest.mark.parametrize("upgrade", [False, True], ids=["page", "websocket"])
@pytest.mark.parametrize(("host", "origin"), FOREIGN)
def test_foreign_pages_and_names_are_refused(port: int, host: str, origin: str | None, upgrade: bool) -> None:
    assert status(port, headers_of(host, origin, port), upgrade=upgrade) == 403


@pytest.mark.parametrize("upgrade", [False, True], ids=["page", "websocket"])
@pytest.mark.parametrize("doubled", ["Host", "Origin"])
def test_a_second_value_beside_a_good_one_is_refused(port: int, doubled: str, upgrade: bool) -> None:
    good = headers_of("127.0.0.1:{port}", "http://127.0.0.1:{port}", port)
    evil = {"Host": "evil.example", "Origin": "http://evil.example"}[doubled]
    assert status(port, [*good, (doubled, evil)], upgrade=upgrade) == 403
    assert status(port, [(doubled, evil), *good], upgrade=upgrade) == 403


def test_a_request_without_a_host_is_refused(port: int) -> None:
    assert status(port, [], upgrade=False) == 403
    assert status(port, [], upgrade=True) == 403


def test_the_usual_port_is_left_out_by_browsers() -> None:
    assert reason_to_refuse(["localhost"], ["http://localhost"], 80, ()) is None
    assert reason_to_refuse(["localhost"], [], 8080, ())


def test_a_server_that_was_not_caught_is_an_error_and_nothing_stays_patched() -> None:
    from websockets.asyncio import server as library

    before = library.serve
    with pytest.raises(RuntimeError, match="foreign pages could reach"), gate(()):
        pass
    assert library.serve is before


@pytest.mark.parametrize(
    "name", ["", "http://box", "box/path", "user@box", "box:", "box:port", "box:65536", "*", "a b", "bü.example", ":80"]
)
def test_a_name_to_answer_to_is_a_name(name: str) -> None:
    with pytest.raises(UserError, match="NAME:PORT"):
        check_authority(name)


@pytest.mark.parametrize("name", ["box", "Box.Example:80", "[fe80::1]", "[fe80::1]:8080", "10.0.0.7:9000"])
def test_names_are_taken_in_small_letters(name: str) -> None:
    assert check_authority(name) == name.lower()
