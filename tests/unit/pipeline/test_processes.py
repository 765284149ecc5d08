"""No child outlives who started it, however that one ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from sceneexpander.pipeline.processes import kept, run_group

ROOT = Path(__file__).parents[3]
# Starts a grandchild, writes down who they are, and then does what is asked for.
CHILD = (
    "import os, subprocess, sys, time; p = subprocess.Popen(['sleep', '60']); "
    "open('pids', 'w').write(f'{os.getpid()} {p.pid}'); "
)
WAITS = f"{CHILD}time.sleep(60)"
PARENT = """
import sys
from collections.abc import Callable
from pathlib import Path
sys.path.insert(0, {src!r})
from sceneexpander.errors import entry_point
from sceneexpander.pipeline.processes import run_group
@entry_point
def main():
    raise SystemExit(run_group([sys.executable, "-c", {child!r}], cwd=Path.cwd()))
main()
"""


def gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    status = Path(f"/proc/{pid}/stat")
    return status.exists() and status.read_text().rpartition(")")[2].split()[0] == "Z"


def wait_for(what, seconds: float = 15.0) -> bool:  # type: ignore[no-untyped-def]
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if what():
            return True
        time.sleep(0.02)
    return bool(what())


def hear_signals() -> None:
    """Undo what a shell's background job or `nohup` hands down: ignored signals are inherited."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def started(folder: Path, child: str = WAITS, before: Callable[[], object] = hear_signals) -> subprocess.Popen[str]:
    script = PARENT.format(src=str(ROOT / "src"), child=child)
    process = subprocess.Popen(
        [sys.executable, "-c", script],
        cwd=folder,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=before,
    )
    assert wait_for(lambda: (folder / "pids").is_file() and len((folder / "pids").read_text().split()) == 2)
    return process


def pids(folder: Path) -> list[int]:
    return [int(pid) for pid in (folder / "pids").read_text().split()]


@pytest.mark.parametrize(
    ("number", "code"),
    [
        (signal.SIGTERM, 128 + signal.SIGTERM),
        (signal.SIGHUP, 128 + signal.SIGHUP),
        (signal.SIGINT, 130),
        (signal.SIGKILL, -signal.SIGKILL),
    ],
)
def test_everything_ends_with_the_parent(number: signal.Signals, code: int, tmp_path: Path) -> None:
    process = started(tmp_path)
    children = pids(tmp_path)
    process.send_signal(number)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == code
    assert "Traceback" not in errors
    assert errors == ("interrupted\n" if number == signal.SIGINT else "")
    assert wait_for(lambda: all(gone(pid) for pid in children))


def test_who_does_not_listen_is_ended_too(tmp_path: Path) -> None:
    deaf = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); " + WAITS
    process = started(tmp_path, deaf)
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=30)
    assert wait_for(lambda: all(gone(pid) for pid in pids(tmp_path)))


def test_what_a_command_leaves_behind_ends_with_it(tmp_path: Path) -> None:
    child = f"{CHILD}sys.exit(3)"
    assert run_group([sys.executable, "-c", child], cwd=tmp_path) == 3
    assert gone(pids(tmp_path)[1])


def test_a_command_that_is_killed_takes_its_children_along(tmp_path: Path) -> None:
    child = f"{CHILD}os.kill(os.getpid(), 9)"
    assert run_group([sys.executable, "-c", child], cwd=tmp_path) == 128 + signal.SIGKILL
    assert gone(pids(tmp_path)[1])


def test_the_end_of_the_block_is_the_end_of_the_command(tmp_path: Path) -> None:
    with kept([sys.executable, "-c", WAITS], cwd=tmp_path) as process:
        assert wait_for(lambda: (tmp_path / "pids").is_file() and len((tmp_path / "pids").read_text().split()) == 2)
        assert process.poll() is None
    assert all(gone(pid) for pid in pids(tmp_path))


def test_nohup_keeps_it_running(tmp_path: Path) -> None:
    process = started(tmp_path, before=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN))
    process.send_signal(signal.SIGHUP)
    time.sleep(0.5)
    assert process.poll() is None
    process.terminate()
    process.communicate(timeout=20)


def test_output_and_environment_pass_through(tmp_path: Path) -> None:
    child = "import os; print(os.environ['GIVEN'])"
    code = f"""
import sys
from collections.abc import Callable
from pathlib import Path
from sceneexpander.pipeline.processes import run_group
run_group([sys.executable, "-c", {child!r}], cwd=Path.cwd(), env={{"GIVEN": "hello"}})
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT / "src")},
        text=True,
        capture_output=True,
        check=True,
    )
    assert done.stdout == "hello\n"
