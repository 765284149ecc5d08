"""A report that has cameras to tell of."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from sceneexpander.artifacts.cameras import CameraReport, ViewCamera
from sceneexpander.report import SceneSource

FINE = ViewCamera(
    view_id="v0",
    name="a.jpg",
    generated=False,
    posed=True,
    rough=False,
    reason="",
    warnings=(),
    focal_ratio=0.75,
    focal_source="refined",
    distortion=(0.0, 0.0),
    inliers=120,
    error_px=0.5,
)


LOST = replace(FINE, view_id="v1", name="b <1>.jpg", posed=False, reason="its matches agree with no camera", inliers=0)


NEW = replace(FINE, view_id="v2", name="new.png", generated=True, rough=True, reason="few points")


PHOTOS = CameraReport(views=(FINE, LOST), notes=("two cameras took the photos",))


ALL = CameraReport(views=(FINE, LOST, NEW), notes=())


def saved(folder: Path, report: CameraReport) -> Path:
    report.save(folder)
    return folder


def with_cameras(source: SceneSource, folder: Path) -> SceneSource:
    rounds = [replace(item, cameras=saved(folder / "all", ALL)) for item in source.rounds]
    return replace(source, cameras=saved(folder / "photos", PHOTOS), rounds=rounds)
