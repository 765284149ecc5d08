"""Commands over many runs: what they are asked for is checked first, and a table is never replaced by an empty one."""

from __future__ import annotations

import logging
import shutil
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from sceneexpander.artifacts.store import to_plain, write_json_atomic
from sceneexpander.cli import ablation, sweep, ui
from sceneexpander.cli.sweep import check_axes, run_hydra
from sceneexpander.errors import UserError
from sceneexpander.expandbench.run import CellResult, Plan, Settings
from sceneexpander.pipeline.selection import Selection

ROOT = Path(__file__).parents[3]


@pytest.fixture(autouse=True)
def logging_as_before() -> Iterator[None]:
    """Hydra sets logging up for a process of its own."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)


@pytest.mark.parametrize(
    ("given", "line"),
    [
        (["--multirun", "nope=1"], "nope: unknown key"),
        (["--multirun", "adapt.stepz=1,2"], "adapt.stepz: unknown key; did you mean 'adapt.steps'?"),
        (["--multirun", "ablation=paper,papr"], "ablation: has no option 'papr'; did you mean 'paper'?"),
        (["--multirun", "ablation=glob(zz*)"], "stands for no value"),
        (["--multirun", "adapt.steps=5,abc"], "adapt.steps: is 'abc' (str), expected a whole number"),
        (["adapt.steps=abc"], "adapt.steps: is 'abc' (str)"),
        (["foo"], "foo: is not a setting"),
        (["--mutirun", "seed=1"], "did you mean '--multirun'?"),
        (["--multirun", "seed=range(1"], "seed=range(1"),
        *(([f"seed={text}"], "seed") for text in ("9" * 5000, "1," + "9" * 5000)),
        (["--multirun", f"seed={'[' * 400}{']' * 400}"], "nested too deeply"),
        (["--multirun", "seed=range(1,1e99)"], "more than 1000 values"),
        (["--multirun", "seed=shuffle(range(1,1000000000))"], "more than 1000 values"),
        (["--multirun", "seed=range(0,3,0)"], "step is 0"),
        (["--multirun", "adapt.steps=interval(1,2)"], "is a range without steps"),
        (["hydra.nope=1"], "hydra.nope"),
        (["hydra.sweep.dirr=x"], "did you mean 'hydra.sweep.dir'?"),
        (["hydra.launcher.n_job=2", "hydra/launcher=parallel"], "did you mean 'hydra.launcher.n_jobs'?"),
        (["hydra/launcher=paralel"], "did you mean 'parallel'?"),
        (["hydra/launchr=serial"], "did you mean 'hydra/launcher'?"),
        (["--multirun", "ablatoin=full,anchor"], "ablatoin: unknown key; did you mean 'ablation'?"),
        (["--multirun", "scene=courtyard,cortyard"], "scene: there is no scene 'cortyard'; did you mean 'courtyard'?"),
        (["scene=default"], "scene: there is no scene 'default'"),
        (["--multirun", "scene=glob(zz*)"], "scene=glob(zz*): stands for no scene; known: courtyard"),
        (["--multirun", "scene="], "scene: there is no scene ''"),
        (["--multirun", "scene=courtyard", "scene=courtyard"], "scene: is given twice"),
        (["--multirun", "scene=range(1"], "scene: there is no scene 'range(1'"),
        (["hydra.sweep.subdir=x"], "hydra.sweep.subdir=x: is decided by the sweep; leave it out"),
        (["seed=0,1"], "seed=0,1: holds several values; add --multirun"),
        (["seed=${oc.env:HOME}"], "environment variable"),
        (["hydra.run.dir=${oc.env:HOME}"], "environment variable"),
    ],
)
def test_what_there_is_not_is_one_line(given: list[str], line: str) -> None:
    with pytest.raises(UserError) as caught:
        check_axes(given, ROOT)
    assert line in caught.value.line()
    assert "\n" not in caught.value.line()
    assert len(caught.value.line()) < 500


def test_good_axes_pass_as_they_are() -> None:
    given = ["--multirun", "ablation=glob(realign*)", "seed=0,1", "adapt.steps=range(2,8,2)", "hydra/launcher=parallel"]
    if not (ROOT / "conf" / "hydra" / "launcher" / "parallel.yaml").is_file():
        given.pop()
    axes = check_axes(given, ROOT)
    assert axes.sweep.hydra == tuple(item for item in given if item.startswith("hydra"))
    rows = {job.overrides[0] for job in axes.sweep.jobs}
    assert len(axes.sweep.jobs) == len(set(axes.sweep.jobs)) == len(rows) * 2 * 3
    # The first of every axis together, then every other value once.
    assert {item for job in axes.jobs for item in job.overrides if item.startswith("seed")} == {"seed=0", "seed=1"}
    assert {job.scene for job in axes.jobs} == {None}


def scenes_of(project: Path, *names: str) -> None:
    for name in names:
        (project / "scenes" / name).mkdir(parents=True)
        (project / "scenes" / name / "scene.yaml").write_text("rounds: []")
    (project / "params.yaml").write_text(
        f"scenes: [{names[0]}]\nrounds: [{{k: 1, prev: 0}}]\nmethods: [captured, omnivggt]\noverrides: [seed=7]\n"
    )


@pytest.mark.parametrize(
    ("axis", "expected"),
    [
        ("scene=a,c", ["a", "c"]),
        ("scene=glob(*)", ["a", "b", "c"]),
        ("scene=glob(*,exclude=b)", ["a", "c"]),
        ("scene=c", ["c"]),
        ("scene=choice(b,a)", ["b", "a"]),
    ],
)
def test_scenes_are_an_axis(axis: str, expected: list[str], project: Path) -> None:
    scenes_of(project, "a", "b", "c")
    axes = check_axes(["--multirun", axis, "ablation=paper,anchor"], project)
    assert list(dict.fromkeys(job.scene for job in axes.jobs)) == expected
    assert [(job.scene, job.overrides) for job in axes.sweep.jobs] == [
        (scene, (f"ablation={row}",)) for scene in expected for row in ("paper", "anchor")
    ]


def test_every_scene_of_a_sweep_is_a_job_with_its_own_selection(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Hydra's own command line, over everything but the pipeline: scenes, settings and methods arrive as they were asked for."""
    scenes_of(project, "a", "b")
    made: list[Selection] = []
    checked: list[dict[str, object]] = []

    def workspace(folder: Path, selection: Selection, **_: object) -> Path:
        made.append(selection)
        folder.mkdir(parents=True)
        return folder

    monkeypatch.setattr(sweep, "make_workspace", workspace)
    monkeypatch.setattr(sweep, "reproduce_shared", lambda *_, **__: None)
    monkeypatch.setattr(sweep, "check_scene", lambda scene, *_, **given: checked.append({"scene": scene, **given}))
    monkeypatch.setattr(sys, "argv", ["sweep"])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    given = [
        "--multirun",
        "scene=a,b",
        "adapt.steps=1,2",
        "hydra/launcher=serial",
        f"hydra.sweep.dir={tmp_path / 'out'}",
    ]
    axes = check_axes(given, project)
    sweep.check_inputs(axes.jobs, project)
    assert [one["scene"] for one in checked] == ["a", "b"], (
        "settings that pictures and weights know nothing of are not read twice"
    )
    assert axes.folder == tmp_path / "out"
    write_json_atomic(axes.folder / "sweep.json", to_plain(axes.sweep))
    run_hydra([0, 1, 2, 3], axes.folder, project)
    assert all(sweep.job_state(axes.folder, number).done for number in range(4))
    assert [(one.scenes, one.overrides) for one in made] == [
        ((scene,), ("seed=7", f"adapt.steps={steps}")) for scene in "ab" for steps in (1, 2)
    ]
    assert {one.methods for one in made} == {("captured", "omnivggt")}
    assert {one["methods"] for one in checked} == {("captured", "omnivggt")}
    assert "scene=b adapt.steps=2: " in capsys.readouterr().out


