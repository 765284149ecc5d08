"""How far a run of ComfyUI is, from the messages that its server pushes over a WebSocket.

They are for people alone: without the package ``websockets``, or with a server that pushes nothing, the run goes on all the same.
"""

from __future__ import annotations

import contextlib
import json
import logging
import time
import uuid
from collections.abc import Iterator, Mapping
from typing import Any
from urllib.parse import urlsplit

logger = logging.getLogger(__name__)
_OPEN_S = 2.0
_LARGEST_MESSAGE = 64 * 2**20  # previews of large pictures come along, and are not looked at


class Steps:
    """What one client is told. ``client_id`` goes with the workflow that is queued."""

    def __init__(self, connection: Any = None, client_id: str = "") -> None:
        self.client_id = client_id
        self._connection = connection

    def wait(self, seconds: float, run: str, names: Mapping[str, str]) -> str:
        """Let that time pass; the last that was said of the run meanwhile, in words, or nothing. ``names``: of its nodes."""
        deadline, words = time.monotonic() + seconds, ""
        while self._connection is not None and (left := deadline - time.monotonic()) > 0:
            try:
                message = self._connection.recv(timeout=left)
            except TimeoutError:
                return words
            except Exception as error:  # noqa: BLE001 - whatever ends the connection, the run is asked for by HTTP anyway
                logger.debug("ComfyUI says no more of its steps (%s)", type(error).__name__)
                self._connection = None
            else:
                words = told(message, run, names) or words
        time.sleep(max(0.0, deadline - time.monotonic()))
        return words


@contextlib.contextmanager
def listening(base_url: str) -> Iterator[Steps]:
    """A client of the server, for as long as the context lasts."""
    client_id, connection = uuid.uuid4().hex, None
    address = urlsplit(base_url.rstrip("/"))
    scheme = "wss" if address.scheme == "https" else "ws"
    url = address._replace(scheme=scheme, path=f"{address.path}/ws", query=f"clientId={client_id}").geturl()
    try:
        from websockets.sync.client import connect

        connection = connect(url, open_timeout=_OPEN_S, close_timeout=_OPEN_S, max_size=_LARGEST_MESSAGE)
    except ImportError:
        logger.debug("without the package websockets nothing is said of single steps")
    except Exception as error:  # noqa: BLE001 - a server without WebSockets, or none: requests say what is wrong
        logger.debug("ComfyUI's WebSocket does not answer (%s)", type(error).__name__)
    try:
        yield Steps(connection, client_id)
    finally:
        if connection is not None:
            connection.close()


def told(message: str | bytes, run: str, names: Mapping[str, str]) -> str:
    """What a message says of the run, in words: ``KSampler: step 3 of 20``; nothing if it says nothing of it."""
    if isinstance(message, bytes):  # a preview
        return ""
    try:
        content = json.loads(message)
    except (ValueError, RecursionError):
        return ""
    data = content.get("data") if isinstance(content, dict) else None
    if not isinstance(data, dict) or data.get("prompt_id") != run or data.get("node") is None:
        return ""
    node = names.get(str(data["node"]), f"node {str(data['node'])[:40]}")
    value, most = data.get("value"), data.get("max")
    if content.get("type") == "progress" and isinstance(value, int | float) and isinstance(most, int | float):
        return f"{node}: step {value:g} of {most:g}"
    return node if content.get("type") == "executing" else ""
