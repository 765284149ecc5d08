"""Programs that end together: no child outlives who started it, however that one ends.

A command is started through a keeper (this file as a program), a small process in a session of its own.
The keeper ends the command with everything that it started as soon as it is told to, or its parent is gone: a closed terminal, `kill`
and even ``kill -9`` leave nothing running. It also holds the locks of its parent until the last of them is gone.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

GRACE_S = 5.0  # between asking a group to end and ending it
_LOOK_S = 0.2  # between looks at whether the parent is still there; Linux tells at once
_ENDING = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36


def end_with_parent() -> None:
    """Have the kernel end this process when its parent ends. Linux only: elsewhere nothing happens."""
    _prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _prctl(option: int, value: int) -> None:
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


@contextlib.contextmanager
def kept(
    command: Sequence[str],
    *,
    cwd: Path,
    env: Mapping[str, str] | None = None,
    held: Sequence[int] = (),
    stdin: socket.socket | None = None,
) -> Iterator[subprocess.Popen[bytes]]:
    """A running command that ends, with all that it started, at the end of the block at the latest.

    Args:
        command: program and arguments.
        cwd: its folder.
        env: its environment; None: this process's.
        held: descriptors of lock files that stay locked until the last process of the command is gone.
        stdin: its standard input; None: this process's.
    """
    # Isolated (-I): the keeper needs the standard library only, and no variable of the shell changes it.
    keeper = [sys.executable, "-I", str(Path(__file__)), str(os.getpid()), *command]
    process = subprocess.Popen(
        keeper,
        cwd=cwd,
        env=None if env is None else dict(env),
        start_new_session=True,
        pass_fds=tuple(held),
        stdin=None if stdin is None else stdin.fileno(),
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.terminate()
            # A second Ctrl-C must not leave the command behind; the keeper needs no more than the time of grace.
            while True:
                try:
                    process.wait()
                    break
                except KeyboardInterrupt:
                    continue


def run_group(
    command: Sequence[str], *, cwd: Path, env: Mapping[str, str] | None = None, held: Sequence[int] = ()
) -> int:
    """Run a command to its end and return its exit code. When this process ends before, in whichever way, so does the command."""
    with ended_by_signals(), kept(command, cwd=cwd, env=env, held=held) as process:
        return process.wait()


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Within the block SIGTERM and SIGHUP (a closed terminal) end this process by way of its ``finally`` clauses.

    A signal that is ignored stays so: that is how ``nohup`` works.
    """
    previous = {}
    try:
        for number in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) != signal.SIG_IGN:
                previous[number] = signal.signal(number, _leave)
    except ValueError:  # not the main thread: who started the thread has to see to it
        pass
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _leave(number: int, _: object) -> None:
    raise SystemExit(128 + number)


class _Keeper:
    """Runs a command in a process group of its own; see the module."""

    def __init__(self, parent: int) -> None:
        self.parent = parent
        self.asked = False

    def run(self, command: Sequence[str]) -> int:
        for number in _ENDING:
            signal.signal(number, self._ask)
        _prctl(_PR_SET_CHILD_SUBREAPER, 1)  # what loses its parent becomes a child of the keeper
        end_with_parent()
        child = subprocess.Popen(list(command), process_group=0, preexec_fn=end_with_parent)
        code = self._wait(child)
        self._end(child)
        return code

    def _ask(self, number: int, _: object) -> None:
        self.asked = True

    def _wait(self, child: subprocess.Popen[bytes]) -> int:
        while not self.asked and os.getppid() == self.parent:
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = child.wait(_LOOK_S)
                return code if code >= 0 else 128 - code
        return 128 + signal.SIGTERM

    def _end(self, child: subprocess.Popen[bytes]) -> None:
        """End what is left of the command's group."""
        for number, patience in ((signal.SIGTERM, GRACE_S), (signal.SIGKILL, GRACE_S)):
            deadline = time.monotonic() + patience
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(child.pid, number)
            while _is_there(child) and time.monotonic() < deadline:
                time.sleep(0.02)


def _is_there(child: subprocess.Popen[bytes]) -> bool:
    child.poll()
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-child.pid, os.WNOHANG)[0]:
            pass
    try:
        os.killpg(child.pid, 0)
    except (ProcessLookupError, PermissionError):
        return False
    return True


def main() -> None:
    """Command line of the keeper."""
    parent, *command = sys.argv[1:]
    raise SystemExit(_Keeper(int(parent)).run(command))


if __name__ == "__main__":
    main()
