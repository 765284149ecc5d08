"""What page, runs and console say about views that were used, used roughly, or left out."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from sceneexpander.artifacts.cameras import CameraReport
from sceneexpander.artifacts.metrics import ViewMetrics
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.report import SceneSource, collect_scene, write_page
from sceneexpander.report.cameras import camera_lines, cameras_shown, gathered_cameras
from sceneexpander.tracking import scene_runs
from tests.worlds.reports import row
from tests.worlds.reports_with_cameras import ALL, FINE, LOST, NEW, PHOTOS, saved, with_cameras


@pytest.fixture
def outputs(source: SceneSource, tmp_path: Path) -> Path:
    pages = tmp_path / "outputs" / "pages" / "room"
    pages.mkdir(parents=True)
    collect_scene(with_cameras(source, tmp_path), pages)
    write_page([pages], tmp_path / "outputs" / "report")
    return tmp_path / "outputs"


def test_every_view_has_a_card_with_its_state_and_its_reason(outputs: Path) -> None:
    html = (outputs / "report" / "index.html").read_text()
    for sentence in (
        "1 of 2 photos used: b &lt;1&gt;.jpg left out",
        "2 of 3 views used",
        "two cameras took the photos",
    ):
        assert html.count(sentence) == 1, sentence
    cards = re.findall(r'<figure class="camera ([^"]+)">(.*?)</figure>', html, re.DOTALL)
    assert [states for states, _ in cards] == ["used", "out", "used", "out", "rough generated"]
    for _, card in cards:
        assert re.search(r'<img src="media/room/[^"]+"', card)
    lost, new = cards[1][1], cards[4][1]
    assert "its matches agree with no camera" in lost
    assert "120 points" not in lost
    assert "few points" in new
    assert html.count("about 27 mm (35 mm equivalent), refined on the photos") == 1, "said once for all"


@pytest.mark.parametrize("known", [True, False])
def test_a_lost_view_is_said_once(source: SceneSource, tmp_path: Path, known: bool) -> None:
    """The method ``backbone`` has no camera for v2: what the cameras' own report says is not repeated for every method."""
    told = with_cameras(source, tmp_path)
    (tmp_path / "room").mkdir()
    if known:
        replace(ALL, views=(FINE, LOST, replace(NEW, posed=False))).save(tmp_path / "all")
    collect_scene(told, tmp_path / "room")
    write_page([tmp_path / "room"], tmp_path / "report")
    html = (tmp_path / "report" / "index.html").read_text()
    assert ("no camera could be estimated for v2" in html) is not known
    assert ("new.png left out" in html) is known


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ({"focal_ratio": 1.0, "focal_source": "hint"}, "about 36 mm (35 mm equivalent), from the file"),
        ({"focal_ratio": 0.5, "focal_source": "assumed"}, "about 18 mm (35 mm equivalent), assumed"),
        ({"focal_source": "a word of its own"}, "about 27 mm (35 mm equivalent), a word of its own"),
        ({"focal_source": ""}, "about 27 mm (35 mm equivalent)"),
        (
            {"distortion": (-0.08, 0.01)},
            "about 27 mm (35 mm equivalent), refined on the photos, distortion taken out (k1 -0.080, k2 +0.010)",
        ),
        ({"warnings": ("mirrored", "cropped")}, "mirrored"),
    ],
)
def test_a_card_tells_what_is_special_about_its_view(tmp_path: Path, changes: dict[str, object], wanted: str) -> None:
    others = tuple(replace(FINE, view_id=f"v{i}", name=f"{i}.jpg") for i in (1, 2))
    report = CameraReport(views=(replace(FINE, **changes), *others), notes=())  # type: ignore[arg-type]
    facts = gathered_cameras(saved(tmp_path / "cameras", report))
    assert facts is not None
    shown = cameras_shown(facts, {})
    assert shown is not None
    assert wanted in (*shown.cards[0].facts, *shown.cards[0].doubts)
    assert shown.cards[1].facts == ("120 points, 0.5 px off",)
    assert shown.complete


def test_a_model_without_cameras_says_nothing(tmp_path: Path) -> None:
    assert gathered_cameras(None) is None
    assert gathered_cameras(tmp_path / "none") is None
    assert cameras_shown(None, {}) is None
    assert camera_lines(tmp_path) == []


def test_the_console_gets_a_line_per_set_of_views(outputs: Path) -> None:
    assert camera_lines(outputs) == [
        "room: 1 of 2 photos used: b <1>.jpg left out (its matches agree with no camera)",
        "room, round 1: 2 of 3 views used: b <1>.jpg left out (its matches agree with no camera)",
    ]


def test_runs_hold_what_is_not_as_it_should_be(outputs: Path) -> None:
    runs = {run.tags["method"]: run for run in scene_runs(outputs / "pages" / "room", commit="abc")}
    adapted = runs["sceneexpander"]
    assert adapted.tags["cameras.summary"] == ALL.summary()
    assert runs["captured"].tags["cameras.summary"] == PHOTOS.summary()
    assert adapted.tags["cameras.left_out"] == "1"
    text = adapted.artefacts["cameras.txt"].read_text()
    for problem in (*PHOTOS.problems(), *ALL.problems()):
        assert problem in text
    for problem in ALL.problems():
        assert problem in adapted.tags["mlflow.note.content"]


def test_runs_without_a_report_have_no_such_tags(gathered: Path) -> None:
    for run in scene_runs(gathered, commit="abc"):
        assert not [tag for tag in run.tags if tag.startswith("cameras")]
        assert "cameras.txt" not in run.artefacts


def test_means_say_how_many_views_they_are_over_and_lost_views_stand_apart(
    source: SceneSource,
    tmp_path: Path,
) -> None:
    def view(name: str, *, posed: bool, psnr: float) -> ViewMetrics:
        return ViewMetrics(view_id=name, generated=False, posed=posed, values={"psnr_captured_db": psnr})

    views = (view("v0", posed=True, psnr=20.0), view("v1", posed=False, psnr=35.5))
    methods = []
    for method in source.rounds[0].methods:
        if method.name == "ttt3r":
            methods.append(method)
            continue
        made = Reconstruction.load(method.reconstruction)
        posed = torch.tensor([name != "v1" for name in made.view_ids])
        replace(made, posed=posed).save(tmp_path / method.name)
        one = row(method.name, 20.0)
        values = {**one.values, "views_captured_posed": 1.0}
        replace(one, views=views, values=values).save(tmp_path / f"{method.name}.json")
        methods.append(replace(method, reconstruction=tmp_path / method.name, metrics=tmp_path / f"{method.name}.json"))
    (tmp_path / "room").mkdir()
    collect_scene(replace(source, rounds=[replace(source.rounds[0], methods=methods)]), tmp_path / "room")
    write_page([tmp_path / "room"], tmp_path / "report")
    html = (tmp_path / "report" / "index.html").read_text()
    assert "Means are over the 1 of 2 photos that have a camera; left out: v1.jpg." in html
    placed, lost = html.split("Without a camera: at a placeholder, in no mean")
    assert "<h4>v0.jpg" in placed
    assert "<h4>v1.jpg" not in placed
    assert "<h4>v1.jpg" in lost
    assert "no camera (35.50 dB at a placeholder)" in lost
