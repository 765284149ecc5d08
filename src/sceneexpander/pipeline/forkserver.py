"""Stages that start where torch is loaded already.

To load torch and what goes with it takes two to three CPU seconds, longer than many a stage works, and a run starts some thirty stages.
Here one process (this file as a program) loads it once and forks for every stage. It loads nothing of the project, so that a stage runs
the code that is there when it starts. A stage remains a process of its own: its memory, threads, environment, signals, exit code and end.

Linux only: elsewhere a process that has loaded such libraries cannot be relied on after a fork. There, and for commands that are no
stage of ours, an interpreter is started as ever.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import re
import runpy
import select
import shlex
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import asdict, dataclass
from typing import Any, NoReturn

from sceneexpander.pipeline.processes import end_with_parent

# The first is the package of the stages, which says how many threads libraries may start when they are loaded.
_SHARED = (
    "stages",
    "torch",
    "torch._dynamo",  # what the first optimiser of a process loads: a second and a half
    "cv2",
    "omegaconf",
    "safetensors.torch",
    "jaxtyping",
    "PIL.ImageCms",
    "av",
    "rich.progress",
    "scipy.linalg",
    "scipy.spatial",
    "scipy.sparse.csgraph",
)
_PROGRAM = "sceneexpander.pipeline.forkserver"
_LENGTH = struct.Struct("!I")
_LOST = 1  # exit code of a stage whose server is gone
_PLAIN = re.compile(r"(?:'[^']*'|[\w@%+=:,./ -])+", re.ASCII)  # words that mean the same to every shell, and to none

Start = Callable[[Sequence[str], socket.socket], AbstractContextManager[object]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """A stage to run: its module, its arguments, and variables of its environment beyond those of the server."""

    module: str
    arguments: tuple[str, ...]
    environment: dict[str, str]


def read_order(command: str, environment: Mapping[str, str]) -> Order | None:
    """The order that does what a command line does (``python -m stages.NAME ARGUMENT ...``); None if a fork would not do the same.

    Args:
        command: as a shell would be given it; ``python`` is this interpreter.
        environment: variables of the stage beyond those of this process and the server.
    """
    if sys.platform != "linux" or not _PLAIN.fullmatch(command):
        return None
    program, *words = shlex.split(command)
    if program != "python" or words[:1] != ["-m"] or not "".join(words[1:2]).startswith("stages."):
        return None
    return Order(module=words[1], arguments=tuple(words[2:]), environment=dict(environment))


def start_process(command: Sequence[str], door: socket.socket) -> AbstractContextManager[object]:
    """The server as a child of this process, in its group and folder and with its environment."""
    return subprocess.Popen(list(command), stdin=door.fileno())


class ForkServer:
    """Runs stages of the current folder; started with the first one. Several threads may wait for stages at once.

    Args:
        start: starts a command with a socket as its standard input, and ends it when the context ends.
    """

    def __init__(self, start: Start = start_process) -> None:
        self._start = start
        self._lock = threading.Lock()
        self._running = ExitStack()
        self._door: socket.socket | None = None
        self._origin: tuple[str, str] | None = None

    def run(self, order: Order) -> int:
        """Run a stage to its end and return its exit code; 128 + N if signal N ended it, as shells say it."""
        mine, its = os.pipe()
        with os.fdopen(mine, "rb") as answer:
            with self._lock:
                door = self._open_door()
                with contextlib.suppress(OSError):  # the server is gone: no answer comes
                    _send(door, order, its)
            os.close(its)
            text = answer.read()  # until the stage has ended, or its server
        if text:
            return int(text)
        print(f"error: {order.module}: the process that starts stages is gone", file=sys.stderr, flush=True)
        with self._lock:
            if self._door is door:
                self._close()
        return _LOST

    def close(self) -> None:
        """End the server, and with it what it runs."""
        with self._lock:
            self._close()

    def _open_door(self) -> socket.socket:
        origin = (os.getcwd(), os.environ.get("PYTHONPATH", ""))  # which say where code is found
        if self._origin != origin:
            self._close()
        if self._door is None:
            self._origin = origin
            self._door, its = socket.socketpair()
            with its:
                self._running.enter_context(self._start([sys.executable, "-m", _PROGRAM], its))
        return self._door

    def _close(self) -> None:
        if self._door is not None:
            self._door.close()
            self._door = None
        self._running.close()


def _send(door: socket.socket, order: Order, answer: int) -> None:
    data = json.dumps(asdict(order)).encode()
    socket.send_fds(door, [_LENGTH.pack(len(data))], [answer])
    door.sendall(data)


class _Server:
    """The other end; see the module."""

    def __init__(self, door: socket.socket) -> None:
        self.door = door
        self.answers: dict[int, int] = {}  # by process, where its exit code is written to
        self.woken, self._wake = os.pipe()
        for descriptor in (self.woken, self._wake):
            os.set_blocking(descriptor, False)
        signal.set_wakeup_fd(self._wake, warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)

    def wait_for_order(self) -> Order:
        """Returns in a process of its own for every order, which has to do what the order says. Ends when nobody can give any more."""
        while True:
            ready, _, _ = select.select([self.door.fileno(), self.woken], [], [])
            if self.woken in ready:
                with contextlib.suppress(BlockingIOError):
                    os.read(self.woken, 1024)
                self._note_ended()
            if self.door.fileno() in ready:
                header, descriptors, _, _ = socket.recv_fds(self.door, _LENGTH.size, 1)
                if not header or not descriptors:
                    raise SystemExit(0)
                data = self.door.recv(_LENGTH.unpack(header)[0], socket.MSG_WAITALL)
                child = os.fork()
                if not child:
                    self._leave(descriptors)
                    return Order(**json.loads(data))
                self.answers[child] = descriptors[0]

    def _note_ended(self) -> None:
        while self.answers:
            process, status = os.waitpid(-1, os.WNOHANG)
            if not process:
                return
            code = os.waitstatus_to_exitcode(status)
            if (answer := self.answers.pop(process, None)) is not None:
                with contextlib.suppress(OSError):  # nobody waits any more
                    os.write(answer, str(code if code >= 0 else 128 - code).encode())
                os.close(answer)

    def _leave(self, descriptors: Sequence[int]) -> None:
        """What a stage must not have of its server."""
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        for descriptor in (self.woken, self._wake, *descriptors, *self.answers.values()):
            os.close(descriptor)
        nothing = os.open(os.devnull, os.O_RDONLY)
        os.dup2(nothing, self.door.fileno())  # its standard input
        os.close(nothing)
        self.door.detach()


def _run(order: Order) -> NoReturn:
    os.environ.update(order.environment)
    sys.argv = [order.module, *order.arguments]
    runpy.run_module(order.module, run_name="__main__", alter_sys=True)
    raise SystemExit(0)


def main() -> None:
    """Load what stages share, then fork for every order that comes in at the standard input."""
    end_with_parent()
    interrupt: Any = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to the stage as well, which says what it does
    for name in _SHARED:
        with contextlib.suppress(ImportError):  # the stage that needs it says what is missing
            importlib.import_module(name)
    order = _Server(socket.socket(fileno=0)).wait_for_order()
    signal.signal(signal.SIGINT, interrupt)
    _run(order)


if __name__ == "__main__":
    main()
