"""The page from made-up artefacts: complete, offline, and safe with any text."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
import torch

from sceneexpander.artifacts.inserted import InsertedView, Provenance
from sceneexpander.artifacts.metrics import MetricsRow, UnavailableRow
from sceneexpander.artifacts.scene import RoundSpec, Scene
from sceneexpander.artifacts.store import ArtifactError, read_json, write_json_atomic
from sceneexpander.artifacts.unavailable import Unavailable
from sceneexpander.artifacts.views import ViewRecord, ViewSet
from sceneexpander.rendering import RenderConfig, produce_renders
from sceneexpander.report import MethodSource, RoundSource, SceneSource, collect_scene, write_page
from sceneexpander.report.curve import loss_curve
from sceneexpander.report.words import COLUMNS
from sceneexpander.tracking import scene_runs
from sceneexpander.viewer.packed import pack_splats
from tests.unit.rendering.test_tour import HEIGHT, WIDTH, reconstruction

NASTY = '<script>alert("1")</script> & "quotes"'
IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
METHODS = ("captured", "backbone", "sceneexpander")
LACKING = Unavailable(method="ttt3r", model="ttt3r", reason="needs the public checkpoint")


def view(view_id: str, *, generated: bool = False) -> ViewSet:
    record = ViewRecord(
        view_id=view_id,
        name=f"{view_id}.jpg",
        original_height=HEIGHT,
        original_width=WIDTH,
        sha256="1" * 64,
        stored_from_original=IDENTITY,
        generated=generated,
        round=int(generated),
    )
    picture = torch.rand(1, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(len(view_id)))
    return ViewSet(records=(record,), images=picture, detail_images=picture)


def row(method: str, psnr: float) -> MetricsRow:
    return MetricsRow(
        scene="room",
        round=1,
        method=method,
        model="mini",
        weights_sha256="2" * 64,
        seed=0,
        captured_views=2,
        generated_views=int(method != "captured"),
        gaussians=10,
        generated_gaussians=0,
        psnr_db=psnr,
        ssim=0.5,
        coverage=1.0,
        inserted_psnr_db=None if method == "captured" else psnr / 2,
    )


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> SceneSource:
    folder = tmp_path_factory.mktemp("artefacts")
    views = view("v0").append(view("v1"))
    Scene(name="room", views=views, rounds=(RoundSpec(prompt=NASTY),)).save(folder / "scene")
    provenance = Provenance(
        backend="replay",
        prompt=f"Add: {NASTY}",
        source="new.png",
        sha256="3" * 64,
        parameters={"warning": "is blurred"},
    )
    InsertedView(round=1, view=view("v2", generated=True), chosen=0, provenance=(provenance,)).save(folder / "inserted")
    backbone = reconstruction("backbone", [0.0, 0.4, 1.5], generated=1)
    made = {
        "captured": reconstruction("captured", [0.0, 0.4]),
        "backbone": replace(backbone, posed=torch.tensor([True, True, False])),
        "sceneexpander": replace(backbone, method="sceneexpander"),
    }
    for index, (name, item) in enumerate(made.items()):
        item.save(folder / name)
        (folder / "renders" / name).mkdir(parents=True)
        produce_renders(item, backbone, RenderConfig(frames=5, stills=2), folder / "renders" / name)
        pack_splats(item).save(folder / "packed" / name)
        row(name, 20.0 + index).save(folder / "metrics" / f"{name}.json")
    write_json_atomic(folder / "backbone" / "report.json", {"licence": "not for resale"})
    for place in (folder, folder / "renders", folder / "packed"):
        LACKING.save(place / "ttt3r")
    UnavailableRow(scene="room", round=1, method="ttt3r", model="ttt3r", seed=0, reason=LACKING.reason).save(
        folder / "metrics" / "ttt3r.json"
    )
    write_json_atomic(
        folder / "report.json",
        {"model": "mini", "weights_sha256": "4" * 64, "licence": "free", "warmup": None, "sparse_points": 7},
    )
    host = {"machine": "x86_64", "cpus": 2, "torch": "2"}
    write_json_atomic(
        folder / "stats" / "adapt.json",
        {"started": 1.7e9, "wall_s": 2.0, "cpu_s": 2.0, "peak_rss_mb": 99.0, "host": host},
    )
    write_json_atomic(folder / "log.json", [{"loss": 2.0 / step, "drift": 0.0} for step in (1, 2, 3)])
    return SceneSource(
        scene=folder / "scene",
        report=folder / "report.json",
        statistics=folder / "none",
        rounds=[
            RoundSource(
                number=1,
                inserted=folder / "inserted",
                methods=[
                    MethodSource(
                        name=name,
                        reconstruction=folder / name,
                        renders=folder / "renders" / name,
                        splats=folder / "packed" / name,
                        metrics=folder / "metrics" / f"{name}.json",
                        report=folder / name / "report.json",
                    )
                    for name in (*METHODS, "ttt3r")
                ],
                log=folder / "log.json",
                statistics=folder / "stats",
            )
        ],
        config={
            "seed": 0,
            "device": "cpu",
            "model": {"weights": "builtin"},
            "adapt": {"steps": 3},
            "refine": {"steps": 2},
        },
        overrides=["profile=smoke"],
    )


@pytest.fixture(scope="module")
def gathered(source: SceneSource, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pages") / "room"
    folder.mkdir()
    collect_scene(source, folder)
    return folder


@pytest.fixture(scope="module")
def page(gathered: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    write_page([gathered], folder)
    return folder / "index.html"


class Links(HTMLParser):
    """Everything the page loads."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.scripts = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.scripts += tag == "script"
        for name, value in attrs:
            if (
                (name in {"src", "poster", "href"} or (name.startswith("data-") and tag == "video"))
                and value
                and "/" in value
            ):
                self.found.append(value)


