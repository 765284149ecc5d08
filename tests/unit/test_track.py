"""Recording runs never fails a run, and what was not recorded is asked for again."""

from __future__ import annotations

import errno
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from sceneexpander.artifacts.store import to_plain
from sceneexpander.errors import UserError
from sceneexpander.pipeline.recording import RECORDED, Recorded, RecordedScene, ask_for_recording
from sceneexpander.tracking import TrackingConfig
from sceneexpander.tracking.store import database_path
from stages import layout, track

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (
            UserError("cannot be used", where="tracking.uri http://127.0.0.1:1"),
            "tracking.uri http://127.0.0.1:1: cannot be used",
        ),
        (
            OSError(errno.ENOSPC, "No space left on device", "/some/mlflow/file"),
            "/some/mlflow: No space left on device",
        ),
        (RuntimeError("first line\nsecond line"), "first line"),
        (ValueError(""), "ValueError"),
    ],
)
def test_what_goes_wrong_there_is_one_warning(
    error: Exception, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.chdir(tmp_path)
    (tmp_path / "params.yaml").write_text((ROOT / "params.yaml").read_text())
    (tmp_path / layout.PAGES / "courtyard").mkdir(parents=True)
    monkeypatch.setattr(track, "record_runs", fail)
    monkeypatch.setattr(track, "scene_runs", lambda *_, **__: [])
    monkeypatch.setattr(track, "read_sections", lambda *_: track.Sections(tracking=TrackingConfig()))
    monkeypatch.setattr(sys, "argv", ["track"])
    track.main()
    (line,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert said in line
    assert "second" not in line
    (scene,) = json.loads(RECORDED.read_text())["scenes"].values()
    assert scene["runs"] is None
    ask_for_recording()
    assert not RECORDED.exists(), "the next start records"


def leave_recorded(uri: str, store: str) -> None:
    RECORDED.parent.mkdir(exist_ok=True)
    scene = RecordedScene(configured=uri, store=store, runs=("key",))
    RECORDED.write_text(json.dumps(to_plain(Recorded(scenes={"room": scene}))))
    database_path(Path()).write_text("a database")


SERVER, OTHER = "http://host:5000", "http://other:5000"


@pytest.mark.parametrize(
    ("uri", "store", "shell", "kept"),
    [
        ("local", "local", None, True),
        ("local", "local", "", True),
        ("local", "local", SERVER, False),
        ("local", SERVER, SERVER, True),
        ("local", SERVER, SERVER.replace("//", "//me:secret@"), True),
        ("local", SERVER, OTHER, False),
        ("local", SERVER, None, False),
        (SERVER, SERVER, OTHER, True),
        ("off", "off", OTHER, True),
        ("local", "local", "./mlruns", False),
    ],
)
def test_runs_are_recorded_again_where_they_go_today(
    uri: str, store: str, shell: str | None, kept: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SCENEEXPANDER_ROOT", raising=False)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    if shell is not None:
        monkeypatch.setenv("MLFLOW_TRACKING_URI", shell)
    leave_recorded(uri, store)
    ask_for_recording()
    assert RECORDED.exists() == kept


def test_what_an_earlier_version_noted_is_looked_at_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    ask_for_recording()
    for content in ('{"a": ["key"], "b": []}', "[]", "not JSON"):
        RECORDED.parent.mkdir(exist_ok=True)
        RECORDED.write_text(content)
        ask_for_recording()
        assert not RECORDED.exists()


@pytest.mark.parametrize(("uri", "kept"), [("local", False), ("off", True), (SERVER, True)])
def test_a_lost_local_database_is_filled_again(
    uri: str, kept: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SCENEEXPANDER_ROOT", raising=False)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    leave_recorded(uri, uri)
    ask_for_recording()
    assert RECORDED.exists(), "the runs are there"
    database_path(Path()).unlink()
    ask_for_recording()
    assert RECORDED.exists() == kept


def test_without_git_the_commit_is_unknown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert track.commit_of(tmp_path) == "unknown"


STAGE = """
import errno, os, sys
from stages.runner import stage
sys.argv = ["prepare", "room"]
@stage("scene")
def main(cell):
    {body}
main()
"""


def stage_process(body: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    import os

    return subprocess.run(
        [sys.executable, "-c", STAGE.format(body=body)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": f"{ROOT / 'src'}:{ROOT}", **environment},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize(
    ("body", "code", "line"),
    [
        ("raise OSError(errno.ENOSPC, 'No space left on device', '/x/y')", 2, "error: /x: No space left on device"),
        ("raise RuntimeError('I/O error: No space left on device (os error 28)')", 2, "No space left on device"),
        ("raise KeyboardInterrupt", 130, ""),
    ],
)
def test_a_stage_ends_in_one_line(body: str, code: int, line: str, tmp_path: Path) -> None:
    file = tmp_path / "said.txt"
    done = stage_process(body, tmp_path, SCENEEXPANDER_ERROR_FILE=str(file))
    assert done.returncode == code
    assert "Traceback" not in done.stderr
    assert line in done.stderr
    assert len(done.stderr.splitlines()) == (code == 2)
    assert not line or line.removeprefix("error: ") in file.read_text()


def test_a_stage_ends_with_the_pipeline_that_started_it(tmp_path: Path) -> None:
    if sys.platform != "linux":
        pytest.skip("the kernel has to help")
    import os
    import signal
    import time

    body = "open('pid', 'w').write(str(os.getpid())); import time; time.sleep(60)"
    pipeline = (
        "import subprocess, sys, os\n"
        f"subprocess.Popen([sys.executable, '-c', {STAGE.format(body=body)!r}], env={{**os.environ, 'DVC_STAGE': 'prepare'}}).wait()\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", pipeline],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": f"{ROOT / 'src'}:{ROOT}"},
    )
    deadline = time.monotonic() + 60
    while not ((tmp_path / "pid").is_file() and (tmp_path / "pid").read_text()):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    stage = int((tmp_path / "pid").read_text())
    process.send_signal(signal.SIGKILL)
    process.wait()
    while True:
        try:
            os.kill(stage, 0)
            state = Path(f"/proc/{stage}/stat").read_text().rpartition(")")[2].split()[0]
        except (ProcessLookupError, FileNotFoundError):
            break
        if state == "Z":
            break
        assert time.monotonic() < deadline
        time.sleep(0.05)
