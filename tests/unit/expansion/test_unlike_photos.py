"""Photos that are not all alike, as files through the door: cameras are right, or the view is named and left out."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from sceneexpander.errors import UserError
from sceneexpander.frontend.sfm import estimate_cameras
from sceneexpander.frontend.sfm_types import LearnedUse, SfmConfig, SparseReconstruction
from sceneexpander.ingest import IngestConfig, read_views
from sceneexpander.reconstruction.cameras import announce_cameras, report_cameras, straighten_views
from sceneexpander.reconstruction.optics import optics_of

SCENE = Path(__file__).parents[3] / "scenes" / "courtyard"
CONFIG = SfmConfig(learned=LearnedUse.NEVER)
FEWER = SfmConfig(learned=LearnedUse.NEVER, max_features=2000)  # enough to tell which photo is odd
FOCAL_PX = 691.2  # of the bundled photos
Change = Callable[[Image.Image, int], Image.Image]


def photos(folder: Path, change: Change, count: int = 5, **save: object) -> list[Path]:
    paths = []
    for number, source in enumerate(sorted((SCENE / "captured").glob("*.jpg"))[:count]):
        with Image.open(source) as picture:
            made = change(picture.convert("RGB"), number)
        path = folder / source.name
        made.save(path, quality=95, **save)
        paths.append(path)
    return paths


class Posed:
    """What the front-end makes of files, against the truth."""

    def __init__(self, paths: list[Path], config: SfmConfig = CONFIG) -> None:
        self.views = read_views(paths, IngestConfig()).views
        self.found: SparseReconstruction = estimate_cameras(
            self.views.images,
            config,
            generator=torch.Generator().manual_seed(0),
            feature_images=self.views.detail_images,
            names=[record.name for record in self.views.records],
            optics=optics_of(self.views),
            valid=self.views.valid,
        )
        self.report = report_cameras(self.views, self.found)

    def errors_deg(self) -> tuple[float, float]:
        """(largest rotation, largest direction) error over pairs of posed views."""
        truth = {
            Path(view["file"]).name: np.array(view["world_from_cam"])
            for view in json.loads((SCENE / "truth" / "cameras.json").read_text())["captured"]
        }
        posed = [k for k, view in enumerate(self.report.views) if view.posed and not view.rough]
        worst = np.zeros(2)
        for a, b in combinations(posed, 2):
            poses = self.found.world_from_cam.double().numpy()
            mine = np.linalg.inv(poses[a]) @ poses[b]
            names = self.report.views[a].name, self.report.views[b].name
            true = np.linalg.inv(truth[names[0]]) @ truth[names[1]]
            turn = np.rad2deg(np.arccos(np.clip((np.trace(mine[:3, :3].T @ true[:3, :3]) - 1) / 2, -1, 1)))
            x, y = mine[:3, 3], true[:3, 3]
            direction = np.rad2deg(np.arctan2(np.linalg.norm(np.cross(x, y)), x @ y))
            worst = np.maximum(worst, [turn, direction])
        return float(worst[0]), float(worst[1])

    def focal_px(self, view: int) -> float:
        """In original pixels."""
        scale = self.views.records[view].stored_from_original[0][0]
        return float(self.found.intrinsics_px[view, 0, 0]) / scale


def held(picture: Image.Image, *, turned: bool) -> Image.Image:
    """As one phone takes it, level or turned: the same focal in pixels, the same long side."""
    width, height = (432, 576) if turned else (576, 432)
    left, top = (picture.width - width) // 2, (picture.height - height) // 2
    return picture.crop((left, top, left + width, top + height))


def through_barrel(picture: Image.Image, number: int) -> Image.Image:
    pixels = np.asarray(picture)
    height, width = pixels.shape[:2]
    matrix = np.array([[FOCAL_PX, 0, width / 2], [0, FOCAL_PX, height / 2], [0, 0, 1.0]])
    grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).reshape(-1, 1, 2)
    source = cv2.undistortPoints(grid, matrix, np.array([-0.22, 0.05, 0, 0]), P=matrix).reshape(height, width, 2) - 0.5
    x, y = (source[..., axis].astype(np.float32) for axis in (0, 1))
    return Image.fromarray(cv2.remap(pixels, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))


def test_a_phone_held_level_and_turned_is_one_camera(tmp_path: Path) -> None:
    made = Posed(photos(tmp_path, lambda picture, number: held(picture, turned=number in (0, 3))))
    assert made.report.posed == 5
    turn, direction = made.errors_deg()
    assert turn < 0.5
    assert direction < 1.0
    assert [made.focal_px(view) for view in range(5)] == pytest.approx([FOCAL_PX] * 5, rel=0.02)


@pytest.mark.slow
def test_a_cropped_photo_gets_its_centre_or_is_named(tmp_path: Path) -> None:
    def cut(picture: Image.Image, number: int) -> Image.Image:
        return picture.crop((0, 0, int(picture.width * 0.7), int(picture.height * 0.7))) if number == 4 else picture

    made = Posed(photos(tmp_path, cut))
    assert made.report.posed >= 4
    turn, direction = made.errors_deg()
    assert turn < 0.5
    assert direction < 2.0
    assert "cropped" in " ".join([*made.report.views[4].warnings, made.report.views[4].reason])
    assert not made.report.views[0].warnings


def test_a_zoomed_photo_is_right_or_named(tmp_path: Path) -> None:
    def zoomed(picture: Image.Image, number: int) -> Image.Image:
        if number != 4:
            return picture
        width, height = picture.size
        part = picture.crop((width // 4, height // 4, width // 4 + width // 2, height // 4 + height // 2))
        return part.resize(picture.size, Image.Resampling.LANCZOS)

    made = Posed(photos(tmp_path, zoomed), FEWER)
    turn, direction = made.errors_deg()
    assert turn < 0.5
    assert direction < 2.0
    assert made.report.posed >= 4
    if made.report.posed == 4:
        assert "view_05.jpg left out (" in made.report.summary()
        assert made.report.summary().startswith("4 of 5 photos used")


@pytest.mark.slow
def test_a_bent_lens_is_straightened(tmp_path: Path) -> None:
    made = Posed(photos(tmp_path, through_barrel))
    assert made.report.posed == 5
    turn, direction = made.errors_deg()
    assert turn < 0.5
    assert direction < 1.0
    assert made.report.views[0].distortion[0] == pytest.approx(-0.22, abs=0.03)
    straight = straighten_views(made.views, made.found.distortion)
    assert straight.records[0].distortion == made.report.views[0].distortion
    # Against the photos as a straight lens takes them, where both show something: the warp is right to a fraction of a pixel.
    plain = read_views(photos(tmp_path, lambda picture, number: picture), IngestConfig()).views
    inner = (slice(None), slice(None), slice(20, -20), slice(20, -20))
    before = float((made.views.images - plain.images)[inner].abs().mean())
    after = float((straight.images - plain.images)[inner].abs().mean())
    assert after < 0.35 * before


def test_exif_decides_where_two_photos_cannot(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 31  # 691 px of a diagonal of 960, in parts of 43.3 mm
    made = Posed(photos(tmp_path, lambda picture, number: picture, count=2, exif=exif.tobytes()))
    assert made.report.posed == 2
    assert made.focal_px(0) == pytest.approx(FOCAL_PX, rel=0.03)


@pytest.mark.slow
def test_wrong_exif_is_outvoted_and_said(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 75
    made = Posed(photos(tmp_path, lambda picture, number: picture, exif=exif.tobytes()))
    turn, direction = made.errors_deg()
    assert turn < 0.5
    assert direction < 1.0
    assert made.focal_px(0) == pytest.approx(FOCAL_PX, rel=0.03)
    assert all("75 mm" in " ".join(view.warnings) for view in made.report.views)


def test_strict_ends_the_run_and_otherwise_it_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    mirrored = photos(
        tmp_path,
        lambda picture, number: picture.transpose(Image.Transpose.FLIP_LEFT_RIGHT) if number == 2 else picture,
        3,
    )
    made = Posed(mirrored, FEWER)
    assert [view.posed for view in made.report.views] == [True, True, False]
    assert "mirrored" in made.report.views[2].reason
    with caplog.at_level(logging.INFO):
        announce_cameras(made.report, strict=False)
    assert "2 of 3 photos used: view_03.jpg left out (it is mirrored" in caplog.text
    with pytest.raises(UserError, match=r"view_03.jpg: left out, it is mirrored.*frontend.strict=false"):
        announce_cameras(made.report, strict=True)