def test_every_file_it_names_is_there_and_none_is_remote(page: Path) -> None:
    links = Links()
    links.feed(page.read_text())
    assert len(links.found) > 20
    assert "media/room/round_1/viewer.html" in links.found
    for place in links.found:
        assert (page.parent / place).is_file(), place
    assert not re.search(r"(https?:)?//[a-z]", page.read_text().replace("http://www.w3.org", ""))


def test_text_from_users_stays_text(page: Path) -> None:
    html = page.read_text()
    assert "<script>alert" not in html
    assert "&lt;script&gt;alert" in html
    links = Links()
    links.feed(html)
    assert links.scripts == 1, "only the player's own"


def test_it_says_what_rows_and_columns_mean_and_what_went_wrong(page: Path) -> None:
    html = page.read_text()
    assert "SceneExpander on mini" in html
    assert "WorldMirror" not in html
    assert "ceiling of preservation" in html
    shown = [column for column in COLUMNS if column.name in {"psnr_db", "ssim", "inserted_psnr_db"}]
    for column in shown:
        assert column.meaning.split(":")[0] in html
    assert "backbone: no camera could be estimated for v2" in html
    assert "is blurred" in html
    assert "not for resale" in html, "a method with weights of its own says whose they are"


def test_a_method_that_could_not_be_run_says_why_where_its_numbers_would_be(page: Path) -> None:
    rows = page.read_text().split("<tbody>")[1].split("</tbody>")[0].split("<tr ")
    (lacking,) = [row for row in rows if 'class="ttt3r"' in row]
    assert "needs the public checkpoint" in lacking
    assert not re.search(r">[\d.]+<", lacking), "no number"


def test_bold_compares_methods_with_the_inserted_view(page: Path) -> None:
    table = page.read_text().split("<tbody>")[1].split("</tbody>")[0]
    bold = re.findall(r'<td class="best">([^<]+)</td>', table)
    assert "22.00" in bold
    assert "20.00" not in bold, "captured only is a ceiling, not a competitor"


def test_gathering_repeats_bit_for_bit(source: SceneSource, gathered: Path, tmp_path: Path) -> None:
    collect_scene(source, tmp_path)
    for path in sorted(gathered.rglob("*")):
        if path.is_file():
            assert path.read_bytes() == (tmp_path / path.relative_to(gathered)).read_bytes(), path.name


def test_a_missing_video_is_named(source: SceneSource, tmp_path: Path) -> None:
    broken = replace(source.rounds[0], methods=[replace(source.rounds[0].methods[0], renders=tmp_path / "no")])
    with pytest.raises(ArtifactError, match="does not exist"):
        collect_scene(replace(source, rounds=[broken]), tmp_path / "out")


def test_runs_to_track_come_from_the_same_folder(gathered: Path, tmp_path: Path) -> None:
    ply = tmp_path / "gaussians.ply"
    ply.write_bytes(b"ply")
    runs = {run.tags["method"]: run for run in scene_runs(gathered, commit="abc", extra=lambda number, method: [ply])}
    lacking = runs.pop("ttt3r")
    assert not lacking.metrics
    assert lacking.tags["unavailable"] == "needs the public checkpoint"
    assert set(runs) == set(METHODS)
    assert len({run.key for run in (*runs.values(), lacking)}) == 4
    adapted = runs["sceneexpander"]
    assert adapted.series["loss/loss"] == (2.0, 1.0, 2.0 / 3)
    assert not runs["backbone"].series
    assert adapted.metrics["psnr_db"] == 22.0
    assert adapted.params["adapt.steps"] == "3"
    assert adapted.tags["reconstructor"] == "mini"
    assert (adapted.started_ms, adapted.duration_ms) == (1_700_000_000_000, 2000)
    for run in runs.values():
        for place, path in run.artefacts.items():
            assert path.is_file(), place
            assert place.rpartition("/")[2] == path.name
    assert scene_runs(gathered, commit="other")[0].key == scene_runs(gathered, commit="abc")[0].key


def test_facts_hold_no_absolute_path(gathered: Path) -> None:
    text = (gathered / "page.json").read_text()
    assert str(gathered.parent) not in text
    assert read_json(gathered / "page.json")["rounds"][0]["backend"] == "replay"


def test_a_curve_of_nothing_is_nothing() -> None:
    assert loss_curve([]) == ""
    assert loss_curve([float("nan")]) == ""
    assert "polyline" in loss_curve([1.0, 1.0])
