"""Locks that hold between processes, and end with them however they end."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sceneexpander.errors import UserError


@contextlib.contextmanager
def file_lock(path: Path) -> Iterator[None]:
    """Hold an exclusive lock; the kernel releases it if the process dies."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        try:
            yield
        finally:
            fcntl.flock(file, fcntl.LOCK_UN)


@dataclass(frozen=True, slots=True)
class RunLock:
    """A folder that this process alone works on. ``descriptor`` keeps it so, in child processes too."""

    descriptor: int

    def note(self, *processes: int) -> None:
        """Write down which processes are at work, for the message that others get."""
        text = json.dumps({"processes": processes, "since": time.strftime("%Y-%m-%d %H:%M:%S")})
        os.ftruncate(self.descriptor, 0)
        os.pwrite(self.descriptor, text.encode(), 0)


@contextlib.contextmanager
def run_lock(folder: Path, *, what: Path | None = None) -> Iterator[RunLock]:
    """Work on ``folder`` alone, until the block ends and the last child that the descriptor was handed to is gone.

    The lock is a file beside the folder, so nothing that happens inside breaks it; the kernel releases it if the process dies.
    ``what`` is what the error names instead of the folder.

    Raises:
        UserError: somebody else is at work there.
    """
    path = folder.with_name(f".{folder.name}.lock")
    descriptor = _locked(path, folder if what is None else what, named=what is None)
    try:
        lock = RunLock(descriptor)
        lock.note(os.getpid())
        yield lock
    finally:
        if not folder.exists():  # nothing came of it: not even a lock stays
            path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                path.parent.rmdir()
        os.close(descriptor)


def _locked(path: Path, what: Path, *, named: bool) -> int:
    """An open descriptor of the lock file, which is locked. ``named``: what it guards has a name that can be chosen."""
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if path.exists() and os.path.samestat(os.fstat(descriptor), path.stat()):
                return descriptor
        except BlockingIOError:
            line = f"is being worked on by {_at_work(descriptor)}"
            os.close(descriptor)
            fix = "wait for it, end it, or choose another --name" if named else "wait for it or end it"
            raise UserError(line, where=what, fix=fix) from None
        os.close(descriptor)  # another process has taken the file away in between


def _at_work(descriptor: int) -> str:
    try:
        noted = json.loads(os.pread(descriptor, 4096, 0))
        processes = [int(process) for process in noted["processes"]]
        alive = next((process for process in processes if _is_alive(process)), processes[0])
        return f"process {alive} since {noted['since']}"
    except (ValueError, KeyError, TypeError, IndexError):
        return "another process"  # it has not written yet who it is


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
