"""The benchmark's scenes: same name, same bits; the inserted view is new in part; its truth is the intended view's."""

from __future__ import annotations

import pytest
import torch

from sceneexpander.errors import UserError
from sceneexpander.evaluation.image import psnr
from sceneexpander.expandbench.grades import GRADES, grade_named
from sceneexpander.expandbench.scenes import CAPTURED, HEIGHT, UNSEEN_LIMITS, WIDTH, BenchScene, build_scene
from sceneexpander.geometry.camera import unproject_to_world
from sceneexpander.geometry.rigid import rigid_inverse, rotation_angle_deg
from sceneexpander.synthetic.misalign import Misalignment


@pytest.fixture(scope="module")
def scene() -> BenchScene:
    return build_scene("room_1")


def test_a_scene_is_what_it_says(scene: BenchScene) -> None:
    assert scene.captured.images.shape == (CAPTURED, 3, HEIGHT, WIDTH)
    assert not bool(scene.captured.generated.any())
    share = float(scene.intended.new_region.float().mean())
    assert UNSEEN_LIMITS[0] - 0.05 < share < UNSEEN_LIMITS[1] + 0.05
    again = build_scene("room_1")
    assert torch.equal(again.captured.images, scene.captured.images)
    assert torch.equal(again.intended.depth, scene.intended.depth)


def test_the_truth_fits_the_pictures(scene: BenchScene) -> None:
    """What the first captured view sees lands on the same colours in the view half-way, where both see it."""
    truth = scene.captured_truth[scene.captured.records[0].sha256]
    assert truth.depth is not None
    depth = truth.depth[1::2, 1::2]
    points = unproject_to_world(depth[None], scene.between.intrinsics_px[None], truth.world_from_cam[None].float())[0]
    local = (points - scene.between.world_from_cam[:3, 3]) @ scene.between.world_from_cam[:3, :3]
    pixel = (local @ scene.between.intrinsics_px.T)[..., :2] / local[..., 2:].clamp(min=1e-3)
    column, row = pixel.floor().long().unbind(-1)
    inside = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT) & (local[..., 2] > 0)
    column, row = column.clamp(0, WIDTH - 1), row.clamp(0, HEIGHT - 1)
    same = inside & ((local[..., 2] / scene.between.depth[row, column] - 1).abs() < 0.02)
    assert int(same.sum()) > 1000
    found = scene.between.image[:, row, column]
    assert psnr(found, scene.captured.images[0], same) > 22
    wrong = scene.between.image[:, row, (column + 12).clamp(max=WIDTH - 1)]
    assert psnr(wrong, scene.captured.images[0], same) < psnr(found, scene.captured.images[0], same) - 2


def test_new_is_what_no_captured_view_has_in_frame(scene: BenchScene) -> None:
    """Points outside every captured frame are new."""
    view = scene.intended
    points = unproject_to_world(view.depth[None], view.intrinsics_px[None], view.world_from_cam[None])[0]
    seen = torch.zeros_like(view.new_region)
    for record in scene.captured.records:
        pose = rigid_inverse(scene.captured_truth[record.sha256].world_from_cam.float())
        local = points @ pose[:3, :3].T + pose[:3, 3]
        pixel = (local @ view.intrinsics_px.T)[..., :2] / local[..., 2:].clamp(min=1e-3)
        bounds = pixel.new_tensor([WIDTH, HEIGHT])
        seen |= ((pixel >= 0) & (pixel < bounds)).all(-1) & (local[..., 2] > 0)
    solid = view.depth > 0
    outside = solid & ~seen
    assert int(outside.sum()) > 1000
    # The border between in and out of frame falls within a pixel.
    assert float(view.new_region[outside].float().mean()) > 0.98


def test_a_perfect_insertion_is_the_intended_view(scene: BenchScene) -> None:
    view, truth = scene.insert(Misalignment())
    assert view.records[0].generated
    assert psnr(view.images[0], scene.intended.image) > 35  # another seed of the renderer's samples
    known = truth.of(view.records[0])
    assert known is not None
    assert torch.allclose(known.world_from_cam.float(), scene.intended.world_from_cam)
    worse, _ = scene.insert(GRADES["mixed_2"].misalignment)
    assert psnr(worse.images[0], scene.intended.image) < 25


def test_cameras_look_beyond_the_captured_boundary(scene: BenchScene) -> None:
    poses = scene.cameras.world_from_cam
    turned = [float(rotation_angle_deg(pose[:3, :3], poses[-1, :3, :3])) for pose in poses[:-1]]
    assert min(turned) > 10


def test_an_unknown_grade_is_one_line() -> None:
    with pytest.raises(UserError, match="mixed_1"):
        grade_named("mixd_1")


def test_every_grade_is_named_after_what_it_does() -> None:
    assert GRADES["told_rotation_5"].told
    assert GRADES["told_rotation_5"].misalignment == GRADES["rotation_5"].misalignment
    assert not GRADES["rotation_5"].told
    assert GRADES["translation_10"].misalignment.translation_fraction == pytest.approx(0.1)
    amounts = {grade.axis: set() for grade in GRADES.values()}
    for grade in GRADES.values():
        assert grade.amount not in amounts[grade.axis], grade.name
        amounts[grade.axis].add(grade.amount)
    assert amounts["told_rotation"] == amounts["rotation"] == {2, 5, 10}
