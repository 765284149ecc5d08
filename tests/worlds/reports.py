"""What a report is gathered from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from sceneexpander.adaptation.observe import Look
from sceneexpander.artifacts.inserted import InsertedView, Provenance
from sceneexpander.artifacts.metrics import MetricsRow, UnavailableRow
from sceneexpander.artifacts.scene import RoundSpec, Scene
from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.artifacts.unavailable import Unavailable
from sceneexpander.artifacts.views import ViewRecord, ViewSet
from sceneexpander.insertion.acceptance import Acceptance
from sceneexpander.photometric.report import FitReport
from sceneexpander.rendering.config import RenderConfig
from sceneexpander.rendering.produce import produce_renders
from sceneexpander.report import MethodSource, RoundSource, SceneSource, collect_scene
from sceneexpander.viewer.packed import pack_splats
from tests.worlds.row_of_views import HEIGHT, WIDTH, reconstruction

NASTY = '<script>alert("1")</script> & "quotes"'


IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


METHODS = ("captured", "backbone", "sceneexpander")


HARM = "the adaptation harms the captured views: they rendered at 22.25 dB before it and at 21.50 dB after step 40"


FITTING = Acceptance(
    posed=True, overlap=0.451, depth_conflict=0.006, colour_conflict=0.013, cameras_moved_deg=0.034, reasons=()
)


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


def look(step: int, captured_psnr: float) -> Look:
    moved = {"network.trunk": 0.03 * step, "network.stem": 0.04 * step} if step else {}
    return Look(
        step=step,
        captured_psnr=captured_psnr,
        inserted_psnr=18.0 + step / 100,
        captured_depth_change=0.034,
        head_disagreement=0.014,
        drift=moved,
    )


def save_looks(folder: Path, looks: list[Look], warnings: list[str]) -> None:
    for item in looks:
        for kind in ("captured", "inserted", "depth"):
            (folder / "looks").mkdir(parents=True, exist_ok=True)
            Image.new("RGB", (8, 6)).save(folder / "looks" / f"{kind}_{item.step:04d}.jpg")
    write_json_atomic(folder / "looks.json", {"identity": "abc", "looks": looks, "warnings": warnings})


def row(method: str, psnr: float) -> MetricsRow:
    captured = {
        "views_captured": 2.0,
        "gaussians": 10.0,
        "psnr_captured_db": psnr,
        "ssim_captured": 0.5,
        "psnr_at_photo_size_db": psnr - 1,
        "ssim_at_photo_size": 0.4,
        "seen_through_at_photo_size": 0.25,
    }
    inserted = {"views_generated": 1.0, "psnr_inserted_db": psnr / 2, "psnr_at_picture_size_db": psnr / 2 - 1}
    return MetricsRow(
        scene="room",
        round=1,
        method=method,
        model="mini",
        weights_sha256="2" * 64,
        seed=0,
        values=captured | ({} if method == "captured" else inserted),
    )


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> SceneSource:
    folder = tmp_path_factory.mktemp("artefacts")
    views = view("v0").append(view("v1"))
    Scene(
        name="room",
        views=views,
    ).save(folder / "scene")
    RoundSpec(prompt=NASTY).save(folder / "asked")
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
    write_json_atomic(
        folder / "log.json",
        [{"loss": 2.0 / step, "inserted": step == 2, "gen_depth": 0.5 * (step == 2)} for step in (1, 2, 3)],
    )
    save_looks(folder, [look(0, 22.25), look(40, 21.5)], [HARM])
    write_json_atomic(folder / "acceptance.json", FITTING)
    write_json_atomic(folder / "captured" / "refinement.json", FitReport(steps=80, before=0.082, after=0.0312))
    return SceneSource(
        scene=folder / "scene",
        report=folder / "report.json",
        statistics=folder / "none",
        rounds=[
            RoundSource(
                number=1,
                asked=folder / "asked",
                inserted=folder / "inserted",
                methods=[
                    MethodSource(
                        name=name,
                        reconstruction=folder / name,
                        renders=folder / "renders" / name,
                        splats=folder / "packed" / name,
                        metrics=folder / "metrics" / f"{name}.json",
                        report=folder / name / "report.json",
                        refinement=folder / name / "refinement.json",
                    )
                    for name in (*METHODS, "ttt3r")
                ],
                log=folder / "log.json",
                statistics=folder / "stats",
            )
        ],
        settings={"seed": "0", "device": "cpu", "model.weights": "builtin", "adapt.steps": "3", "refine.visits": "2"},
        overrides=["profile=smoke"],
    )


@pytest.fixture(scope="module")
def gathered(source: SceneSource, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pages") / "room"
    folder.mkdir()
    collect_scene(source, folder)
    return folder
