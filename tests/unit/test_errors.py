"""How programs end: one line for what the user can mend, a full disk and an interrupt among it."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from safetensors import SafetensorError

from sceneexpander.errors import UserError, disk_full, entry_point

ROOT = Path(__file__).parents[2]


def chained(cause: BaseException) -> RuntimeError:
    error = RuntimeError("could not be saved")
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "named"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "/some/folder/file"), "/some/folder"),
        (OSError(errno.ENOSPC, "No space left on device", "/from/file", None, "/some/folder/file"), "/some/folder"),
        (OSError(errno.EDQUOT, "Disk quota exceeded", "/some/folder/file"), "/some/folder"),
        (OSError(errno.ENOSPC, "No space left on device"), ""),
        (SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)"), ""),
        (chained(OSError(errno.ENOSPC, "No space left on device", "/some/folder/file")), "/some/folder"),
        (RuntimeError("(sqlite3.OperationalError) database or disk is full"), ""),
    ],
)
def test_a_full_disk_is_one_line(error: Exception, named: str, capsys: pytest.CaptureFixture[str]) -> None:
    @entry_point
    def main() -> None:
        raise error

    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {named or Path.cwd()}: ")
    assert "start the same command again" in line


@pytest.mark.parametrize("error", [OSError(errno.EACCES, "no"), ValueError("full of errors"), KeyError(28)])
def test_other_errors_are_not_taken_for_it(error: Exception) -> None:
    assert disk_full(error) is None

    @entry_point
    def main() -> None:
        raise error

    with pytest.raises(type(error)):
        main()


def ends(stop: Callable[[], None], capsys: pytest.CaptureFixture[str]) -> tuple[object, str]:
    with pytest.raises(SystemExit) as caught:
        entry_point(stop)()
    return caught.value.code, capsys.readouterr().err


def test_an_interrupt_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    assert ends(stop, capsys) == (130, "interrupted\n")


def test_a_user_error_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    def stop() -> None:
        raise UserError("is bad", where="a\nb", fix="mend it")

    assert ends(stop, capsys) == (2, "error: a\\nb: is bad; mend it\n")


def test_an_interrupt_while_libraries_are_imported_is_one_line_too(tmp_path: Path) -> None:
    # Stands for torch, which takes seconds.
    (tmp_path / "yaml.py").write_text("print('importing', flush=True)\nimport time\ntime.sleep(30)\n")
    process = subprocess.Popen(
        [sys.executable, "-m", "sceneexpander.cli.expand", "x"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT / "src")])},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Python turns SIGINT into KeyboardInterrupt only where it is not ignored, and background jobs inherit that it is.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "importing\n"
    time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=20)
    assert (process.returncode, errors) == (130, "interrupted\n")


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_what_a_terminal_cannot_show_does_not_matter(encoding: str) -> None:
    script = (
        "from sceneexpander.errors import *\n"
        "@entry_point\n"
        "def main():\n    print('写真 \\udcff'); raise UserError('is bad', where='写真')\n"
        "main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONPATH": str(ROOT / "src"), "PYTHONIOENCODING": encoding},
        capture_output=True,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith(b"error: ")
    assert done.stderr.count(b"\n") == 1
