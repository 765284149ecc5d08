"""Judging finished runs and finished rounds: nothing by looking, everything once."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from sceneexpander.artifacts.inserted import InsertedView, Provenance
from sceneexpander.artifacts.judgement import JudgedRound
from sceneexpander.artifacts.renders import Renders
from sceneexpander.artifacts.unavailable import Unavailable
from sceneexpander.cli.judge_run import judge_run, parse_arguments
from sceneexpander.config.compose import compose
from sceneexpander.config.files import write_settings
from sceneexpander.errors import UserError
from sceneexpander.pipeline.preflight import check_scene
from sceneexpander.pipeline.project import JUDGED_FOLDER, ROOT_ENV
from sceneexpander.splatting.video import write_video
from stages import judge as judge_stage
from stages.runner import Cell
from tests.support.loopback import Service, serving
from tests.worlds.judged import CONF, KEY, scored
from tests.worlds.rounds import made_views

METHODS = ("captured", "backbone", "omnivggt")


@pytest.fixture
def service(monkeypatch: pytest.MonkeyPatch) -> Iterator[Service]:
    monkeypatch.setenv("TEST_KEY", KEY)
    with serving() as found:
        found.answers = [scored(4.0)]
        yield found


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project folder of its own, so that its answers are."""
    folder = tmp_path / "project"
    folder.mkdir()
    for name in ("conf", "stages", "dvc.yaml"):
        (folder / name).symlink_to(CONF.parent / name)
    monkeypatch.setenv(ROOT_ENV, str(folder))
    return folder


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A finished round of three methods, one of which could not be run."""
    folder = tmp_path / "run"
    made = folder / "outputs" / "yard" / "round_1"
    images = torch.rand(1, 3, 32, 48, generator=torch.Generator().manual_seed(0))
    provenance = Provenance(backend="file", prompt="x", source="x.png", sha256="0" * 64)
    InsertedView(round=1, view=made_views(images, images), chosen=0, provenance=(provenance,)).save(made / "inserted")
    for number, method in enumerate(METHODS[:2], start=1):
        place = made / "renders" / method
        place.mkdir(parents=True)
        (place / "gaussians.ply").touch()
        tour = torch.eye(4).repeat(5, 1, 1)
        tour[:, 0, 3] = torch.arange(5.0)
        write_video([torch.full((3, 32, 48), (number + step) / 9) for step in range(5)], place / "rgb.mp4", 24)
        Renders(
            method=method, frames=5, fps=24, height=32, width=48, videos={"rgb": "rgb.mp4"}, stills=(), views=(),
            inserted_frame=4, inserted_camera=method, gaussians=0, scene="gaussians.ply", world_from_cam=tour,
            intrinsics_px=torch.eye(3).repeat(5, 1, 1),
        ).save(place)  # fmt: skip
    Unavailable(method="omnivggt", model="x", reason="needs the public checkpoint").save(made / "renders" / "omnivggt")
    write_settings(
        folder / "params.yaml",
        {"scenes": ["yard"], "rounds": [{"k": 1, "prev": 0}], "methods": list(METHODS), "overrides": []},
    )
    return folder


def overrides(service: Service) -> list[str]:
    return [
        "judge=openai",
        f"judge.chat.base_url={service.address}/v1",
        "judge.chat.key_variable=TEST_KEY",
        "judge.samples=2",
    ]


def test_a_finished_run_is_judged_once(
    run: Path, project: Path, service: Service, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    looked = parse_arguments([str(run), "--dry-run", "--sheets", str(tmp_path / "sheets"), *overrides(service)])
    assert judge_run(looked, project=project) is None
    assert "6 requests to gpt-5.2-2025-12-11" in capsys.readouterr().out
    assert len(list((tmp_path / "sheets").glob("*.png"))) == 3
    asked = parse_arguments([str(run), *overrides(service)])
    with pytest.raises(UserError, match="would send 6 requests; add --yes"):
        judge_run(asked, project=project)
    assert service.asked == [], "looking sends nothing"
    judged = judge_run(parse_arguments([str(run), "--yes", *overrides(service)]), project=project)
    assert judged is not None
    assert len(service.asked) == 6
    assert judged[0].text("backbone", "insertion") == "4.00 ± 0.00"
    assert judged[0].text("captured", "insertion") == "–"
    assert judged[0].text("omnivggt", "quality") == "needs the public checkpoint"
    assert JudgedRound.load(run / "judged" / "yard" / "round_1") == judged[0]
    assert judge_run(asked, project=project) == judged, "what is known needs no consent"
    assert len(service.asked) == 6


def test_the_stage_asks_nobody_unless_told_and_nobody_twice(
    run: Path, project: Path, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run)
    place = Path("outputs/yard")
    stage = judge_stage.main.__wrapped__  # type: ignore[attr-defined]
    write_settings(place / "config.json", compose(CONF, []))
    stage(Cell(scene="yard", round=1))
    assert JudgedRound.load(place / "round_1/judged").text("backbone", "quality") == "no judge"
    assert service.asked == []
    write_settings(place / "config.json", compose(CONF, overrides(service)))
    stage(Cell(scene="yard", round=1))
    stage(Cell(scene="yard", round=1))
    assert len(service.asked) == 6, "forced, it comes from the cache"
    assert JudgedRound.load(place / "round_1/judged").text("backbone", "quality") == "4.00 ± 0.00"
    assert len(list((place / "round_1/judged/requests").glob("*.json"))) == 3
    assert len(list((project / JUDGED_FOLDER).rglob("*.json"))) == 6
    assert KEY not in json.dumps([path.read_text() for path in project.rglob("*.json") if path.is_file()])


def test_preflight_sends_nothing(project: Path, service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = CONF.parent / "scenes" / "courtyard"
    check_scene("courtyard", scene, conf=CONF, overrides=overrides(service))
    assert service.asked == []
    monkeypatch.delenv("TEST_KEY")
    with pytest.raises(UserError, match="TEST_KEY: is not set"):
        check_scene("courtyard", scene, conf=CONF, overrides=overrides(service))


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["nowhere", "judge.samples=1"], "does not exist"),
        ([".", "adapt.steps=1"], "is not a setting of the judge"),
        ([".", "judge=none"], "judge: names nobody"),
        ([".", "judge.samples=0"], "judge.samples"),
        ([".", "judge.insertion_prompt=/nowhere.txt", "judge.chat.key_variable=null"], "does not exist"),
    ],
)
def test_what_is_wrong_is_one_line(
    arguments: list[str], problem: str, run: Path, project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run)
    with pytest.raises(UserError) as caught:
        judge_run(parse_arguments([*arguments, "--yes"]), project=project)
    assert problem in caught.value.line()
    assert "\n" not in caught.value.line()
