"""The pipeline without DVC: the same stages in an order that works, and only those whose inputs changed."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sceneexpander.errors import UserError
from sceneexpander.pipeline.declared import find_predecessors, read_pipeline, select_stages
from sceneexpander.pipeline.plain import PlainRunner

ROOT = Path(__file__).parents[3]
# Copies its input with a mark, and writes down that it ran.
COPY = (
    "python -c \"import pathlib, sys; t = pathlib.Path(sys.argv[1]).read_text(); open('ran', 'a').write(sys.argv[2] + ' '); "
    "sys.exit(int(t)) if t.isdigit() else pathlib.Path(sys.argv[2]).write_text(t + '>')\""
)
GATHER = "python -c \"import os, pathlib; open('ran', 'a').write('gather '); pathlib.Path('all').write_text(str(os.listdir('made')))\""
PIPELINE = f"""
stages:
  gather:
    cmd: {GATHER}
    deps: [made]
    outs: [all]
  first:
    matrix: {{scene: "${{scenes}}"}}
    cmd: {COPY} in/${{item.scene}} mid/${{item.scene}}
    deps: ["in/${{item.scene}}"]
    params: [word, other.yaml: ["a.${{item.scene}}"]]
    outs: ["mid/${{item.scene}}"]
  second:
    matrix: {{scene: "${{scenes}}", round: "${{rounds}}"}}
    cmd: {COPY} mid/${{item.scene}} made/${{item.scene}}-${{item.round.k}}
    deps: ["mid/${{item.scene}}"]
    outs:
      - "made/${{item.scene}}-${{item.round.k}}": {{cache: false}}
