"""The truth of the benchmark's photos is the camera that took them, whatever was done to the file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import cv2
import frontend_poses
import numpy as np
import pytest
import torch
import unlike_photos
from PIL import Image
from unlike_photos import CASES, Photo, Place, place_of

from sceneexpander.errors import UserError
from sceneexpander.ingest import IngestConfig, read_views
from sceneexpander.synthetic import encode_radiance, render_world
from sceneexpander.synthetic.render import cameras_at

BENT = {"barrel": (-0.22, 0.05), "pincushion": (0.12, 0.0), "mild_barrel": (-0.06, 0.0)}
CAMERALESS = {"noise", "black", "textureless", "watermark_alone"}


@pytest.fixture(autouse=True)
def place(monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    """A room, photographed small."""
    for name, value in (("HEIGHT", 144), ("WIDTH", 192), ("LONG", 192)):
        monkeypatch.setattr(unlike_photos, name, value)
    for cached in (unlike_photos.place_of, unlike_photos.take, unlike_photos._elsewhere):
        cached.cache_clear()
    yield place_of("1")
    for cached in (unlike_photos.place_of, unlike_photos.take, unlike_photos._elsewhere):
        cached.cache_clear()


def rendered(place: Place, photo: Photo) -> np.ndarray:
    """What the photo's camera sees."""
    height, width = photo.pixels.shape[:2]
    assert photo.world_from_cam is not None
    camera = cameras_at(photo.world_from_cam, photo.intrinsics, height, width)
    picture = render_world(place.world, camera, supersample=1.0)
    return encode_radiance(picture.radiance[0], place.exposure) * 255


