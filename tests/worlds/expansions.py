"""A project folder, photos and a request to expand them."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from sceneexpander.cli import expand as command
from sceneexpander.cli.expand import Request
from sceneexpander.pipeline.preflight import CheckedScene

ROOT = Path(__file__).parents[2]


def picture(path: Path, shade: int = 40) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (40, 30), (shade, 90, 200 - shade)).save(path, "PNG")
    return path


def photos(folder: Path) -> Path:
    for number in range(3):
        picture(folder / f"{number}.png", 40 * number)
    return folder


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project whose pipeline does nothing, and whose check looks at the folder only."""
    folder = tmp_path / "project"
    for part in ("src", "stages", ".dvc"):
        (folder / part).mkdir(parents=True)
        (folder / part / "file").write_text("x")
    shutil.copytree(ROOT / "conf", folder / "conf")
    (folder / "params.yaml").write_text((ROOT / "params.yaml").read_text())
    monkeypatch.setattr(command, "check_scene", lambda *_, **__: CheckedScene(rounds=1))
    monkeypatch.setattr(command, "reproduce", lambda *_, **__: None)
    return folder


def everything(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def request(source: Path, tmp_path: Path, **more: Any) -> Request:
    given = {"inserted": (picture(tmp_path / "new.png", 150),), "prompts": ("A bench.",)}
    return Request(photos=source, **(given | more))


@contextmanager
def somebody_at_work(folder: Path) -> Iterator[int]:
    script = (
        "import sys, time; from pathlib import Path; from sceneexpander.pipeline.locks import run_lock\n"
        f"with run_lock(Path({str(folder)!r})): print('at work', flush=True); time.sleep(60)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", script], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "at work\n"
        yield process.pid
    finally:
        process.kill()
        process.communicate()