"""
PARAMS = "scenes: [a, b]\nrounds: [{k: 1}]\nword: hello\nunread: 1\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dvc.yaml").write_text(PIPELINE)
    (tmp_path / "params.yaml").write_text(PARAMS)
    (tmp_path / "other.yaml").write_text("a: {a: 1, b: 2}\n")
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf" / "config.yaml").write_text("{}")
    (tmp_path / "in").mkdir()
    for scene in "ab":
        (tmp_path / "in" / scene).write_text(scene)
    return tmp_path


def ran(folder: Path, **options: bool | int) -> set[str]:
    (folder / "ran").write_text("")
    runner = PlainRunner(folder, **options)  # type: ignore[arg-type]
    runner.run(read_pipeline(folder))
    words = (folder / "ran").read_text().split()
    assert len(words) == len(set(words)), "nothing runs twice"
    return set(words)


ALL = {"mid/a", "mid/b", "made/a-1", "made/b-1", "gather"}


@pytest.mark.parametrize("jobs", [1, 3])
def test_only_what_changed_runs(folder: Path, jobs: int) -> None:
    assert ran(folder, jobs=jobs) == ALL
    assert (folder / "made" / "b-1").read_text() == "b>>"
    assert ran(folder, jobs=jobs) == set()
    (folder / "in" / "a").write_text("A")
    assert ran(folder, jobs=jobs) == {"mid/a", "made/a-1", "gather"}


def test_each_kind_of_change_counts_and_nothing_else(folder: Path) -> None:
    ran(folder)
    params, other = folder / "params.yaml", folder / "other.yaml"
    params.write_text(PARAMS.replace("unread: 1", "unread: 2"))
    os.utime(folder / "in" / "a")
    assert ran(folder) == set()
    params.write_text(PARAMS.replace("hello", "bye"))
    assert ran(folder) == {"mid/a", "mid/b"}, "what they make is the same, so nothing after them runs"
    other.write_text("a: {a: 1, b: 3}\n")
    assert ran(folder) == {"mid/b"}
    (folder / "made" / "a-1").write_text("touched by somebody")
    assert ran(folder) == {"made/a-1"}
    shutil.rmtree(folder / "mid")
    assert ran(folder) == {"mid/a", "mid/b"}
    assert ran(folder, force=True) == ALL


def test_a_scene_that_fails_does_not_stop_the_others(folder: Path) -> None:
    assert ran(folder) == ALL
    (folder / "in" / "a").write_text("2")
    runner = PlainRunner(folder)
    runner.run(read_pipeline(folder))
    assert not (folder / "made" / "a-1").exists(), "what an earlier run made of it is not shown as this one's"
    assert runner.failed == {"first@a": 2}
    assert runner.left_out == ["second@a-round0"]
    assert "b-1" in (folder / "all").read_text()
    assert "a-1" not in (folder / "all").read_text()
    (folder / "in" / "a").write_text("a")
    assert ran(folder) == {"mid/a", "made/a-1", "gather"}
    (folder / "in" / "a").write_text("1")
    stopped = PlainRunner(folder, keep_going=False)
    stopped.run(read_pipeline(folder))
    assert stopped.failed == {"first@a": 1}
    assert "gather" in stopped.left_out


def command(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "SCENEEXPANDER_ROOT": str(folder), "PYTHONPATH": str(ROOT / "src")}
    return subprocess.run(
        [sys.executable, "-m", "sceneexpander.cli", "run", *arguments], env=environment, capture_output=True, text=True
    )


def test_the_command_says_what_failed_and_what_to_do(folder: Path) -> None:
    (folder / "in" / "a").write_text("2")
    done = command(folder)
    assert done.returncode == 2
    assert "1 of 5 stages failed (first@a), 1 were left out" in done.stderr
    assert "Traceback" not in done.stderr
    (folder / "in" / "a").write_text("a")
    done = command(folder)
    assert (done.returncode, done.stderr) == (0, "")
    assert "3 of 5 stages ran" in done.stdout
    wrong = command(folder, "frist")
    assert wrong.returncode == 2
    assert wrong.stderr == "error: frist: no such stage; did you mean 'first'?\n"


def test_a_killed_run_leaves_no_result_behind_that_counts(folder: Path) -> None:
    text = (folder / "dvc.yaml").read_text()
    slow = "python -c \"import pathlib, time; pathlib.Path('mid/a').write_text('half'); time.sleep(60)\""
    (folder / "dvc.yaml").write_text(text.replace(f"{COPY} in/${{item.scene}} mid/${{item.scene}}", slow))
    environment = {**os.environ, "SCENEEXPANDER_ROOT": str(folder), "PYTHONPATH": str(ROOT / "src")}
    process = subprocess.Popen([sys.executable, "-m", "sceneexpander.cli", "run", "first@a"], env=environment)
    deadline = time.monotonic() + 20
    while not (folder / "mid" / "a").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=15) != 0
    runner = PlainRunner(folder)
    assert not any(runner.is_up_to_date(stage) for stage in read_pipeline(folder))


def test_the_real_pipeline_is_read_as_dvc_reads_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same addresses, commands, parameters and arrows, with several scenes, rounds and methods."""
    from dvc.repo import Repo

    monkeypatch.chdir(tmp_path)  # DVC writes addresses relative to the current folder
    shutil.copy(ROOT / "dvc.yaml", tmp_path)
    (tmp_path / "params.yaml").write_text(
        "scenes: [one, two]\nrounds: [{k: 1, prev: 0}, {k: 2, prev: 1}]\nmethods: [captured, sceneexpander]\noverrides: []\n"
    )
    Repo.init(tmp_path, no_scm=True)
    repo = Repo(tmp_path)
    stages = {stage.address: stage for stage in read_pipeline(tmp_path)}
    theirs = {stage.addressing: stage for stage in repo.index.stages}
    assert set(stages) == set(theirs)
    graph = repo.index.graph
    before = find_predecessors(list(stages.values()))
    for address, stage in stages.items():
        assert stage.command == theirs[address].cmd
        assert set(before[address]) == {other.addressing for other in graph.successors(theirs[address])}, address
        assert {output.path for output in stage.outputs} == {output.def_path for output in theirs[address].outs}
    order = list(stages)
    assert all(order.index(other) < order.index(address) for address in order for other in before[address])


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("${rounds}", "${ruonds}", "has no ruonds"),
        ("outs: [all]", "outs: [all]\n    always_changed: true", "'always_changed', which only DVC knows"),
        ("deps: [made]", "deps: [made, all, mid/a]\n    wdir: x", "'wdir'"),
    ],
)
def test_what_is_not_known_here_is_refused(folder: Path, old: str, new: str, line: str) -> None:
    text = (folder / "dvc.yaml").read_text()
    assert old in text
    (folder / "dvc.yaml").write_text(text.replace(old, new))
    with pytest.raises(UserError, match=line):
        read_pipeline(folder)


def test_targets_bring_what_they_need(folder: Path) -> None:
    stages = read_pipeline(folder)
    assert [stage.address for stage in select_stages(stages, ["second@b-round0"])] == ["first@b", "second@b-round0"]
    assert {stage.name for stage in select_stages(stages, ["gather"])} == {"first", "second", "gather"}
