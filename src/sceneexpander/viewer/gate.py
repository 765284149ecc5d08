"""Who may talk to the live viewer: pages that it served itself, and programs on this machine.

A server on the loopback address is within reach of every page that is open in a browser here. Two things tell such a page from ours:
a browser says which page a WebSocket is opened from (``Origin``), and which name it was told for the server (``Host``), which after
a DNS rebinding is the name of the foreign site. viser looks at neither.
"""

from __future__ import annotations

import contextlib
import http
from collections.abc import Iterator, Sequence
from typing import Any

from sceneexpander.errors import UserError

LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
_DEFAULT_PORT = 80  # left out by browsers
_SCHEMES = ("http://", "https://")


def check_authority(text: str) -> str:
    """``NAME`` or ``NAME:PORT`` as an address bar shows it, in small letters.

    Raises:
        UserError: it is something else, such as a whole address.
    """
    name, colon, port = text.rpartition(":") if text.rfind(":") > text.rfind("]") else (text, "", "")
    plain = name.isascii() and name.isprintable() and not set(name) & set(" /@?#,*\\")
    if not name or not plain or (colon and not (port.isascii() and port.isdecimal() and int(port[:6]) < 65536)):
        raise UserError(
            f"is {text!r}", where="--allow-host", fix="give NAME or NAME:PORT, without http:// and without a path"
        )
    return text.lower()


def reason_to_refuse(
    hosts: Sequence[str], origins: Sequence[str], port: int, allowed: Sequence[str], *, server: str = "viewer"
) -> str | None:
    """Why a request is refused, or None if it may pass.

    Args:
        hosts: values of its Host headers.
        origins: values of its Origin headers; programs that are no browsers send none.
        port: on which it came in.
        allowed: names besides the loopback ones, as `check_authority` gives them.
        server: what it is called in the answer.
    """
    own = {f"{name}:{port}" for name in LOOPBACK_NAMES} | set(allowed)
    if port == _DEFAULT_PORT:
        own |= set(LOOPBACK_NAMES)
    if len(hosts) != 1 or hosts[0].lower() not in own:
        return f"this {server} does not answer to the name {', '.join(hosts) or 'that is missing'}"
    if len(origins) > 1:
        return "a page has one origin"
    for origin in origins:
        authorities = {origin.lower().removeprefix(scheme) for scheme in _SCHEMES if origin.lower().startswith(scheme)}
        if not authorities & own:
            return f"pages of {origin} may not talk to this {server}"
    return None


@contextlib.contextmanager
def gate(allowed: Sequence[str]) -> Iterator[None]:
    """A viser server that is started inside refuses foreign hosts and origins with 403, pages and WebSockets alike.

    viser has no setting for that, so its call of the WebSocket library is caught on the way. If that call was not made by the end of
    the context the server would be open: an error says so.
    """
    from websockets.asyncio import server as library

    module: Any = library
    real, caught = module.serve, list[bool]()

    def guarded(*args: Any, process_request: Any = None, **kwargs: Any) -> Any:
        def ask(connection: Any, request: Any) -> Any:
            headers, port = request.headers, connection.local_address[1]
            reason = reason_to_refuse(headers.get_all("Host"), headers.get_all("Origin"), port, allowed)
            if reason is not None:
                text = f"{reason}; open http://127.0.0.1:{port}/, or start it with --allow-host\n"
                return connection.respond(http.HTTPStatus.FORBIDDEN, text)
            return None if process_request is None else process_request(connection, request)

        caught.append(True)
        return real(*args, process_request=ask, **kwargs)

    module.serve = guarded
    try:
        yield
    finally:
        module.serve = real
    if not caught:
        raise RuntimeError(
            "this version of viser starts its server in another way: foreign pages could reach the viewer"
        )
