"""Errors against known truth, with errors of known size put in."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.store import ArtifactError, sha256_of_file
from sceneexpander.artifacts.truth import SceneTruth, ViewTruth
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.evaluation.truth import TruthMetrics, against_truth
from sceneexpander.geometry.rigid import rotation_from_quat_wxyz
from sceneexpander.geometry.similarity import Similarity
from sceneexpander.ingest.truth import check_truth, load_truth
from tests.worlds.wall import DEPTH, HEIGHT, WIDTH, made_reconstruction, own_pictures

EYES = (0.0, 0.4, 0.9, 2.0)


def made(eyes: tuple[float, ...] = EYES) -> Reconstruction:
    scene = made_reconstruction(eyes_x=eyes)
    poses = scene.world_from_cam.clone()
    if len(eyes) > 3:
        poses[1, 1, 3] = 0.3  # off the line
    return dataclasses.replace(scene, world_from_cam=poses)


def errors(scene: Reconstruction, views: ViewSet, truth: SceneTruth) -> TruthMetrics:
    return against_truth(scene, views, truth, round_number=1)


def truth_of(scene: Reconstruction) -> SceneTruth:
    """The reconstruction's own values as truth; the right half of the last view is new."""
    new_region = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    new_region[:, WIDTH // 2 :] = True
    last = len(scene.view_ids) - 1
    return SceneTruth(
        views={
            f"hash{i}": ViewTruth(
                world_from_cam=scene.world_from_cam[i].double(),
                intrinsics_px=scene.intrinsics_px[i].double(),
                depth=scene.depth[i],
                new_region=new_region if i == last else None,
            )
            for i in range(last + 1)
        }
    )


def test_truth_itself_has_no_error() -> None:
    scene = made()
    found = errors(scene, own_pictures(scene), truth_of(scene))
    for name, value in dataclasses.asdict(found).items():
        expected = 1.0 if name.endswith("within_125") else 0.0
        assert value == pytest.approx(expected, abs=1e-5), name


def test_frame_and_scale_do_not_count() -> None:
    scene = made()
    rotation = rotation_from_quat_wxyz(torch.tensor([0.8, -0.2, 0.4, 0.1]))
    moved = Similarity(scale=3.0, rotation=rotation, translation=torch.tensor([1.0, 2.0, -1.0]))
    other = dataclasses.replace(scene, world_from_cam=moved.poses(scene.world_from_cam), depth=scene.depth * 3)
    found = errors(other, own_pictures(scene), truth_of(scene))
    assert found.camera_rotation_deg == pytest.approx(0, abs=1e-4)
    # float32 poses: an angle of 1e-7 rad between directions is what rounding alone gives.
    assert found.camera_direction_deg == pytest.approx(0, abs=1e-3)
    assert found.camera_ate == pytest.approx(0, abs=1e-5)
    assert found.depth_abs_rel == pytest.approx(0, abs=1e-5)
    assert found.new_region_abs_rel == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_the_unit_of_the_truth_does_not_count(unit: float) -> None:
    """Kilometres or millimetres: the share of an error is the same."""
    scene = made()
    truth = truth_of(scene)
    wrong = scene.depth.clone()
    wrong[0, :, : WIDTH // 4] *= 1.1
    estimated = dataclasses.replace(scene, depth=wrong)
    views = {}
    for key, own in truth.views.items():
        pose = own.world_from_cam.clone()
        pose[:3, 3] *= unit
        depth = None if own.depth is None else own.depth * unit
        views[key] = dataclasses.replace(own, world_from_cam=pose, depth=depth)
    found = errors(estimated, own_pictures(scene), SceneTruth(views=views))
    expected = errors(estimated, own_pictures(scene), truth)
    assert expected.depth_abs_rel is not None
    assert expected.depth_abs_rel > 0.001
    assert found.depth_abs_rel == pytest.approx(expected.depth_abs_rel, rel=1e-4)
    assert found.new_region_abs_rel == pytest.approx(expected.new_region_abs_rel, abs=1e-5)


@pytest.mark.parametrize("border", [(slice(None), 0), (slice(None), -1), (0, slice(None)), (-1, slice(None))])
def test_every_border_pixel_is_compared_with_its_own_truth(border: tuple[Any, Any]) -> None:
    scene = made()
    depth = scene.depth.clone()
    depth[:, *border] *= 1.5
    other = dataclasses.replace(scene, depth=depth)
    assert errors(other, own_pictures(other), truth_of(other)).depth_abs_rel == pytest.approx(0, abs=1e-6)
    assert errors(scene, own_pictures(scene), truth_of(other)).depth_abs_rel != pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("shift", [(-3.0, 0.0), (3.0, 0.0), (0.0, -3.0), (0.0, 3.0)])
def test_stored_pixels_beyond_the_original_have_no_truth(shift: tuple[float, float]) -> None:
    """A letterboxed view: its bars are left out on whichever side they are, and the rest is where it was."""
    scene = made()
    pictures = own_pictures(scene)
    affine = ((1.0, 0.0, shift[0]), (0.0, 1.0, shift[1]))
    records = tuple(dataclasses.replace(record, stored_from_original=affine) for record in pictures.records)
    truth = truth_of(scene)
    ramp = DEPTH * (1 + torch.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) / (HEIGHT * WIDTH))
    views = {key: dataclasses.replace(own, depth=ramp) for key, own in truth.views.items()}
    x, y = int(shift[0]), int(shift[1])
    seen = torch.roll(ramp, (y, x), (0, 1)).expand_as(scene.depth)
    found = errors(
        dataclasses.replace(scene, depth=seen), dataclasses.replace(pictures, records=records), SceneTruth(views=views)
    )
    assert found.depth_abs_rel == pytest.approx(0, abs=1e-6)


def test_a_turned_inserted_camera() -> None:
    scene = made()
    angle = math.radians(5)
    turn = torch.eye(4)
    turn[:3, :3] = rotation_from_quat_wxyz(torch.tensor([math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0]))
    poses = scene.world_from_cam.clone()
    poses[-1] = poses[-1] @ turn
    found = errors(dataclasses.replace(scene, world_from_cam=poses), own_pictures(scene), truth_of(scene))
    assert found.inserted_rotation_deg == pytest.approx(5, abs=1e-3)
    assert found.inserted_direction_deg == pytest.approx(0, abs=1e-3)
    assert found.camera_rotation_deg == pytest.approx(0, abs=1e-4)


def test_a_moved_camera() -> None:
    scene = made(eyes=(0.0, 1.0))
    poses = scene.world_from_cam.clone()
    poses[1, :3, 3] = torch.tensor([1.0, 1.0, 0.0])
    scene = dataclasses.replace(scene, generated=torch.zeros(2, dtype=torch.bool))
    found = errors(dataclasses.replace(scene, world_from_cam=poses), own_pictures(scene), truth_of(scene))
    assert found.camera_direction_deg == pytest.approx(45, abs=1e-4)
    assert found.camera_ate is None  # two cameras always fit
    poses[1, :3, 3] = 0
    found = errors(dataclasses.replace(scene, world_from_cam=poses), own_pictures(scene), truth_of(scene))
    assert found.camera_direction_deg == 90


@pytest.mark.parametrize("lost", [0, 1, 2])
def test_a_captured_view_without_a_pose_is_in_no_error(lost: int) -> None:
    right = made()
    poses, depth = right.world_from_cam.clone(), right.depth.clone()
    poses[lost] = torch.eye(4)
    poses[lost, :3, 3] = torch.tensor([0.2, 2.0, -1.0])
    depth[lost] *= 1.5
    scene = dataclasses.replace(right, world_from_cam=poses, depth=depth)
    views, truth = own_pictures(right), truth_of(right)
    assert (errors(scene, views, truth).depth_abs_rel or 0) > 0.05
    posed = torch.arange(4) != lost
    found = errors(dataclasses.replace(scene, posed=posed), views, truth)
    assert found.camera_direction_deg == pytest.approx(0, abs=1e-3)
    assert found.depth_abs_rel == pytest.approx(0, abs=1e-5)


def test_only_the_view_of_this_round_counts_as_inserted() -> None:
    scene = made()
    found = against_truth(scene, own_pictures(scene), truth_of(scene), round_number=2)
    assert found.inserted_rotation_deg is None
    assert found.new_region_abs_rel is None
    assert found.depth_abs_rel is not None


def test_depth_errors_of_known_size() -> None:
    scene = made()
    depth = scene.depth.clone()
    depth[-1, :, WIDTH // 2 :] *= 1.5
    found = errors(dataclasses.replace(scene, depth=depth), own_pictures(scene), truth_of(scene))
    assert found.depth_abs_rel == pytest.approx(0, abs=1e-6)
    assert found.new_region_abs_rel == pytest.approx(0.5, abs=1e-5)
    assert found.new_region_within_125 == 0


def test_unknown_pixels_and_views_are_left_out() -> None:
    scene = made()
    truth = truth_of(scene)
    holes = scene.depth[0].clone()
    holes[:20] = 0
    views = {**truth.views, "hash0": dataclasses.replace(truth.views["hash0"], depth=holes)}
    del views["hash3"]
    wrong = scene.depth.clone()
    wrong[0, :20] = 50.0  # where nothing is known
    found = errors(dataclasses.replace(scene, depth=wrong), own_pictures(scene), SceneTruth(views=views))
    assert found.depth_abs_rel == pytest.approx(0, abs=1e-6)
    assert found.inserted_rotation_deg is None
    assert found.new_region_abs_rel is None
    nothing = errors(scene, own_pictures(scene), SceneTruth())
    assert set(dataclasses.asdict(nothing).values()) == {None}


def test_truth_is_brought_to_stored_pixels() -> None:
    scene = made(eyes=(0.0, 1.0))
    scene = dataclasses.replace(scene, generated=torch.zeros(2, dtype=torch.bool))
    views = own_pictures(scene)
    # The originals were twice as large, with a border of 4 that was cropped on the left.
    records = tuple(
        dataclasses.replace(
            record,
            original_height=2 * HEIGHT,
            original_width=2 * WIDTH + 4,
            stored_from_original=((0.5, 0.0, -2.0), (0.0, 0.5, 0.0)),
        )
        for record in views.records
    )
    original = torch.full((2 * HEIGHT, 2 * WIDTH + 4), DEPTH)
    original[:, :4] = 99.0
    truth = truth_of(scene)
    large = {key: dataclasses.replace(value, depth=original, new_region=None) for key, value in truth.views.items()}
    found = errors(scene, dataclasses.replace(views, records=records), SceneTruth(views=large))
    assert found.depth_abs_rel == pytest.approx(0, abs=1e-6)
    assert found.depth_within_125 == 1
    with pytest.raises(ArtifactError, match="truth of 56 x 88 pixels"):
        errors(scene, views, SceneTruth(views=large))


def test_truth_folder(tmp_path: Path) -> None:
    assert load_truth(tmp_path) is None
    for part in ("captured", "inserted", "truth/depth"):
        (tmp_path / part).mkdir(parents=True)
    files = ("captured/a.png", "inserted/round_1.png")
    for index, name in enumerate(files):
        Image.fromarray(np.full((4, 6, 3), index, np.uint8)).save(tmp_path / name)
    for name, depth in (("a", 1500), ("inserted", 2500)):
        Image.fromarray(np.full((4, 6), depth, np.uint16)).save(tmp_path / "truth" / "depth" / f"{name}.png")
    mask = np.zeros((4, 6), np.uint8)
    mask[:, 3:] = 255
    Image.fromarray(mask).save(tmp_path / "truth" / "new_region.png")
    cameras = [{"file": name, "world_from_cam": np.eye(4).tolist()} for name in files]
    content = {"intrinsics_px": np.eye(3).tolist(), "captured": cameras[:1], "inserted": cameras[1]}
    path = tmp_path / "truth" / "cameras.json"
    path.write_text(json.dumps(content))
    truth = load_truth(tmp_path)
    assert truth is not None
    captured, inserted = (truth.views[sha256_of_file(tmp_path / name)] for name in files)
    assert captured.depth is not None
    assert inserted.depth is not None
    assert inserted.new_region is not None
    assert captured.new_region is None
    assert (float(captured.depth[0, 0]), float(inserted.depth[0, 0])) == pytest.approx((1.5, 2.5))
    assert inserted.new_region[0].tolist() == [False] * 3 + [True] * 3
    damages = (
        {"intrinsics_px": [1, 2]},
        {"captured": [{**cameras[0], "file": "captured/none.png"}]},
        {"captured": [{**cameras[0], "world_from_cam": np.full((4, 4), 1e400).tolist()}]},
        {"captured": 3},
    )
    for damage in damages:
        path.write_text(json.dumps({**content, **damage}))
        with pytest.raises(ArtifactError, match=r"is invalid|is not valid|is not there"):
            load_truth(tmp_path)
    path.write_text(json.dumps(content))
    Image.fromarray(mask).save(tmp_path / "truth" / "depth" / "a.png")
    with pytest.raises(ArtifactError, match="not a 16-bit"):
        load_truth(tmp_path)


def truth_folder(root: Path) -> tuple[Path, dict[str, Any]]:
    """(cameras.json, its content) of a scene of one photo with a depth map."""
    for part in ("captured", "truth/depth"):
        (root / part).mkdir(parents=True)
    Image.fromarray(np.zeros((4, 6, 3), np.uint8)).save(root / "captured" / "a.png")
    Image.fromarray(np.full((4, 6), 1500, np.uint16)).save(root / "truth" / "depth" / "a.png")
    camera = {"file": "captured/a.png", "world_from_cam": np.eye(4).tolist()}
    content = {"note": "one's own", "intrinsics_px": np.eye(3).tolist(), "captured": [camera]}
    path = root / "truth" / "cameras.json"
    path.write_text(json.dumps(content))
    assert load_truth(root) is not None
    return path, content


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"[]",
        b"3",
        b"null",
        b"{",
        b"{}",
        b"\xff\xfe{\x00}\x00",
        b"[" * 100_000,
        b'{"a":' * 50_000,
        b'{"a": ' + b"9" * 5000 + b"}",
    ],
    ids=lambda text: repr(text[:12]),
)
def test_a_file_that_is_no_truth_is_one_line(tmp_path: Path, text: bytes) -> None:
    path, _ = truth_folder(tmp_path)
    path.write_bytes(text)
    with pytest.raises(ArtifactError, match=r"cameras\.json: "):
        load_truth(tmp_path)


