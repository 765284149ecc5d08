"""With what is remembered DVC says what it says without, whatever has changed in between."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sceneexpander.pipeline import dvc_adapter, dvc_memory
from sceneexpander.pipeline.dvc_memory import MEMORY_FILE

STAGES = """
stages:
  make:
    matrix: {scene: "${scenes}"}
    cmd: >-
      cd made && mkdir -p '${item.scene}/below' && cp ../settings.json '${item.scene}' &&
      cp '../in/${item.scene}' '${item.scene}/below/copy'
    deps: ["in/${item.scene}"]
    params:
      - settings.json: [rate, nested.words]
    outs: ["made/${item.scene}"]
  gather:
    cmd: ls made > all
    deps: [made]
    outs: [all]
"""
SETTINGS = '{"rate": 1e-05, "nested": {"words": ["yes", "012", "1e-05", "~"], "more": 1}}'
NAMES = ["one", "y", "12", "a #b"]  # which YAML writes in several ways


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    from dvc.repo import Repo

    Repo.init(tmp_path, no_scm=True)
    (tmp_path / "dvc.yaml").write_text(STAGES)
    (tmp_path / "params.yaml").write_text(f"scenes: {NAMES}")
    (tmp_path / "settings.json").write_text(SETTINGS)
    (tmp_path / "in").mkdir()
    (tmp_path / "made").mkdir()
    for name in NAMES:
        (tmp_path / "in" / name).write_text(f"text of {name}")
    monkeypatch.chdir(tmp_path)
    assert dvc_adapter.reproduce(["--quiet"]) == 0
    return tmp_path


def status_with_memory(capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert dvc_adapter.report_status([]) == 0
    return capsys.readouterr().out


def status_without(capsys: pytest.CaptureFixture[str]) -> str:
    from dvc.cli import main

    capsys.readouterr()
    assert main(["status"]) == 0
    return capsys.readouterr().out


def edit(path: str, text: str) -> Callable[[Path], Any]:
    return lambda folder: (folder / path).write_text(text)


CHANGES: dict[str, Callable[[Path], Any]] = {
    "nothing": lambda folder: None,
    "same size": edit("made/one/below/copy", "texd of one"),
    "another file": edit("made/y/new", "x"),
    "a file less": lambda folder: (folder / "made/12/settings.json").unlink(),
    "another name": lambda folder: (folder / "made/12/settings.json").rename(folder / "made/12/settings.jsonl"),
    "no folder": lambda folder: shutil.rmtree(folder / "made/a #b"),
    "a file in place of a folder": lambda folder: (shutil.rmtree(folder / "made/one"), edit("made/one", "x")(folder)),
    "an input": edit("in/12", "another text"),
    "a parameter": edit("settings.json", SETTINGS.replace("1e-05,", "1e-04,")),
    "a nested parameter": edit("settings.json", SETTINGS.replace("012", "013")),
    "a parameter that nobody reads": edit("settings.json", SETTINGS.replace(": 1}", ": 2}")),
    "no parameter": edit("settings.json", '{"rate": 1e-05}'),
    "the lock": lambda folder: edit(
        "dvc.lock", (folder / "dvc.lock").read_text().replace("rate: 1e-05", "rate: 2e-05")
    )(folder),
    "the cache": lambda folder: shutil.rmtree(folder / ".dvc" / "cache"),
    "what is ignored": edit(".dvcignore", "copy\n"),
    "a damaged memory": edit(str(MEMORY_FILE), '{"form": 1, "stages": [3], "folders": {"a": 7}}'),
}


def test_entries_of_another_shape_are_read_again(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status_with_memory(capsys)
    known = json.loads(MEMORY_FILE.read_text())
    for part in ("stages", "folders"):
        known[part] = dict.fromkeys(known[part], 7)
    MEMORY_FILE.write_text(json.dumps(known))
    assert "up to date" in status_with_memory(capsys)


@pytest.mark.parametrize("change", CHANGES)
def test_the_status_is_that_of_dvc(change: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "up to date" in status_with_memory(capsys)
    CHANGES[change](folder)
    expected = status_without(capsys)
    assert ("up to date" in expected) == (change in {"nothing", "a parameter that nobody reads", "a damaged memory"})
    assert status_with_memory(capsys) == expected
    assert status_with_memory(capsys) == expected


def test_what_is_remembered_is_not_read_again(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from dvc import dvcfile, output
    from dvc.utils import serialize

    status_with_memory(capsys)
    built, parsed = [], []
    build, parse = output.Output._build, serialize.parse_yaml
    monkeypatch.setattr(
        output.Output, "_build", lambda self, *a, **k: built.append(self.fs_path) or build(self, *a, **k)
    )
    monkeypatch.setattr(serialize, "parse_yaml", lambda text, *a, **k: parsed.append(text) or parse(text, *a, **k))
    original = dvcfile.Lockfile._load_yaml
    status_with_memory(capsys)
    assert not [path for path in built if Path(path).is_dir()]
    assert not [text for text in parsed if "make@one" in text]
    (folder / "in" / "one").write_text("new")
    built.clear()
    assert dvc_adapter.reproduce(["--quiet"]) == 0  # one stage of four, and its lines
    status_with_memory(capsys)
    assert {Path(path).name for path in built if Path(path).is_dir()} <= {"one", "made"}
    assert all("make@y" not in text for text in parsed)
    assert dvcfile.Lockfile._load_yaml is original


def test_where_nothing_changes_a_folder_is_looked_at_once(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many stages make or read it."""
    looked: list[str] = []
    look = dvc_memory._look_at
    monkeypatch.setattr(dvc_memory, "_look_at", lambda path, ignored: looked.append(path) or look(path, ignored))
    status_with_memory(capsys)
    assert looked
    assert len(looked) == len(set(looked))


def test_a_link_to_a_folder_counts_as_it_does_for_dvc(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What is behind it changes without the link."""
    (folder / "elsewhere").mkdir()
    (folder / "made" / "one" / "link").symlink_to(folder / "elsewhere", target_is_directory=True)
    for text in ("one", "two"):
        (folder / "elsewhere" / "file").write_text(text)
        assert status_with_memory(capsys) == status_without(capsys)


def test_only_looking_writes_no_locks_of_stages(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It can be asked while a stage runs, and says what there is."""
    before = (folder / ".dvc" / "tmp" / "rwlock").read_text()
    (folder / ".dvc" / "tmp" / "rwlock").write_text(
        f'{{"{folder}/made/one": {{"write": {{"pid": {os.getpid()}, "cmd": "dvc repro"}}, "read": []}}}}'
    )
    assert "up to date" in status_with_memory(capsys)
    (folder / ".dvc" / "tmp" / "rwlock").write_text(before)


def test_a_lock_left_by_a_merge_is_said_and_nothing_is_changed(folder: Path) -> None:
    (folder / "conf").mkdir()
    (folder / "conf" / "config.yaml").touch()  # which makes it a project
    lock = "<<<<<<< HEAD\n" + (folder / "dvc.lock").read_text()
    (folder / "dvc.lock").write_text(lock)
    environment = {**os.environ, "SCENEEXPANDER_ROOT": str(folder)}
    command = [sys.executable, "-m", "sceneexpander", "status"]
    asked = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert asked.returncode == 2
    assert asked.stderr.splitlines()[-1].startswith(f"error: {folder}: DVC cannot tell what would run")
    assert "Traceback" not in asked.stderr
    assert (folder / "dvc.lock").read_text() == lock
