"""What of an inserted picture the scene supports, and what it contradicts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sceneexpander.artifacts.agreement import MisalignmentReport
from sceneexpander.artifacts.inserted import InsertedView, Provenance
from sceneexpander.files import directory_being_written
from sceneexpander.generation import SceneSoFar
from sceneexpander.generation.assess import frame_of
from sceneexpander.generation.misalignment import report_misalignment
from sceneexpander.ingest.fit import FittedPicture, fit_picture
from tests.worlds.painted_wall import HEIGHT, WIDTH, blobs, tensor, view_of_wall
from tests.worlds.rounds import flat_scene, made_views


@pytest.fixture(scope="module")
def so_far() -> SceneSoFar:
    detail = tensor(view_of_wall(0.0))[None].repeat(3, 1, 1, 1)
    images = detail.unflatten(-1, (-1, 2)).unflatten(-3, (-1, 2)).mean((-1, -3))
    return flat_scene(made_views(images, detail), apart=0.0)


@pytest.fixture(scope="module")
def fitted(so_far: SceneSoFar) -> Callable[[np.ndarray], FittedPicture]:
    return lambda pixels: fit_picture(pixels, frame_of(so_far.views))


def test_a_photo_from_beside_is_supported_as_far_as_the_scene_was_seen(
    so_far: SceneSoFar, fitted: Callable[[np.ndarray], FittedPicture]
) -> None:
    found = report_misalignment(fitted(view_of_wall(60.0)), so_far, seed=0)
    report = found.report
    assert report.contradicted is not None
    assert report.contradicted < 0.01
    assert report.new == pytest.approx(60 / (2 * WIDTH), abs=0.04)
    assert report.supported == pytest.approx(1 - 60 / (2 * WIDTH), abs=0.04)
    assert report.world_from_cam is not None
    # The wall is 2 away and one picture width wide in focal lengths: 60 of 360 detail pixels are a third of a unit.
    assert [row[3] for row in report.world_from_cam[:3]] == pytest.approx([2 * 60 / (2 * WIDTH), 0, 0], abs=0.02)
    assert report.focal_factor == pytest.approx(1, abs=0.03)
    assert report.stretch == pytest.approx(0, abs=0.01)
    assert found.overlay is not None
    assert found.overlay.shape == (3, HEIGHT, 3 * WIDTH)


def test_what_the_photos_show_otherwise_is_marked_where_it_is(
    so_far: SceneSoFar, fitted: Callable[[np.ndarray], FittedPicture]
) -> None:
    pixels = view_of_wall(0.0).copy()
    pixels[80:160, 120:240] = (250, 0, 250)  # an object that is not there
    found = report_misalignment(fitted(pixels), so_far, seed=0)
    assert found.support is not None
    assert found.report.gains == pytest.approx((1, 1, 1), abs=0.02), "the object does not change the tone of the rest"
    inside = found.support[44:76, 64:116]
    assert float(inside.mean()) < 0.05
    outside = found.support.clone()
    outside[36:84, 56:124] = 1
    assert float(outside.mean()) > 0.99
    assert found.report.contradicted == pytest.approx(80 * 120 / (4 * HEIGHT * WIDTH), rel=0.2)


def test_another_exposure_is_no_contradiction(
    so_far: SceneSoFar, fitted: Callable[[np.ndarray], FittedPicture]
) -> None:
    dark = (view_of_wall(0.0) * 0.6).astype(np.uint8)
    report = report_misalignment(fitted(dark), so_far, seed=0).report
    assert report.gains == pytest.approx((0.6, 0.6, 0.6), abs=0.03)
    assert report.contradicted is not None
    assert report.contradicted < 0.02


@pytest.mark.parametrize("stretch", [-0.05, 0.04, 0.08])
def test_a_stretched_picture_is_told_by_its_matches(
    so_far: SceneSoFar, fitted: Callable[[np.ndarray], FittedPicture], stretch: float
) -> None:
    width = round(2 * WIDTH * (1 + stretch))
    wide = np.asarray(Image.fromarray(view_of_wall(20.0)).resize((width, 2 * HEIGHT), Image.Resampling.BICUBIC))
    if width > 2 * WIDTH:
        left = (width - 2 * WIDTH) // 2
        wide = wide[:, left : left + 2 * WIDTH]
    else:  # the ratio of the frame, by cutting above and below
        height = round(width * HEIGHT / WIDTH)
        top = (2 * HEIGHT - height) // 2
        wide = wide[top : top + height]
    report = report_misalignment(fitted(wide), so_far, seed=0).report
    assert report.stretch == pytest.approx(stretch, abs=0.012)
    assert ("too wide" if stretch > 0 else "too narrow") in report.words


def test_a_picture_of_another_place_has_no_camera(
    so_far: SceneSoFar, fitted: Callable[[np.ndarray], FittedPicture], tmp_path: Path
) -> None:
    found = report_misalignment(fitted(blobs(9, 2 * HEIGHT, 2 * WIDTH)), so_far, seed=0)
    assert found.report.world_from_cam is None
    assert found.support is None
    assert found.overlay is None
    assert "its camera is not found" in found.report.words


def test_the_report_is_kept_with_the_view(so_far: SceneSoFar, tmp_path: Path) -> None:
    report = MisalignmentReport(
        inliers=50, matches=60, reprojection_px=0.5, world_from_cam=((1.0, 0.0), (0.0, 1.0)), focal_factor=1.2,
        stretch=None, gains=(1.0, 1.0, 1.0), supported=0.5, contradicted=0.25, new=0.25,
    )  # fmt: skip
    assert "drawn 20% larger" in report.words
    views = so_far.views
    one = made_views(views.images[:1], views.detail_images[:1])
    source = Provenance(backend="file", prompt="", source="x", sha256="0")
    support = (views.images[0, 0] > 0.5).float()
    made = InsertedView(round=1, view=one, chosen=0, provenance=(source,), misalignment=report, support=support)
    with directory_being_written(tmp_path / "inserted") as folder:
        made.save(folder)
    read = InsertedView.load(tmp_path / "inserted")
    assert read.misalignment == report
    assert read.support is not None
    assert bool((read.support == support).all())