NAN_POSE = [[math.nan, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("file", "../outside.png"), ("file", "captured/../../outside.png"), ("file", "/etc/hostname"), ("file", ""), ("file", "captured"),
        ("file", "captured/none.png"), ("file", "a\0b"), ("file", "x" * 5000), ("file", "\ud800.png"), ("file", 3), ("file", None),
        ("world_from_cam", NAN_POSE), ("world_from_cam", np.zeros((4, 4)).tolist()), ("world_from_cam", (2 * np.eye(4)).tolist()),
        ("world_from_cam", np.diag([1, 1, -1, 1]).tolist()), ("world_from_cam", np.eye(3).tolist()), ("world_from_cam", "x"),
        ("world_from_cam", [["1", 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
        ("world_from_cam", (1e99 * np.ones((4, 4))).tolist()),
    ],
    ids=lambda item: str(item)[:20].encode("unicode_escape").decode(),
)  # fmt: skip
def test_cameras_that_are_none_are_named(tmp_path: Path, key: str, value: object) -> None:
    (tmp_path / "outside.png").write_bytes(b"x")
    scene = tmp_path / "scene"
    path, content = truth_folder(scene)
    path.write_text(json.dumps({**content, "captured": [{**content["captured"][0], key: value}]}))
    with pytest.raises(ArtifactError, match=r"cameras\.json: ") as caught:
        load_truth(scene)
    assert len(caught.value.line()) < 500 + len(str(path))


@pytest.mark.parametrize(("shear", "fine"), [(0.004, True), (0.03, False)])
def test_a_rotation_may_be_rounded_but_not_sheared(tmp_path: Path, shear: float, fine: bool) -> None:
    scene = tmp_path / "scene"
    path, content = truth_folder(scene)
    pose = np.eye(4)
    pose[0, 1] = shear
    path.write_text(json.dumps({**content, "captured": [{**content["captured"][0], "world_from_cam": pose.tolist()}]}))
    if fine:
        load_truth(scene)
    else:
        with pytest.raises(ArtifactError, match=r"cameras\.json: "):
            load_truth(scene)


@pytest.mark.parametrize(
    "intrinsics", [np.zeros((3, 3)).tolist(), (-np.eye(3)).tolist(), [1, 2], None, [[math.inf] * 3] * 3]
)
def test_intrinsics_that_are_none_are_refused(tmp_path: Path, intrinsics: object) -> None:
    path, content = truth_folder(tmp_path)
    path.write_text(json.dumps({**content, "intrinsics_px": intrinsics}))
    with pytest.raises(ArtifactError, match=r"cameras\.json: "):
        load_truth(tmp_path)


def damaged_pngs() -> dict[str, bytes]:
    stream = io.BytesIO()
    Image.fromarray(np.arange(24, dtype=np.uint16).reshape(4, 6)).save(stream, format="PNG")
    good = stream.getvalue()
    chunks = {f"byte {at}": good[:at] + bytes([good[at] ^ 0xFF]) + good[at + 1 :] for at in range(8, len(good), 3)}
    return {"empty": b"", "cut": good[: len(good) // 2], "text": b"no picture", **chunks}


def test_damaged_maps_are_refused_or_read(tmp_path: Path) -> None:
    truth_folder(tmp_path)
    refused = 0
    for name, data in damaged_pngs().items():
        (tmp_path / "truth" / "depth" / "a.png").write_bytes(data)
        try:
            load_truth(tmp_path)
        except ArtifactError as error:
            refused += 1
            assert "a.png" in error.line(), name  # noqa: PT017
    assert refused > 10


def test_something_else_in_place_of_the_files_is_one_line(tmp_path: Path) -> None:
    for number, place in enumerate(("truth/cameras.json", "truth/depth/a.png", "captured/a.png")):
        for make in (Path.mkdir, os.mkfifo, lambda path: path.symlink_to(path)):
            scene = tmp_path / f"{number}{make}"[:12]
            truth_folder(scene)
            (scene / place).unlink()
            make(scene / place)
            with pytest.raises(ArtifactError):
                load_truth(scene)
            shutil.rmtree(scene)


def test_maps_of_another_size_are_found_before_anything_runs(tmp_path: Path) -> None:
    truth_folder(tmp_path)
    scene = made_reconstruction()
    record = dataclasses.replace(
        own_pictures(scene).records[0],
        sha256=sha256_of_file(tmp_path / "captured" / "a.png"),
        original_height=4,
        original_width=6,
    )
    check_truth(tmp_path, [record])
    with pytest.raises(ArtifactError, match="truth of 4 x 6 pixels for a picture of 4 x 7"):
        check_truth(tmp_path, [dataclasses.replace(record, original_width=7)])
