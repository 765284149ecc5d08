"""What is used of DVC's Python code does what it is used for. If this file passes, another version of DVC will do."""

from __future__ import annotations

from pathlib import Path

import pytest

from sceneexpander.pipeline import dvc_adapter

STAGES = """
stages:
  second:
    cmd: cp first second
    deps: [first]
    outs: [second]
  first:
    cmd: cp given first
    deps: [given]
    outs: [first]
"""


def pipeline(folder: Path, given: str) -> Path:
    from dvc.repo import Repo

    folder.mkdir(parents=True)
    Repo.init(folder, no_scm=True)
    (folder / "dvc.yaml").write_text(STAGES)
    (folder / "given").write_text(given)
    return folder


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    made = pipeline(tmp_path / "one {brace}", "text")
    monkeypatch.chdir(made)
    return made


def test_stages_come_in_an_order_that_works_and_can_be_run_one_by_one(folder: Path) -> None:
    assert dvc_adapter.ordered_addresses() == ["first", "second"]
    for address in ("first", "second"):
        dvc_adapter.reproduce_stage(address)
    assert (folder / "second").read_text() == "text"


def test_a_result_is_named_by_what_determines_it(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = dvc_adapter.identify_result("first")
    assert name is not None
    monkeypatch.chdir(pipeline(tmp_path / "same", "text"))
    assert dvc_adapter.identify_result("first") == name
    monkeypatch.chdir(pipeline(tmp_path / "other", "another text"))
    assert dvc_adapter.identify_result("first") not in {name, None}


def test_the_command_line_runs_in_any_folder(folder: Path) -> None:
    assert dvc_adapter.reproduce(["--quiet"]) == 0
    assert (folder / "second").read_text() == "text"
    (folder / "given").unlink()
    assert dvc_adapter.reproduce(["--quiet"]) != 0


def test_no_repository_can_be_used_where_there_is_none(tmp_path: Path) -> None:
    assert not dvc_adapter.can_use_repository(tmp_path)
