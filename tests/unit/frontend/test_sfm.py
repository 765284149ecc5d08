"""Mapping on exact tracks, and the whole sparse front-end on rendered and degenerate input."""

from __future__ import annotations

from dataclasses import replace

import dense_scenes as scenes
import numpy as np
import pytest
import sfm_worlds as worlds
import torch

from sceneexpander.errors import UserError
from sceneexpander.frontend.bundle import LOG_FOCAL, Lenses
from sceneexpander.frontend.lenses import ViewOptics
from sceneexpander.frontend.mapping import Mapping
from sceneexpander.frontend.resection import solve_pose
from sceneexpander.frontend.sfm import SfmConfig, estimate_cameras
from sceneexpander.frontend.sfm_types import FocalSource, LearnedUse, PairKind, SparseReconstruction
from sceneexpander.frontend.tracks import Tracks
from sceneexpander.frontend.twoview import relative_pose
from sceneexpander.geometry.camera import project_points
from sceneexpander.geometry.rigid import rigid_inverse, rotation_angle_deg

HEIGHT, WIDTH, FOCAL = 240, 320, 290.0
FAST = SfmConfig(max_features=1000, learned_features=512, learned_long_side_px=640)
ONE_START = replace(FAST, focal_starts=(0.8,))  # where the search for the focal is not what is asked
FASTEST = replace(ONE_START, learned=LearnedUse.NEVER)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def room(views: int = 4, seed: int = 1) -> scenes.Scene:
    return scenes.render(scenes.room(seed), scenes.arc(views, 1.4), FOCAL, HEIGHT, WIDTH)


@pytest.fixture(scope="module")
def scene() -> scenes.Scene:
    return room()


@pytest.fixture(scope="module")
def reconstruction(scene: scenes.Scene) -> SparseReconstruction:
    return estimate_cameras(scene.images, FAST, generator=generator())