def test_weights_of_rivals_are_checked_before_any_job_runs(project: Path, tmp_path: Path) -> None:
    scenes_of(project, "courtyard")
    shutil.rmtree(project / "scenes" / "courtyard")
    (project / "scenes" / "courtyard").symlink_to(ROOT / "scenes" / "courtyard")
    bad = tmp_path / "bad.safetensors"
    bad.write_bytes(b"x")
    given = ["--multirun", f"rivals.omnivggt.weights={bad}", "profile=smoke", "adapt.steps=1,2"]
    axes = check_axes(given, project)
    with pytest.raises(UserError, match=r"bad\.safetensors"):
        sweep.check_inputs(axes.jobs, project)


def test_a_file_with_any_name_is_one_value(tmp_path: Path) -> None:
    path = tmp_path / "a, b.png"
    path.write_text("x")
    (job,) = check_axes(["generator=file", f"generator.file={path}"], ROOT).sweep.jobs
    assert job.overrides == ("generator=file", f"generator.file='{path}'")


def test_a_folder_that_cannot_be_made_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["sweep"])
    monkeypatch.setattr(sweep, "check_inputs", lambda *_, **__: None)
    monkeypatch.setenv("SCENEEXPANDER_ROOT", str(ROOT))
    (tmp_path / "file").write_text("x")
    with pytest.raises(SystemExit) as caught:
        sweep.main(["seed=1", f"hydra.sweep.dir={tmp_path / 'file' / 'x'}"])
    assert caught.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The configuration, and a table of an earlier run."""
    monkeypatch.setenv("SCENEEXPANDER_ROOT", str(tmp_path))
    (tmp_path / "conf").symlink_to(ROOT / "conf")
    (tmp_path / "src").symlink_to(ROOT / "src")
    (tmp_path / "dvc.yaml").write_text("stages: {}")
    (tmp_path / "results").mkdir()
    for ending in ("json", "md", "svg"):
        (tmp_path / "results" / f"ablation.{ending}").write_text("kept")
    return tmp_path


@pytest.mark.parametrize(
    "given",
    [
        ["--finished", "--rows", "default"],
        ["--rows", ""],
        ["--rows", ","],
        ["--seeds", ""],
        ["--grades", ""],
        ["--scenes", ""],
        ["--finished", "--any-code", "--scenes", ""],
    ],
)
def test_an_empty_table_replaces_none(
    given: list[str], project: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["ablation", *given])

    def nothing_found(_: Plan, settings: Settings, **__: object) -> list[CellResult]:
        assert settings.finished_only, "a plan of nothing is refused before it runs"
        return []

    monkeypatch.setattr(ablation, "run", nothing_found)
    with pytest.raises(SystemExit) as caught:
        ablation.main()
    assert caught.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert {path.read_text() for path in (project / "results").iterdir()} == {"kept"}


@pytest.mark.parametrize("port", [0, -1, 65536])
def test_a_port_is_one(port: int) -> None:
    with pytest.raises(UserError, match="--port"):
        ui.check_port(port)


def test_a_port_in_use_is_one_line() -> None:
    with socket.socket() as other:
        other.bind((ui.HOST, 0))
        other.listen()
        with pytest.raises(UserError, match="cannot be used"):
            ui.check_port(other.getsockname()[1])


def test_a_root_that_is_none_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from sceneexpander.pipeline.project import find_project

    monkeypatch.setenv("SCENEEXPANDER_ROOT", str(tmp_path / "gone"))
    with pytest.raises(UserError, match=r"SCENEEXPANDER_ROOT=.* holds no pipeline"):
        find_project()
