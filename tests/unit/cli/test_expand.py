"""A run's folder belongs to one process and to one scene; what is copied into it is what the scene names."""

from __future__ import annotations

import errno
import io
import json
import os
import shutil
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from sceneexpander.artifacts.cameras import CameraReport, ViewCamera
from sceneexpander.artifacts.page import BaseModel, ScenePage
from sceneexpander.cli import expand as command
from sceneexpander.cli.expand import Request, expand, run_name, stage_scene
from sceneexpander.errors import UserError, printable
from sceneexpander.generation import Forecast
from sceneexpander.pipeline import preflight
from sceneexpander.pipeline.locks import run_lock
from sceneexpander.pipeline.preflight import CheckedScene
from sceneexpander.pipeline.selection import read_selection
from tests.worlds.captures import MAKERS
from tests.worlds.expansions import ROOT, everything, photos, picture, project, request, somebody_at_work

__all__ = ["project"]  # the fixture
from tests.worlds.photos import texture


def scene(folder: Path) -> Path:
    photos(folder / "captured")
    picture(folder / "inserted" / "one.png", 150)
    (folder / "scene.yaml").write_text('name: a\nrounds:\n  - prompt: "A bench."\n    inserted: inserted/one.png\n')
    return folder


def test_the_same_photos_go_on_and_others_are_refused(project: Path, tmp_path: Path) -> None:
    first, second = photos(tmp_path / "A" / "photos"), photos(tmp_path / "B" / "photos")
    expand(request(first, tmp_path), project=project)
    expand(request(first, tmp_path, prompts=("Another bench.",)), project=project)
    folder = project / "runs" / "photos"
    before = everything(folder)
    with pytest.raises(UserError) as caught:
        expand(request(second, tmp_path), project=project)
    assert caught.value.line() == f"{folder}: holds another folder's scene ({first}); choose another --name"
    assert everything(folder) == before
    expand(request(second, tmp_path, name="second"), project=project)


def test_a_packed_capture_is_a_run_of_what_it_holds(project: Path, tmp_path: Path) -> None:
    photos(tmp_path / "terrace")
    scene(tmp_path / "room")
    for name in ("terrace", "room"):
        shutil.make_archive(str(tmp_path / name), "zip", tmp_path, name)
    expand(request(tmp_path / "terrace.zip", tmp_path), project=project)
    expand(Request(photos=tmp_path / "room.zip"), project=project)
    assert everything(project / "runs" / "room" / "scenes" / "room") == everything(tmp_path / "room")
    copied = everything(project / "runs" / "terrace" / "scenes" / "terrace" / "captured")
    assert copied == everything(tmp_path / "terrace")
    assert sorted(path.name for path in (project / "runs").iterdir() if path.suffix == ".part") == []


