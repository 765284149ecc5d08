"""A real browser without a screen, driven over its own debugging port: tests see what people see."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

_FLAGS = (
    "--headless=new",
    "--no-sandbox",  # tests run in containers, often as root
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-gpu-watchdog",  # software rendering on a busy machine is slow, not stuck
    "--hide-scrollbars",
    "--force-device-scale-factor=1",
    "--no-first-run",
    "--disable-extensions",
    "--remote-debugging-port=0",
)


def find_browser() -> str:
    """Path of a Chromium; skips the test where there is none."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        path = shutil.which(name)
        if path:
            return path
    pytest.skip("no Chromium is installed (apt-get install chromium)")


class Page:
    """One tab."""

    def __init__(self, socket: Any, patience_s: float) -> None:
        self._socket, self._patience_s = socket, patience_s
        self._last = 0
        self.requested: list[str] = []
        self.messages: list[str] = []
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and wait for its answer, noting requests and console messages on the way."""
        self._last += 1
        self._socket.send(json.dumps({"id": self._last, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=self._patience_s))
            if answer.get("id") == self._last:
                assert "error" not in answer, answer
                return dict(answer["result"])
            self._note(answer)

    def _note(self, event: dict[str, Any]) -> None:
        content = event.get("params", {})
        if event["method"] == "Network.requestWillBeSent":
            self.requested.append(content["request"]["url"])
        elif event["method"] == "Runtime.exceptionThrown":
            self.messages.append(json.dumps(content["exceptionDetails"])[:600])
        elif event["method"] == "Log.entryAdded" and content["entry"]["level"] == "error":
            self.messages.append(content["entry"]["text"])

    def open(self, address: str, width: int, height: int) -> None:
        """Load an address in a window whose inner size is exactly the given one."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        # Through a blank page: an address that differs only behind the # would not load again.
        self.call("Page.navigate", url="about:blank")
        self.call("Page.navigate", url=address)

    def value(self, expression: str) -> Any:
        """What a JavaScript expression gives."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def wait(self, expression: str, seconds: float = 120) -> Any:
        """Wait in real time until an expression is true."""
        deadline = time.monotonic() + seconds
        while not (value := self.value(expression)):
            assert time.monotonic() < deadline, f"{expression} did not come true; console: {self.messages}"
            time.sleep(0.2)
        return value

    def screenshot(self) -> Tensor:
        """RGB in [0, 1], (3, height, width)."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        with Image.open(io.BytesIO(data)) as picture:
            pixels = np.asarray(picture.convert("RGB"))
        return torch.from_numpy(pixels.copy()).permute(2, 0, 1).float() / 255


@contextlib.contextmanager
def browser_page(profile: Path, patience_s: float = 120, flags: Sequence[str] = ()) -> Iterator[Page]:
    """A tab of a fresh browser.

    Args:
        profile: a folder of its own.
        patience_s: the longest wait for one answer.
        flags: further ones; of those that are given twice the later counts.
    """
    from websockets.sync.client import connect

    command = [find_browser(), *_FLAGS, *flags, f"--user-data-dir={profile}", "about:blank"]
    with (profile.parent / "browser.log").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
    try:
        port = _debugging_port(profile, process)
        with urlopen(f"http://127.0.0.1:{port}/json/list", timeout=30) as answer:
            tabs = [tab for tab in json.load(answer) if tab["type"] == "page"]
        # No pings: a browser that renders on a busy CPU may be late to answer, and is not gone.
        with connect(tabs[0]["webSocketDebuggerUrl"], max_size=None, proxy=None, ping_interval=None) as socket:
            yield Page(socket, patience_s)
    finally:
        # Its own session: the whole family of processes goes, and nobody else's.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _debugging_port(profile: Path, process: subprocess.Popen[bytes]) -> int:
    for _ in range(600):
        with contextlib.suppress(FileNotFoundError):
            found = re.match(r"(\d+)\n", (profile / "DevToolsActivePort").read_text())
            if found:
                return int(found[1])
        assert process.poll() is None, (profile.parent / "browser.log").read_text()[-2000:]
        time.sleep(0.1)
    raise AssertionError("the browser did not open its debugging port in a minute")