def likeness(shown: np.ndarray, expected: np.ndarray) -> float:
    """Correlation of the brightness of two pictures, slightly blurred."""
    grey = [
        cv2.GaussianBlur(cv2.cvtColor(picture.astype(np.float32), cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
        for picture in (shown, expected)
    ]
    return float(np.corrcoef(grey[0].ravel(), grey[1].ravel())[0, 1])


@pytest.mark.parametrize("case", sorted(CASES.keys() - CAMERALESS - {"watermark", "status_bar", "letterbox"}))
def test_every_photo_is_what_its_true_camera_sees(case: str, place: Place) -> None:
    photos = [photo for photo in CASES[case](place) if photo.world_from_cam is not None]
    assert photos
    for photo in photos:
        pixels = photo.pixels
        if case in BENT:
            pixels = cv2.undistort(np.ascontiguousarray(pixels), photo.intrinsics, np.array([*BENT[case], 0, 0]))
        inner = (slice(10, -10), slice(10, -10))  # nothing comes from beyond the edge of a bent picture
        moved = np.roll(pixels, 3, axis=1)
        expected = rendered(place, photo)
        assert likeness(pixels[inner], expected[inner]) > max(0.97, likeness(moved[inner], expected[inner]) + 0.02)


def test_bars_keep_the_camera(place: Place) -> None:
    for photo in CASES["letterbox"](place):
        expected = rendered(place, photo)
        assert photo.pixels.shape == (192, 192, 3)
        assert likeness(photo.pixels[24:168], expected[24:168]) > 0.97
        assert not photo.pixels[:24].any()


@pytest.mark.parametrize("case", ["status_bar", "watermark"])
def test_overlays_are_the_same_in_all_photos_and_leave_the_truth_alone(case: str, place: Place) -> None:
    plain, drawn = CASES["plain"](place), CASES[case](place)
    changed = [(a.pixels != b.pixels).any(-1) for a, b in zip(plain, drawn, strict=True)]
    for mask, photo in zip(changed, drawn, strict=True):
        assert 0.02 < mask.mean() < 0.5
        assert (mask == changed[0]).mean() > 0.97
        assert (
            likeness(np.where(mask[..., None], 0, photo.pixels), np.where(mask[..., None], 0, rendered(place, photo)))
            > 0.97
        )


@pytest.mark.parametrize("case", ["mirrored_one", "unrelated_one"])
def test_a_photo_without_a_camera_has_no_truth(case: str, place: Place) -> None:
    photos = CASES[case](place)
    assert [photo.world_from_cam is None for photo in photos] == [False] * 4 + [True]


REFUSED = {"black", "recompressed_three"}  # at the door: fewer than two different pictures


@pytest.mark.parametrize("case", sorted(REFUSED))
def test_the_door_refuses_what_is_one_picture(case: str, place: Place, tmp_path: Path) -> None:
    paths = [unlike_photos.write_photo(photo, tmp_path, f"photo_{k}") for k, photo in enumerate(CASES[case](place))]
    with pytest.raises(UserError, match="different picture"):
        read_views(paths, IngestConfig(long_side_px=112))


@pytest.mark.parametrize(
    "case", ["phone_two_turned", "grey_one", "mixed_sizes", *sorted(set(CAMERALESS) - {*REFUSED, "textureless"})]
)
def test_the_door_takes_every_set(case: str, place: Place, tmp_path: Path) -> None:
    photos = CASES[case](place)
    paths = [unlike_photos.write_photo(photo, tmp_path, f"photo_{k}") for k, photo in enumerate(photos)]
    loaded = read_views(paths, IngestConfig(long_side_px=112))
    assert [record.name for record in loaded.views.records] == [path.name for path in paths]
    for record, photo in zip(loaded.views.records, photos, strict=True):
        assert (record.original_height, record.original_width) == photo.pixels.shape[:2]


@pytest.mark.parametrize(
    ("case", "view", "millimetres"),
    [("exif_wrong_five", 0, 28), ("exif_zoomed", 4, 26), ("exif_zoomed_included", 4, 52)],
)
def test_files_say_what_the_case_wants(case: str, view: int, millimetres: int, place: Place, tmp_path: Path) -> None:
    photo = CASES[case](place)[view]
    with Image.open(unlike_photos.write_photo(photo, tmp_path, "photo")) as file:
        assert file.getexif().get_ifd(0x8769)[0xA405] == millimetres


def judged(photos: list[Photo], folder: Path, *, spoiled: int | None = None, note: str = "") -> frontend_poses.CaseSet:
    """The verdict on the true cameras as if they had been estimated, one of them turned away by 10 degrees."""
    paths = [unlike_photos.write_photo(photo, folder, f"photo_{k}") for k, photo in enumerate(photos)]
    views = read_views(paths, IngestConfig(long_side_px=112)).views
    poses = np.stack([np.eye(4) if p.world_from_cam is None else p.world_from_cam for p in photos])
    if spoiled is not None:
        poses[spoiled, :3, :3] = poses[spoiled, :3, :3] @ cv2.Rodrigues(np.array([0, np.deg2rad(10.0), 0]))[0]
    lenses = [
        np.vstack([record.stored_from_original, [0, 0, 1]]) @ photo.intrinsics
        for record, photo in zip(views.records, photos, strict=True)
    ]
    found = SimpleNamespace(
        world_from_cam=torch.from_numpy(np.linalg.inv(poses[0]) @ poses),
        intrinsics_px=torch.from_numpy(np.stack(lenses)),
        posed=torch.ones(len(photos), dtype=torch.bool),
        report=SimpleNamespace(
            views=[SimpleNamespace(loose=False, reason="", warnings=())] * len(photos),
            notes=(note,) if note else (),
            focal_source="given",
        ),
    )
    return frontend_poses.compare("case", "place", views, photos, found, len(paths), (), 0.0)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "case",
    [
        "plain",
        "phone_two_turned",
        "crop_corner_one",
        "zoom_one_first",
        "mixed_sizes",
        "rotated_180_one",
        "rotation_only",
    ],
)
def test_true_cameras_have_no_error(case: str, place: Place, tmp_path: Path) -> None:
    found = judged(CASES[case](place), tmp_path)
    assert max(view.focal_error for view in found.views if view.focal_error is not None) < 1e-4
    assert max(view.centre_error for view in found.views if view.centre_error is not None) < 1e-4
    assert max([*found.rotation_deg, *found.direction_deg]) < 0.01
    assert found.wrong == []
    assert len(found.rotation_deg) == 10
    assert (not found.direction_deg) == (case == "rotation_only")


@pytest.mark.parametrize("spoiled", [0, 3])
def test_only_the_wrong_view_is_called_wrong(spoiled: int, place: Place, tmp_path: Path) -> None:
    found = judged(CASES["plain"](place), tmp_path, spoiled=spoiled)
    assert found.wrong == found.silent_wrong == [f"photo_{spoiled}.jpg"]


def test_a_pose_for_a_photo_without_camera_is_wrong_and_a_note_breaks_the_silence(place: Place, tmp_path: Path) -> None:
    photos = CASES["mirrored_one"](place)
    assert judged(photos, tmp_path).silent_wrong == ["photo_4.jpg"]
    told = judged(photos, tmp_path, note="one photo is mirrored")
    assert told.wrong == ["photo_4.jpg"]
    assert told.silent_wrong == []