@pytest.mark.parametrize(("name", "place"), [("terrace", "terrace/2.png"), ("room", "room/captured/2.png")])
def test_what_is_wrong_in_an_archive_is_named_by_the_archive(
    name: str, place: str, project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = photos(tmp_path / name) if name == "terrace" else scene(tmp_path / name)
    (tmp_path / place).write_bytes(b"no picture")
    shutil.make_archive(str(folder), "zip", tmp_path, name)
    monkeypatch.setattr(command, "check_scene", preflight.check_scene)
    given = request(tmp_path / f"{name}.zip", tmp_path) if name == "terrace" else Request(photos=tmp_path / "room.zip")
    with pytest.raises(UserError) as caught:
        expand(given, project=project)
    assert caught.value.where == str(tmp_path / f"{name}.zip" / place)
    assert not (project / "runs" / name / "source.json").exists()


def test_a_folder_of_scene_folders_is_told_where_they_belong(project: Path, tmp_path: Path) -> None:
    for name in ("scene_2", "scene_10", "scene_1"):
        scene(tmp_path / "many" / name)
    with pytest.raises(UserError) as caught:
        expand(request(tmp_path / "many", tmp_path), project=project)
    line = caught.value.line()
    assert f"{tmp_path / 'many'}: is a folder of scene folders (scene_1, scene_2, scene_10)" in line
    assert "'scenes:' of the params.yaml" in line
    assert not (project / "runs" / "many").exists()


@pytest.mark.parametrize("made", [MAKERS["colmap"], MAKERS["transforms"]])
def test_a_folder_of_captures_names_the_captures_and_not_their_pictures(
    project: Path, tmp_path: Path, made: Callable[[Path], None]
) -> None:
    for name in ("a", "b"):
        (tmp_path / "many" / name).mkdir(parents=True)
        made(tmp_path / "many" / name)
    with pytest.raises(UserError, match=r"captures in folders of their own: a \(.*\), b \(.*\); pass one") as caught:
        expand(request(tmp_path / "many", tmp_path), project=project)
    assert "images" not in caught.value.line()


@pytest.mark.parametrize(("one", "two"), [("写真", "台所"), ("a b", "a_b"), ("Küche", "Kuche"), ("x" * 60, "x" * 70)])
def test_names_that_become_one_do_not_share_a_run(one: str, two: str, project: Path, tmp_path: Path) -> None:
    first, second = photos(tmp_path / one), photos(tmp_path / two)
    assert run_name(request(first, tmp_path)) == run_name(request(second, tmp_path))
    expand(request(first, tmp_path), project=project)
    with pytest.raises(UserError, match="holds another folder's scene"):
        expand(request(second, tmp_path), project=project)


@pytest.mark.parametrize("name", ["pages", "report", "code.json", "Pages"])
def test_names_of_the_pipelines_own_are_refused(name: str, project: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="uses for its own results; choose another --name"):
        expand(request(photos(tmp_path / "in"), tmp_path, name=name), project=project)
    with pytest.raises(UserError, match="uses for its own results; choose another --name"):
        expand(request(photos(tmp_path / name), tmp_path), project=project)
    assert not (project / "runs").exists()


def test_a_second_start_changes_nothing(project: Path, tmp_path: Path) -> None:
    source = photos(tmp_path / "photos")
    expand(request(source, tmp_path), project=project)
    folder = project / "runs" / "photos"
    before = everything(folder)
    with somebody_at_work(folder) as process:
        with pytest.raises(UserError) as caught:
            expand(request(source, tmp_path, prompts=("Another bench.",)), project=project)
        assert f"is being worked on by process {process} since 2" in caught.value.line()
        assert everything(folder) == before
        expand(request(source, tmp_path, name="other"), project=project)
    expand(request(source, tmp_path), project=project)  # who was killed holds nothing


def test_a_child_that_lives_on_holds_the_lock(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    with run_lock(folder) as lock:
        inherited = subprocess.Popen(["sleep", "60"], pass_fds=(lock.descriptor,))
        lock.note(99999999, inherited.pid)
    try:
        with pytest.raises(UserError, match=f"by process {inherited.pid} since"), run_lock(folder):
            pass
    finally:
        inherited.kill()
        inherited.wait()
    with run_lock(folder):
        pass


def test_a_start_that_came_to_nothing_leaves_nothing(tmp_path: Path) -> None:
    with run_lock(tmp_path / "runs" / "run"):
        assert list((tmp_path / "runs").iterdir())
    assert not list(tmp_path.iterdir())


def test_a_killed_start_leaves_no_child_and_no_lock(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    script = f"""
from pathlib import Path
from sceneexpander.pipeline.processes import kept
from sceneexpander.pipeline.locks import run_lock
with run_lock(Path({str(folder)!r})) as lock:
    with kept(["sleep", "60"], cwd=Path({str(tmp_path)!r}), held=(lock.descriptor,)) as process:
        print(process.pid, flush=True)
        process.wait()
"""
    process = subprocess.Popen([sys.executable, "-c", script], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    int(process.stdout.readline())
    process.send_signal(signal.SIGKILL)
    process.communicate()
    deadline = time.monotonic() + 15
    while True:
        try:
            with run_lock(folder):
                break
        except UserError:
            assert time.monotonic() < deadline
            time.sleep(0.05)


def test_a_copy_holds_what_the_scene_names(tmp_path: Path) -> None:
    folder = scene(tmp_path / "mine")
    (folder / "large.bin").write_bytes(b"x" * 10_000)
    (folder / "other").mkdir()
    os.mkfifo(folder / "pipe")
    (folder / "loop").symlink_to(".")
    (folder / "nowhere").symlink_to("missing")
    (folder / "captured" / "notes.txt").write_text("x")
    stage_scene(Request(photos=folder), "mine", tmp_path / "copy")
    assert sorted(everything(tmp_path / "copy")) == [
        *(f"captured/{number}.png" for number in range(3)),
        "inserted/one.png",
        "scene.yaml",
    ]


@pytest.mark.parametrize("place", ["captured", "captured/3.png", "inserted/one.png", "inserted"])
def test_links_bring_nothing_from_elsewhere(place: str, project: Path, tmp_path: Path) -> None:
    folder = scene(tmp_path / "mine")
    private = photos(tmp_path / "private")
    picture(private / "one.png")
    path = folder / place
    if path.is_dir():
        path.rename(tmp_path / "away")
    path.unlink(missing_ok=True)
    path.symlink_to(private if path.suffix == "" else private / "0.png")
    with pytest.raises(UserError, match="leads out"):
        expand(Request(photos=folder), project=project)
    assert not (project / "runs").exists()


def test_links_within_become_files(tmp_path: Path) -> None:
    folder = scene(tmp_path / "mine")
    (folder / "captured" / "3.png").symlink_to("../inserted/one.png")
    stage_scene(Request(photos=folder), "mine", tmp_path / "copy")
    copy = tmp_path / "copy" / "captured" / "3.png"
    assert not copy.is_symlink()
    assert copy.read_bytes() == (folder / "inserted" / "one.png").read_bytes()


def test_read_only_folders_run_as_often_as_one_likes(project: Path, tmp_path: Path) -> None:
    folder = scene(tmp_path / "mine")
    every = [folder, *folder.rglob("*")]
    for path in every:
        path.chmod(stat.S_IRUSR | (stat.S_IXUSR if path.is_dir() else 0))
    (project / "conf").chmod(0o555)
    try:
        for _ in range(3):
            expand(Request(photos=folder), project=project)
    finally:
        for path in every:
            path.chmod(0o755)
        (project / "conf").chmod(0o755)
    copies = [path for part in ("scenes", "conf") for path in (project / "runs" / "mine" / part).rglob("*")]
    assert len(copies) >= 6
    assert all(path.stat().st_mode & stat.S_IWUSR for path in copies)
    assert not list((project / "runs").glob("*.part"))


def test_what_a_killed_start_left_is_cleared(project: Path, tmp_path: Path) -> None:
    left = project / "runs" / ".photos.abc.part"
    photos(left)
    expand(request(photos(tmp_path / "photos"), tmp_path), project=project)
    assert not left.exists()


UGLY = ["it's #1.PNG", 'b=a (1) "x" ${Y}.png', "{round}.png", "写真.jpg", "a\nb.png", "noending", "x.weird ending"]


@pytest.mark.parametrize("name", UGLY)
def test_a_picture_of_any_name_is_inserted(name: str, tmp_path: Path) -> None:
    given = picture(tmp_path / "in, #1" / name, 150)
    source = Request(photos=photos(tmp_path / "photos"), inserted=(given,), prompts=("A ${seed} 'bench' #5.",))
    stage_scene(source, "mine", tmp_path / "copy")
    facts = yaml.safe_load((tmp_path / "copy" / "scene.yaml").read_text())["rounds"][0]
    assert facts["prompt"] == "A ${seed} 'bench' #5."
    assert (tmp_path / "copy" / facts["inserted"]).read_bytes() == given.read_bytes()


@pytest.mark.parametrize("name", ["c.jpg", "c\nd\x1b[2J.jpg"])
def test_the_last_lines_say_what_became_of_the_photos(
    name: str, project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def ran(folder: Path, **_: object) -> None:
        used = ViewCamera(
            view_id="a", name="a.jpg", generated=False, posed=True, rough=False, reason="", warnings=(), focal_ratio=0.8,
            focal_source="exif", distortion=(0.0, 0.0), inliers=9, error_px=None,
        )  # fmt: skip
        lost = replace(used, view_id="c", name=name, posed=False, reason="its matches agree with no camera")
        ScenePage(
            scene="photos",
            settings={},
            overrides=(),
            model=BaseModel(model="mini", weights_sha256="0", licence="free"),
            captured=(),
            cameras=CameraReport(views=(used, replace(used, view_id="b"), lost), notes=()),
            statistics={},
            rounds=(),
        ).save(folder / "outputs" / "pages" / "photos")

    monkeypatch.setattr(command, "reproduce", ran)
    monkeypatch.setattr(command, "find_project", lambda: project)
    inserted = picture(tmp_path / "new.png", 150)
    arguments = [str(photos(tmp_path / "photos")), "--inserted", str(inserted), "--prompt", "A bench."]
    monkeypatch.setattr(sys, "argv", ["expand", *arguments])
    command.main()
    assert capsys.readouterr().out.splitlines() == [
        f"photos: 2 of 3 photos used: {printable(name)} left out (its matches agree with no camera)",
        f"report: {project / 'runs' / 'photos' / 'outputs' / 'report' / 'index.html'}",
    ]


@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "nothing", "long"])
def test_what_is_no_picture_is_one_line(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "there"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    path = {"device": Path("/dev/zero"), "long": tmp_path / ("x" * 5000)}.get(kind, path)
    with pytest.raises(UserError):
        stage_scene(Request(photos=photos(tmp_path / "p"), inserted=(path,), prompts=("A.",)), "m", tmp_path / "copy")


@pytest.mark.parametrize("words", [{"prompts": ("A\udcff.",)}, {"motions": ("\ud800",)}, {"name": "\udcff"}])
def test_words_that_are_no_text_are_one_line(words: dict[str, Any], project: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="not valid text"):
        expand(request(photos(tmp_path / "photos"), tmp_path, **words), project=project)
    assert not (project / "runs").exists()


def test_errors_name_the_users_files(project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = photos(tmp_path / "photos")
    for place, named in (("captured/1.png", source / "1.png"), ("inserted/round_1.png", tmp_path / "new.png")):

        def refuse(_: str, folder: Path, *, place: str = place, **__: object) -> CheckedScene:
            raise UserError("is bad", where=folder / place)

        monkeypatch.setattr(command, "check_scene", refuse)
        with pytest.raises(UserError) as caught:
            expand(request(source, tmp_path), project=project)
        assert caught.value.where == str(named)
    assert not (project / "runs" / "photos").exists()


def test_a_full_disk_leaves_the_earlier_run(project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = photos(tmp_path / "photos")
    expand(request(source, tmp_path), project=project)
    before = everything(project / "runs" / "photos")

    def full(_: Any, target: Any, **__: object) -> None:
        Path(target).write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device", str(target))

    monkeypatch.setattr(shutil, "copyfile", full)
    with pytest.raises(OSError, match="No space left"):
        expand(request(source, tmp_path), project=project)
    assert everything(project / "runs" / "photos") == before
    assert not list((project / "runs").glob("*.part"))
    assert json.loads((project / "runs" / "photos" / "source.json").read_text())["photos"] == str(source)


def test_a_run_has_the_projects_methods_and_settings(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a sweep's jobs do: what params.yaml says, and what was asked for on top of it."""
    (project / "weights.safetensors").write_bytes(b"x")
    (project / "params.yaml").write_text(
        "scenes: [courtyard]\nrounds: [{k: 1, prev: 0}]\nmethods: [captured, omnivggt]\n"
        "overrides: [seed=3, adapt.steps=7, rivals.omnivggt.weights=weights.safetensors]\n"
    )
    checked: list[dict[str, Any]] = []
    monkeypatch.setattr(command, "check_scene", lambda *_, **given: checked.append(given) or CheckedScene(rounds=1))
    monkeypatch.chdir(tmp_path)  # relative paths of params.yaml are the project's
    expand(request(photos(tmp_path / "photos"), tmp_path, overrides=("adapt.steps=9",)), project=project)
    selection = read_selection(project / "runs" / "photos")
    assert selection.methods == ("captured", "omnivggt")
    weights = project / "weights.safetensors"
    assert selection.overrides == ("seed=3", "adapt.steps=9", f"rivals.omnivggt.weights={weights}")
    assert checked[0]["overrides"] == selection.overrides
    assert checked[0]["methods"] == selection.methods


def test_a_run_may_have_methods_of_its_own(project: Path, tmp_path: Path) -> None:
    given = ["--prompt", "A bench.", "--inserted", str(picture(tmp_path / "bench.png", 150))]
    asked = command.parse_arguments([str(photos(tmp_path / "photos")), *given, "--methods", "captured,sceneexpander"])
    expand(asked, project=project)
    assert read_selection(project / "runs" / "photos").methods == ("captured", "sceneexpander")
    expand(replace(asked, methods=()), project=project)
    assert read_selection(project / "runs" / "photos").methods == read_selection(project).methods


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            ["photos", "--methods", "captured,sceneexpandr"],
            "--methods: unknown 'sceneexpandr'; did you mean 'sceneexpander'?",
        ),
        (["photos", "--methods", ""], "--methods: unknown ''"),
        (["photos", "--methods", "captured,captured"], "--methods: names 'captured' twice"),
        (
            ["photos", "--methods", "ttt3r_optimised"],
            "--methods: 'ttt3r_optimised' starts from 'ttt3r'; list ttt3r too",
        ),
        (["--continue", "a", "--methods", "captured"], "--methods: a run goes on with its own methods; leave it out"),
    ],
)
def test_methods_that_cannot_be_are_one_line(arguments: list[str], line: str) -> None:
    with pytest.raises(UserError) as caught:
        command.parse_arguments(arguments)
    assert caught.value.line().startswith(line)


def test_a_picture_named_twice_is_refused(project: Path, tmp_path: Path) -> None:
    """The project's own picture must not stand in for the one that was given."""
    params = project / "params.yaml"
    params.write_text(params.read_text().replace("overrides: []", "overrides: [generator=file, generator.file=x.png]"))
    with pytest.raises(UserError, match=r"generator.backend: is 'file' and would take the place of --inserted"):
        expand(request(photos(tmp_path / "photos"), tmp_path), project=project)
    assert not (project / "runs").exists()


def test_a_picture_may_be_as_large_as_the_photos_may(project: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="megapixels"):
        expand(
            request(photos(tmp_path / "photos"), tmp_path, overrides=("scene.max_megapixels=0.001",)), project=project
        )


@pytest.mark.parametrize("arguments", [[], ["--prompt", "A bench."]])
def test_what_is_missing_is_one_line_that_says_so(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["expand", *arguments])
    with pytest.raises(SystemExit) as caught:
        command.main()
    assert caught.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--inserted bench.png" in line
    assert "key=value" not in line
    assert "PHOTOS" in line


def reads_its_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """The check as it is."""
    monkeypatch.setattr(command, "check_scene", preflight.check_scene)


def place(folder: Path) -> Path:
    """Photos with something to see in them."""
    folder.mkdir()
    for number in range(3):
        texture(number).save(folder / f"{number}.png")
    return folder


REPROJECT = ("--generator", "reproject", "--motion", "move back 20 %")


def test_a_round_needs_no_picture_where_one_is_made(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads_its_words(monkeypatch)
    arguments = [str(place(tmp_path / "photos")), *REPROJECT, "profile=smoke"]
    assert expand(command.parse_arguments(arguments), project=project) is not None
    run = project / "runs" / "photos"
    facts = yaml.safe_load((run / "scenes" / "photos" / "scene.yaml").read_text())["rounds"]
    assert facts == [{"prompt": "move back 20 %", "motion": "move back 20 %"}]
    assert "generator=reproject" in read_selection(run).overrides


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--motion", "move back"], "--inserted: round 1 has no picture; give one --inserted PICTURE"),
        (["--generator", "reprojct", "--motion", "move back"], "did you mean 'reproject'?"),
        (["--generator", "reproject", "--prompt", "A bench."], "says no camera motion"),
        (["--generator", "reproject", "--motion", "fly to the moon"], "'fly to the moon' is not understood"),
        ([*REPROJECT, "--inserted", "x.png"], "would take the place of --inserted"),
        ([*REPROJECT, "--candidates", "4"], "generator.candidates: "),
        ([*REPROJECT, "--candidates", "many"], "invalid int value"),
        ([*REPROJECT, "--choose", "none.png"], "none.png: does not exist"),
    ],
)
def test_generators_refuse_in_one_line(
    arguments: list[str], said: str, project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads_its_words(monkeypatch)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError) as caught:
        expand(command.parse_arguments([str(place(tmp_path / "photos")), *arguments, "profile=smoke"]), project=project)
    assert said in caught.value.line()
    assert not (project / "runs").exists()


def test_a_dry_run_says_what_would_be_asked_for_and_leaves_nothing(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    reads_its_words(monkeypatch)
    arguments = [str(place(tmp_path / "photos")), *REPROJECT, "--object", "a bench", "--dry-run", "profile=smoke"]
    assert expand(command.parse_arguments(arguments), project=project) is None
    printed = capsys.readouterr().out
    assert "round 1: generator reproject" in printed
    assert "following the requirements: move back 20 %, a bench." in printed
    assert "requests: 0" in printed
    assert "invents no object: 'a bench'" in printed
    assert not (project / "runs").exists()


@pytest.mark.parametrize(
    ("answer", "unattended", "fine"), [("y", False, True), ("", False, False), (None, False, False), (None, True, True)]
)
def test_what_costs_something_is_asked_for_first(
    answer: str | None, unattended: bool, fine: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    monkeypatch.setattr(sys.stdin, "isatty", lambda: answer is not None, raising=False)
    asked: list[str] = []
    monkeypatch.setattr("builtins.input", lambda text: asked.append(text) or answer)
    forecasts = [Forecast(prompt="x", requests=2, cost_usd=0.5), Forecast(prompt="y", requests=1, cost_usd=0.25)]
    if fine:
        command.agree_to_requests(forecasts, unattended=unattended)
    else:
        with pytest.raises(UserError):
            command.agree_to_requests(forecasts, unattended=unattended)
    assert bool(asked) == (answer is not None)
    assert all("3 requests to paid services, about 0.75 USD" in text for text in asked)
    command.agree_to_requests([Forecast(prompt="free")], unattended=False)
