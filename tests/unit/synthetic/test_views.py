"""Samples are exact, deterministic and obey the overlap and clearance rules."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from sceneexpander.geometry.camera import project_points, unproject_depth, unproject_to_world
from sceneexpander.synthetic import KINDS, SyntheticViews, build_world, make_views
from sceneexpander.synthetic.bundled import unseen_by
from sceneexpander.synthetic.render import trace_camera
from sceneexpander.synthetic.trajectories import MIN_CLEARANCE_M, pairwise_overlap, pose_from_angles, same_lens
from sceneexpander.synthetic.views import make_scene

HEIGHT, WIDTH = 64, 80


@pytest.fixture(scope="module", params=KINDS)
def sample(request: pytest.FixtureRequest) -> SyntheticViews:
    return make_views(11, views=3, height=HEIGHT, width=WIDTH, kind=request.param, degrade=False)


def test_shapes_ranges_and_first_frame(sample: SyntheticViews) -> None:
    assert sample.images.shape == (3, 3, HEIGHT, WIDTH)
    assert sample.images.dtype == torch.float32
    assert 0 <= float(sample.images.min()) < float(sample.images.max()) <= 1
    assert torch.equal(sample.world_from_cam[0], torch.eye(4))
    assert torch.equal(sample.valid, torch.isfinite(sample.depth))
    assert (sample.depth[sample.valid] > 0).all()
    for tensor in (sample.images, sample.normals, sample.world_from_cam, sample.intrinsics_px):
        assert torch.isfinite(tensor).all()


def test_normals_are_unit_and_face_the_camera(sample: SyntheticViews) -> None:
    length = sample.normals.norm(dim=-1)
    torch.testing.assert_close(length[sample.valid], torch.ones_like(length[sample.valid]), atol=1e-4, rtol=0)
    rays = unproject_depth(torch.ones_like(sample.depth), sample.intrinsics_px)
    cosine = (rays * sample.normals).sum(-1)[sample.valid]
    # Round surfaces are grazed at their outline, where single precision decides the sign.
    assert (cosine < 1e-3).all()


def test_normals_agree_with_the_gradient_of_depth(sample: SyntheticViews) -> None:
    depth = torch.where(sample.valid, sample.depth, torch.tensor(1.0))
    points = unproject_depth(depth, sample.intrinsics_px)
    across = points[:, 1:-1, 2:] - points[:, 1:-1, :-2]
    down = points[:, 2:, 1:-1] - points[:, :-2, 1:-1]
    measured = torch.nn.functional.normalize(torch.linalg.cross(down, across), dim=-1)
    inner = sample.normals[:, 1:-1, 1:-1]
    same = torch.ones_like(sample.valid[:, 1:-1, 1:-1])
    for dy, dx in ((0, 1), (2, 1), (1, 0), (1, 2), (1, 1)):
        part = (slice(None), slice(dy, dy + HEIGHT - 2), slice(dx, dx + WIDTH - 2))
        same &= sample.valid[part] & ((sample.normals[part] - inner).norm(dim=-1) < 1e-3)
        same &= sample.object_id[part] == sample.object_id[:, 1:-1, 1:-1]
    cosine = (measured * inner).sum(-1)[same]
    assert same.float().mean() > 0.3
    # Equal normals on both sides of a step (two parallel faces) are the only exceptions.
    assert (cosine > 0.999).float().mean() > 0.97


def test_depth_and_colour_agree_between_views(sample: SyntheticViews) -> None:
    agreeing, seen = 0, 0
    errors = []
    for i in range(3):
        depth = torch.where(sample.valid[i], sample.depth[i], torch.tensor(1.0))
        points = unproject_to_world(depth, sample.intrinsics_px[i], sample.world_from_cam[i]).reshape(-1, 3)
        for j in range(3):
            if i == j or sample.disconnected in (i, j):
                continue
            pixels, z = project_points(points, sample.intrinsics_px[j], sample.world_from_cam[j])
            inside = (z > 0.05) & (pixels > 1).all(-1) & (pixels[:, 0] < WIDTH - 1) & (pixels[:, 1] < HEIGHT - 1)
            inside &= sample.valid[i].reshape(-1)
            column, row = pixels[inside].long().unbind(-1)
            there, here = sample.depth[j][row, column], z[inside]
            same_object = sample.object_id[j][row, column] == sample.object_id[i].reshape(-1)[inside]
            # A pixel's depth is that of its centre: slanted surfaces differ by the footprint, hence 5 %.
            same = ((there - here).abs() < 0.05 * here) & same_object
            # Nothing may lie in front of where view j sees a surface, edges of the nearest pixel aside.
            assert (here < there * 0.95).float().mean() < 0.12
            agreeing, seen = agreeing + int(same.sum()), seen + int((here <= there * 1.05).sum())
            colour_here = sample.images[i].flatten(1)[:, inside][:, same]
            colour_there = sample.images[j][:, row[same], column[same]]
            errors.append((colour_here - colour_there).abs().mean(0))
    assert seen > 200
    assert agreeing / seen > 0.85
    # Fine textures differ by resampling; a wrong pose or depth would give errors like those of unrelated pixels.
    assert float(torch.cat(errors).median()) < 0.06


@pytest.mark.parametrize("degrade", [False, True])
def test_same_seed_same_bits_other_seed_other_picture(degrade: bool) -> None:
    first, again, other = (
        make_views(seed, views=2, height=32, width=40, supersample=1.0, degrade=degrade) for seed in (5, 5, 6)
    )
    for name in ("images", "depth", "normals", "world_from_cam", "intrinsics_px", "object_id"):
        assert torch.equal(getattr(first, name), getattr(again, name))
    assert not torch.equal(first.images, other.images)


@pytest.mark.parametrize("seed", range(4))
def test_cameras_overlap_and_stay_out_of_objects(seed: int) -> None:
    world, chosen = make_scene(seed, views=4, height=HEIGHT, width=WIDTH)
    assert (world.clearance(chosen.cameras.centres.numpy()) > MIN_CLEARANCE_M).all()
    mutual = (chosen.overlap + chosen.overlap.T) / 2
    np.fill_diagonal(mutual, 0)
    for view in range(4):
        if view == chosen.disconnected:
            assert mutual[view].max() < 0.03
        else:
            # Measured on the same coarse grid as the rule.
            assert mutual[view].max() >= 0.19


def test_splits_share_no_texture() -> None:
    from sceneexpander.synthetic.textures import TEST_FAMILIES, VARIANTS, draw_texture

    assert not set(VARIANTS["train"]) & set(VARIANTS["test"])
    rng = np.random.default_rng(0)
    drawn = {split: {draw_texture(rng, "brick", split) for _ in range(200)} for split in ("train", "test")}
    assert not drawn["train"] & drawn["test"]
    from sceneexpander.synthetic.furniture import Palette

    palette = Palette(rng, "train", 0.0)
    families = {palette.surface(use).texture.family for use in ("wall", "floor", "object") for _ in range(100)}
    assert not families & TEST_FAMILIES


def test_unknown_kind_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown scene kind 'beach'"):
        make_views(0, views=2, height=16, width=16, kind="beach")


def test_a_longer_lens_sees_the_middle_of_what_the_wide_one_sees() -> None:
    world = build_world(np.random.default_rng(4), "room")
    pose = pose_from_angles(world.bounds.mean(0).astype(np.float64), 0.4, 0.0, 0.0)
    cameras = same_lens(pose, 40.0, 48, 64).followed_by(same_lens(pose, 80.0, 48, 64))
    depth = np.stack([trace_camera(world, cameras[index])[0] for index in range(2)])
    overlap = pairwise_overlap(cameras, depth.astype(np.float64))
    assert overlap[1, 0] > 0.98
    assert overlap[0, 1] == pytest.approx(0.25, abs=0.02)
    assert unseen_by(depth[1], cameras[1], depth[:1], cameras[:1]).mean() < 0.02
    assert unseen_by(depth[0], cameras[0], depth[1:], cameras[1:]).mean() == pytest.approx(0.75, abs=0.02)