def pose_errors_deg(found: SparseReconstruction, truth: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rotation and translation-direction errors of every view relative to view 0."""
    relative = rigid_inverse(truth[:1]) @ truth
    turn = rotation_angle_deg(found.world_from_cam[1:, :3, :3], relative[1:, :3, :3])
    a, b = found.world_from_cam[1:, :3, 3], relative[1:, :3, 3]
    direction = torch.rad2deg(torch.atan2(torch.linalg.cross(a, b).norm(dim=1), (a * b).sum(1)))
    return turn, direction


# --- mapping on exact tracks -----------------------------------------------------------------------------------------


def grown(world: worlds.PointWorld, tracks: Tracks, *, focal_factor: float, refine: bool) -> Mapping:
    intrinsics = world.intrinsics.copy()
    intrinsics[:, [0, 1], [0, 1]] *= focal_factor
    lenses = Lenses.nominal(len(intrinsics))
    lenses.free[:, LOG_FOCAL] = True
    mapping = Mapping(tracks, intrinsics, SfmConfig(), unit_px=1.0, seed=1, lenses=lenses)
    both = np.flatnonzero(tracks.seen[:, 0] & tracks.seen[:, 3])
    pose = relative_pose(
        tracks.pixel_xy[both, 0], tracks.pixel_xy[both, 3], intrinsics[0], intrinsics[3], threshold_px=1.5, seed=1
    )
    assert pose is not None
    mapping.start(0, 3, pose)
    mapping.grow(refine_focal=refine)
    mapping.finish(refine_focal=refine)
    return mapping


@pytest.mark.parametrize("focal_factor", [0.85, 1.2])
def test_mapping_recovers_cameras_and_a_wrong_focal(focal_factor: float) -> None:
    world = worlds.point_world(20, views=5)
    mapping = grown(world, world.tracks, focal_factor=focal_factor, refine=True)
    assert mapping.registered.all()
    # Exact pixels, no prior: only the stopping of the iteration is left.
    assert np.exp(mapping.log_focal[0]) * focal_factor == pytest.approx(1.0, abs=5e-3)
    turn, direction = worlds.pose_errors_deg(mapping.rotations, mapping.translations, world)
    assert turn.max() < 0.05
    assert direction.max() < 0.2
    assert mapping.valid.mean() > 0.98


def test_mapping_survives_noise_outliers_and_gaps() -> None:
    world = worlds.point_world(21, views=5, points=300)
    rng = np.random.default_rng(0)
    pixel_xy = world.pixel_xy + rng.normal(0, 0.5, world.pixel_xy.shape)
    wrong = rng.random(pixel_xy.shape[:2]) < 0.1
    pixel_xy[wrong] += rng.uniform(-80, 80, (int(wrong.sum()), 2))
    seen = rng.random(pixel_xy.shape[:2]) < 0.7
    tracks = Tracks(pixel_xy=pixel_xy, seen=seen)
    mapping = grown(world, tracks, focal_factor=1.0, refine=False)
    assert mapping.registered.all()
    turn, direction = worlds.pose_errors_deg(mapping.rotations, mapping.translations, world)
    # 0.5 px is 0.04 deg; a few hundred observations per view leave about that after the weakest directions.
    assert turn.max() < 0.2
    assert direction.max() < 1.0
    # Moved by up to 80 px, all but those that landed within 3 px of the truth must have been dropped.
    assert mapping.active[wrong].mean() < 0.02
    assert mapping.active[seen & ~wrong].mean() > 0.85


def test_pose_from_points_ignores_half_of_them_wrong() -> None:
    world = worlds.point_world(22, views=2, points=100)
    rng = np.random.default_rng(1)
    pixel_xy = world.pixel_xy[:, 1].copy()
    wrong = rng.random(100) < 0.5
    pixel_xy[wrong] = rng.uniform(0, 500, (int(wrong.sum()), 2))
    found = solve_pose(world.points, pixel_xy, world.intrinsics[1], threshold_px=3.0, robust_px=1.0, seed=0)
    assert found is not None
    np.testing.assert_allclose(found[0], world.rotations[1], atol=2e-3)
    np.testing.assert_allclose(found[1], world.translations[1], atol=2e-2)
    assert solve_pose(world.points[:4], pixel_xy[:4], world.intrinsics[1], threshold_px=3, robust_px=1, seed=0) is None


# --- the whole thing on rendered pictures ----------------------------------------------------------------------------


def test_rendered_room_with_unknown_focal(scene: scenes.Scene, reconstruction: SparseReconstruction) -> None:
    assert reconstruction.posed.all()
    turn, direction = pose_errors_deg(reconstruction, scene.world_from_cam)
    # Nearest-texel rendering at 320 px: features are good to about 0.3 px, 0.06 deg; the focal adds to that.
    assert turn.max() < 1.0
    assert direction.max() < 5.0
    assert reconstruction.report.focal_px == pytest.approx(FOCAL, rel=0.12)
    assert reconstruction.report.mean_error_px < 0.6


def test_frame_scale_and_observations_agree(scene: scenes.Scene, reconstruction: SparseReconstruction) -> None:
    torch.testing.assert_close(reconstruction.world_from_cam[0], torch.eye(4))
    sparse = reconstruction.sparse
    assert len(sparse.points_world) > 100
    errors = []
    for view in range(4):
        mine = sparse.view_index == view
        xy, depth = project_points(
            sparse.points_world[sparse.point_index[mine]],
            reconstruction.intrinsics_px[view],
            reconstruction.world_from_cam[view],
        )
        assert (depth > 0).all()
        errors.append((xy - sparse.pixel_xy[mine]).norm(dim=1))
        if view == 0:
            assert depth.median() == pytest.approx(1.0, abs=0.02)  # even counts: two definitions of the median
    # 3 px at a long side of 768 is what the configuration keeps: 1.25 px here.
    assert torch.cat(errors).max() <= 3.0 * WIDTH / 768 + 1e-2
    assert torch.cat(errors).mean() == pytest.approx(reconstruction.report.mean_error_px, rel=0.05)


def test_depth_of_points_matches_the_truth(scene: scenes.Scene, reconstruction: SparseReconstruction) -> None:
    sparse = reconstruction.sparse
    mine = sparse.view_index == 0
    column, row = sparse.pixel_xy[mine].long().unbind(1)
    ratio = sparse.points_world[sparse.point_index[mine], 2] / scene.depth[0, row, column]
    spread = (ratio / ratio.median()).log().abs()
    # Points on depth edges may fall on the other side of the edge, so a share, not all.
    assert (spread < 0.05).float().mean() > 0.8


def test_equal_inputs_give_equal_results(scene: scenes.Scene, reconstruction: SparseReconstruction) -> None:
    again = estimate_cameras(scene.images, FAST, generator=generator())
    torch.testing.assert_close(again.world_from_cam, reconstruction.world_from_cam, rtol=0, atol=0)
    torch.testing.assert_close(again.sparse.points_world, reconstruction.sparse.points_world, rtol=0, atol=0)
    assert again.report == reconstruction.report or str(again.report) == str(reconstruction.report)  # NaN != NaN


def test_higher_resolution_features_give_the_same_cameras(scene: scenes.Scene) -> None:
    small = torch.nn.functional.interpolate(scene.images, size=(HEIGHT // 2, WIDTH // 2), mode="area")
    found = estimate_cameras(small, ONE_START, generator=generator(), feature_images=scene.images)
    turn, direction = pose_errors_deg(found, scene.world_from_cam)
    assert turn.max() < 1.0
    assert direction.max() < 5.0
    assert found.report.focal_px == pytest.approx(FOCAL / 2, rel=0.12)
    assert found.intrinsics_px[0, 0, 2] == pytest.approx(WIDTH / 4)
    assert float(found.sparse.pixel_xy[:, 0].max()) <= WIDTH / 2


def test_known_intrinsics_are_kept(scene: scenes.Scene) -> None:
    found = estimate_cameras(scene.images, FAST, generator=generator(), known_intrinsics_px=scene.intrinsics_px)
    torch.testing.assert_close(found.intrinsics_px, scene.intrinsics_px)
    assert found.report.focal_source is FocalSource.KNOWN
    turn, direction = pose_errors_deg(found, scene.world_from_cam)
    assert turn.max() < 0.3
    assert direction.max() < 2.0


def test_known_poses_are_kept_and_an_unknown_one_is_found(scene: scenes.Scene) -> None:
    shift = torch.eye(4)
    shift[:3, 3] = torch.tensor([5.0, -2.0, 1.0])
    given = shift @ scene.world_from_cam
    given[2] = float("nan")
    found = estimate_cameras(
        scene.images,
        FAST,
        generator=generator(),
        known_intrinsics_px=scene.intrinsics_px,
        known_world_from_cam=given,
    )
    assert found.posed.all()
    expected = rigid_inverse(scene.world_from_cam[:1]) @ scene.world_from_cam
    expected[:, :3, 3] *= found.report.scale
    kept = torch.tensor([0, 1, 3])
    torch.testing.assert_close(found.world_from_cam[kept], expected[kept], atol=1e-4, rtol=1e-4)
    # The unknown one in the given scale, too: 2 % of the arc's length.
    torch.testing.assert_close(found.world_from_cam[2], expected[2], atol=0.02, rtol=0)


def test_two_views_are_posed_with_a_fixed_focal() -> None:
    pair = room(views=2)
    found = estimate_cameras(pair.images, FAST, generator=generator())
    assert found.posed.all()
    assert found.report.focal_source is FocalSource.SWEPT
    turn, direction = pose_errors_deg(found, pair.world_from_cam)
    # The focal is only one of a few plausible ones here; the motion must still be the right one.
    assert turn.max() < 6.0
    assert direction.max() < 20.0


def test_stranger_is_reported_and_borrows_a_pose(scene: scenes.Scene, reconstruction: SparseReconstruction) -> None:
    stranger = room(views=1, seed=7).images
    found = estimate_cameras(
        torch.cat([scene.images, stranger]), ONE_START, generator=generator(), names=["a", "b", "c", "d", "e"]
    )
    assert found.posed.tolist() == [True, True, True, True, False]
    entry = found.report.views[4]
    assert not entry.registered
    assert entry.name == "e"
    assert entry.reason
    assert entry.placed_like is not None
    torch.testing.assert_close(found.world_from_cam[4], found.world_from_cam[entry.placed_like])


def test_first_view_without_overlap_keeps_the_identity(scene: scenes.Scene) -> None:
    stranger = room(views=1, seed=7).images
    found = estimate_cameras(torch.cat([stranger, scene.images[:3]]), ONE_START, generator=generator())
    assert found.posed.tolist() == [False, True, True, True]
    torch.testing.assert_close(found.world_from_cam[0], torch.eye(4))
    like = found.report.views[0].placed_like
    torch.testing.assert_close(found.world_from_cam[like], torch.eye(4), atol=1e-5, rtol=0)


# --- degenerate input ------------------------------------------------------------------------------------------------


def test_pure_rotation_is_flagged_and_its_rotation_found() -> None:
    poses = torch.eye(4).repeat(3, 1, 1)
    for k in range(3):
        angle = torch.tensor(0.15 * k)
        poses[k, 0, 0], poses[k, 0, 2], poses[k, 2, 0], poses[k, 2, 2] = (
            angle.cos(),
            angle.sin(),
            -angle.sin(),
            angle.cos(),
        )
    # One wall and a board, both without repeats: shifted copies of a texture would look like parallax.
    board = scenes.Rectangle(corner=(-0.3, -0.2, 1.5), edge_u=(0.5, 0, 0), edge_v=(0, 0.6, 0), seed=5)
    turning = scenes.render([scenes.wall(2.4, 3), board], poses, FOCAL, HEIGHT, WIDTH)
    found = estimate_cameras(turning.images, FAST, generator=generator(), known_intrinsics_px=turning.intrinsics_px)
    assert found.report.points == 0
    assert {pair.kind for pair in found.report.pairs if pair.inliers} == {PairKind.ROTATION}
    assert all("rotation" in view.reason for view in found.report.views[1:])
    turn = rotation_angle_deg(found.world_from_cam[:, :3, :3], poses[:, :3, :3])
    assert turn.max() < 0.5
    assert found.world_from_cam[:, :3, 3].abs().max() < 1e-6


def test_a_turning_camera_of_unknown_focal_is_known_by_its_turn() -> None:
    """At the assumed focal of 0.85 these turns look like parallax, and would get depth from nothing."""
    focal = 1.1 * WIDTH
    angles = torch.tensor([0.0, 0.13, 0.26])
    poses = torch.eye(4).repeat(3, 1, 1)
    poses[:, 0, 0], poses[:, 2, 2] = angles.cos(), angles.cos()
    poses[:, 0, 2], poses[:, 2, 0] = angles.sin(), -angles.sin()
    board = scenes.Rectangle(corner=(-0.3, -0.2, 1.5), edge_u=(0.5, 0, 0), edge_v=(0, 0.6, 0), seed=5)
    turning = scenes.render([scenes.wall(2.4, 3), board], poses, focal, HEIGHT, WIDTH)
    found = estimate_cameras(turning.images, FAST, generator=generator())
    assert found.report.points == 0
    assert all("rotation" in view.reason for view in found.report.views[1:])
    assert found.report.focal_source is FocalSource.TURNED
    assert any("no depth" in note for note in found.report.notes)
    assert found.report.focal_ratio == pytest.approx(1.1, rel=0.05)
    assert rotation_angle_deg(found.world_from_cam[:, :3, :3], poses[:, :3, :3]).max() < 1.0


@pytest.mark.parametrize("views", [1, 2, 3])
def test_plain_images_give_a_flagged_identity(views: int) -> None:
    found = estimate_cameras(torch.full((views, 3, 60, 80), 0.5), FAST, generator=generator())
    assert found.posed.tolist() == [True] + [False] * (views - 1)
    torch.testing.assert_close(found.world_from_cam, torch.eye(4).repeat(views, 1, 1))
    assert found.report.focal_source is FocalSource.ASSUMED
    assert found.report.focal_ratio == pytest.approx(FAST.focal_prior)
    assert torch.isfinite(found.intrinsics_px).all()
    assert found.report.points == 0


def test_the_same_picture_twice_does_not_crash(scene: scenes.Scene) -> None:
    twice = scene.images[[0, 0]]
    found = estimate_cameras(twice, FAST, generator=generator())
    assert torch.isfinite(found.world_from_cam).all()
    torch.testing.assert_close(found.world_from_cam[1], torch.eye(4), atol=1e-3, rtol=0)


@pytest.mark.parametrize(("across", "down", "corner"), [(0.05, 0.05, False), (0.12, 0.12, True), (0.08, 0.0, False)])
def test_parts_of_one_picture_give_no_sure_camera(
    scene: scenes.Scene, across: float, down: float, corner: bool
) -> None:
    """Zoomed, cropped at a corner, stretched: matches agree as well as they can, and there is no depth in them."""
    parts = []
    for k in range(3):
        cut = round(WIDTH * k * across), round(HEIGHT * k * down)
        left, top = (0, 0) if corner else (cut[0] // 2, cut[1] // 2)
        part = scene.images[:1, :, top : top + HEIGHT - cut[1], left : left + WIDTH - cut[0]]
        parts.append(torch.nn.functional.interpolate(part, (HEIGHT, WIDTH), mode="bicubic", antialias=True).clamp(0, 1))
    found = estimate_cameras(torch.cat(parts), FASTEST, generator=generator())
    assert not any(view.registered and not view.loose for view in found.report.views)
    assert any("no depth" in view.reason for view in found.report.views)


def test_photos_of_a_room_are_sure(reconstruction: SparseReconstruction) -> None:
    assert all(view.registered and not view.loose for view in reconstruction.report.views)
    assert PairKind.FLAT not in {pair.kind for pair in reconstruction.report.pairs}


def test_a_shape_that_panoramas_have_keeps_a_camera_from_being_sure(scene: scenes.Scene) -> None:
    optics = [
        replace(ViewOptics.of_whole_image(HEIGHT, WIDTH), doubt="it may be a panorama" if k == 2 else "")
        for k in range(4)
    ]
    found = estimate_cameras(scene.images, FASTEST, generator=generator(), optics=optics)
    assert [view.loose for view in found.report.views] == [False, False, True, False]
    assert found.report.views[2].reason == "it may be a panorama"


def test_noise_images_are_unrelated() -> None:
    noise = torch.rand(3, 3, 120, 160, generator=generator(5))
    found = estimate_cameras(noise, FAST, generator=generator())
    assert found.posed.tolist() == [True, False, False]


@pytest.mark.wrong_shapes
def test_bad_arguments_are_refused(scene: scenes.Scene) -> None:
    with pytest.raises(ValueError, match="at least one view"):
        estimate_cameras(torch.zeros(0, 3, 8, 8), FAST, generator=generator())
    with pytest.raises(ValueError, match="names"):
        estimate_cameras(scene.images, FAST, generator=generator(), names=["one"])
    with pytest.raises(ValueError, match="feature_images"):
        estimate_cameras(scene.images, FAST, generator=generator(), feature_images=scene.images[:2])
    mirrored = torch.eye(4).repeat(4, 1, 1)
    mirrored[1, 0, 0] = -1
    with pytest.raises(UserError, match=r"view 1.*not a rigid pose"):
        estimate_cameras(scene.images, FAST, generator=generator(), known_world_from_cam=mirrored)
    with pytest.raises(UserError, match="focal hint"):
        estimate_cameras(scene.images, FAST, generator=generator(), focal_hint_px=-3.0)
    with pytest.raises(UserError, match="not positive"):
        estimate_cameras(scene.images, FAST, generator=generator(), known_intrinsics_px=torch.zeros(4, 3, 3))
    with pytest.raises(ValueError, match="focal_bounds"):
        SfmConfig(focal_bounds=(1.0, 0.5))
    with pytest.raises(ValueError, match="focal_starts"):
        SfmConfig(focal_starts=(0.9, 5.0))


def test_a_wrong_match_that_only_two_views_see_is_dropped_before_export() -> None:
    world = worlds.point_world(30, views=2, points=300)
    rng = np.random.default_rng(2)
    # A slanted plane, so that neighbours in the image agree; some points slid far along their viewing ray.
    points = world.points.copy()
    points[:, 2] = 5 + 0.3 * points[:, 0]
    strays = rng.choice(300, 12, replace=False)
    points[strays] *= rng.choice([0.5, 2.0], 12)[:, None]
    mapping = Mapping(world.tracks, world.intrinsics, SfmConfig(), unit_px=1.0, seed=1)
    mapping.rotations, mapping.translations = world.rotations, world.translations
    mapping.registered[:] = True
    mapping.points = points
    seen = np.einsum("vij,pj->pvi", world.rotations, points) + world.translations
    pixels = np.einsum("vij,pvj->pvi", world.intrinsics, seen)
    mapping.tracks = Tracks(pixel_xy=pixels[..., :2] / pixels[..., 2:], seen=np.ones((300, 2), bool))
    mapping.valid[:] = True
    mapping.active[:] = True
    mapping.drop_strays()
    assert not mapping.valid[strays].any()
    assert mapping.valid.sum() > 280
