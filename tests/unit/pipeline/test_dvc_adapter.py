"""What is used of DVC's Python code does what it is used for. If this file passes, another version of DVC will do."""

from __future__ import annotations

from pathlib import Path

import pytest

from sceneexpander.artifacts.unavailable import Unavailable, unavailable_in
from sceneexpander.pipeline import dvc_adapter
from sceneexpander.pipeline.__main__ import reproduce

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


MANY = """
stages:
  make:
    matrix: {scene: "${scenes}"}
    cmd: test "$(cat in/${item.scene})" != bad && cp in/${item.scene} made/${item.scene}
    deps: ["in/${item.scene}"]
    outs: ["made/${item.scene}"]
  gather:
    cmd: ls made > all
    deps: [made]
    outs: [all]
"""


@pytest.fixture
def many(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = pipeline(tmp_path / "many", "text")
    (folder / "dvc.yaml").write_text(MANY)
    scenes = [f"scene-{number}" for number in range(5)]
    (folder / "params.yaml").write_text(f"scenes: {scenes}")
    (folder / "in").mkdir()
    (folder / "made").mkdir()
    for scene in scenes:
        (folder / "in" / scene).write_text(scene)
    monkeypatch.chdir(folder)
    return folder


def test_a_scene_that_fails_does_not_stop_the_others_and_is_not_gathered(
    many: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert reproduce(["--quiet"], "make repro") == 0
    (many / "in" / "scene-1").write_text("bad")
    (many / "in" / "scene-3").write_text("other")
    capsys.readouterr()
    assert reproduce(["--quiet"], "make repro") != 0
    assert (
        "1 of 6 stages failed (make@scene-1), 0 were left out; again, only what is missing: make repro"
        in capsys.readouterr().err
    )
    assert (many / "made" / "scene-3").read_text() == "other"
    assert (many / "all").read_text().split() == ["scene-0", "scene-2", "scene-3", "scene-4"], "nothing of a run before"
    (many / "in" / "scene-1").write_text("mended")
    assert reproduce(["--quiet"], "make repro") == 0
    assert "scene-1" in (many / "all").read_text()


def test_the_lock_file_is_what_dvc_itself_would_write(many: Path) -> None:
    """Replacing the lines of one stage is a short cut, nothing else."""
    from dvc.repo import Repo
    from dvc.utils.serialize import dumps_yaml
    from dvc.utils.serialize._yaml import parse_yaml_for_update

    (many / "in" / "scene-2").rename(many / "in" / "s")
    long = "a-name-" + "x" * 90
    (many / "params.yaml").write_text(f"scenes: [s, {long}, {'y' * 140}, '1', 'true']")
    for name in (long, "y" * 140, "1", "true"):
        (many / "in" / name).write_text(f"scene {name}")
    for turn in range(3):
        assert dvc_adapter.reproduce(["--quiet"]) == 0
        written = (many / "dvc.lock").read_text()
        assert written == dumps_yaml(parse_yaml_for_update(written, "dvc.lock"))
        for name in ("s", "y" * 140):
            (many / "in" / name).write_text(f"changed {turn}")
    with Repo(str(many)) as repo:
        assert repo.status() != {}, "the last change is seen"
    assert dvc_adapter.reproduce(["--quiet"]) == 0
    with Repo(str(many)) as repo:
        assert repo.status() == {}


def test_no_repository_can_be_used_where_there_is_none(tmp_path: Path) -> None:
    assert not dvc_adapter.can_use_repository(tmp_path)


UNASKED = """
stages:
  made:
    matrix: {method: [wanted, unwanted]}
    cmd: echo ${item.method} >> log && mkdir -p out/${item.method} out/stats && echo '{}' > out/stats/${item.method}.json
    params: [out/methods.json: ["${item.method}"]]
    outs: ["out/${item.method}", "out/stats/${item.method}.json"]
"""


def test_no_process_starts_for_a_method_that_was_not_asked_for(folder: Path) -> None:
    (folder / "dvc.yaml").write_text(UNASKED)
    (folder / "out").mkdir()
    (folder / "out" / "methods.json").write_text('{"wanted": true, "unwanted": false}')
    assert dvc_adapter.reproduce(["--quiet"]) == 0
    assert (folder / "log").read_text() == "wanted\n"
    assert unavailable_in(folder / "out" / "unwanted" / "reconstruction") == Unavailable(
        method="unwanted", model="", reason="was not asked for"
    )
    (folder / "out" / "methods.json").write_text('{"wanted": true, "unwanted": true}')
    assert dvc_adapter.reproduce(["--quiet"]) == 0
    assert (folder / "log").read_text() == "wanted\nunwanted\n"
