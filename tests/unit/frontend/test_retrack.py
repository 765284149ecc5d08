"""Tracks measured in the pictures: more exact than keypoints, and cameras with them."""

from __future__ import annotations

from dataclasses import replace

import dense_scenes as scenes
import numpy as np
import pytest
import torch

from sceneexpander.frontend.features import grey_u8
from sceneexpander.frontend.retrack import retrack
from sceneexpander.frontend.sfm import SfmConfig, estimate_cameras
from sceneexpander.frontend.sfm_types import LearnedUse, SparseReconstruction
from sceneexpander.frontend.simulated import perturb_poses
from sceneexpander.frontend.tracks import Tracks
from sceneexpander.geometry.rigid import rigid_inverse, rotation_angle_deg

HEIGHT, WIDTH, FOCAL = 240, 320, 290.0
UNIT_PX = WIDTH / 768
CONFIG = SfmConfig(max_features=1000, learned=LearnedUse.NEVER)


@pytest.fixture(scope="module")
def scene() -> scenes.Scene:
    return scenes.render(scenes.room(1), scenes.arc(4, 1.4), FOCAL, HEIGHT, WIDTH)


def measured(scene: scenes.Scene, poses: torch.Tensor, depth: torch.Tensor) -> Tracks:
    cam_from_world = rigid_inverse(poses).double().numpy()
    return retrack(
        [grey_u8(image) for image in scene.images.numpy()],
        cam_from_world[:, :3, :3],
        cam_from_world[:, :3, 3],
        scene.intrinsics_px.double().numpy(),
        depth.numpy(),
        np.ones(len(poses), bool),
        points=300,
        unit_px=UNIT_PX,
    )


def epipolar_errors_px(tracks: Tracks, scene: scenes.Scene) -> np.ndarray:
    """Distance of every match from the epipolar line of the true cameras."""
    errors = []
    matrices = scene.intrinsics_px.double()
    for a in range(len(matrices)):
        for b in range(a + 1, len(matrices)):
            rows = tracks.seen[:, a] & tracks.seen[:, b]
            b_from_a = (rigid_inverse(scene.world_from_cam[b]) @ scene.world_from_cam[a]).double()
            x, y, z = b_from_a[:3, 3].tolist()
            cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
            fundamental = matrices[b].inverse().T @ cross @ b_from_a[:3, :3] @ matrices[a].inverse()
            homogeneous = np.concatenate([tracks.pixel_xy[rows], np.ones((rows.sum(), len(matrices), 1))], axis=2)
            lines = homogeneous[:, a] @ fundamental.numpy().T
            errors.append(np.abs((lines * homogeneous[:, b]).sum(1)) / np.hypot(lines[:, 0], lines[:, 1]))
    return np.concatenate(errors)


def test_places_are_those_of_the_true_cameras_though_the_given_ones_are_off(scene: scenes.Scene) -> None:
    rough = torch.nn.functional.avg_pool2d(scene.depth[:, None], 4)[:, 0]
    wrong = perturb_poses(scene.world_from_cam, 0.3, 0.03, torch.Generator().manual_seed(0))
    exact, tracks = measured(scene, scene.world_from_cam, scene.depth), measured(scene, wrong, rough)
    assert tracks.count > 300
    assert tracks.seen.sum() > 0.6 * exact.seen.sum()
    # 0.3 degrees are 1.5 pixels here.
    assert np.median(epipolar_errors_px(tracks, scene)) < 0.15
    assert np.quantile(epipolar_errors_px(tracks, scene), 0.9) < 0.6


def test_a_view_of_something_else_is_not_found_anywhere(scene: scenes.Scene) -> None:
    noise = torch.rand(scene.images[:1].shape, generator=torch.Generator().manual_seed(0))
    strange = replace(scene, images=torch.cat([scene.images[:3], noise]))
    tracks = measured(strange, scene.world_from_cam, scene.depth)
    assert tracks.seen[:, 3].sum() < 0.02 * tracks.seen.sum()


class Depth:
    """The true depth, in the scale of the candidate."""

    def __init__(self, scene: scenes.Scene) -> None:
        self.scene = scene

    def explained(self, candidate: SparseReconstruction) -> float:
        raise AssertionError("there is one candidate")

    def depth(self, candidate: SparseReconstruction) -> torch.Tensor:
        found = candidate.world_from_cam[:, :3, 3].norm(dim=1).sum()
        truth = (self.scene.world_from_cam[:, :3, 3] - self.scene.world_from_cam[0, :3, 3]).norm(dim=1).sum()
        return self.scene.depth * (found / truth)


def worst_deg(found: SparseReconstruction, scene: scenes.Scene) -> float:
    """The largest error of rotation or direction of a view against the first."""
    truth = rigid_inverse(scene.world_from_cam[:1]) @ scene.world_from_cam
    turn = rotation_angle_deg(found.world_from_cam[1:, :3, :3], truth[1:, :3, :3])
    cosine = torch.cosine_similarity(found.world_from_cam[1:, :3, 3], truth[1:, :3, 3]).clamp(-1, 1)
    return float(torch.maximum(turn, torch.rad2deg(torch.acos(cosine))).max())


def test_cameras_are_better_with_them(scene: scenes.Scene) -> None:
    few = replace(CONFIG, max_features=100)
    before, after = (
        estimate_cameras(
            scene.images, replace(few, retrack=again), generator=torch.Generator().manual_seed(0), pictures=Depth(scene)
        )
        for again in (False, True)
    )
    assert bool(before.posed.all())
    assert bool(after.posed.all())
    assert worst_deg(after, scene) < 0.25 * worst_deg(before, scene)
    assert after.report.points > 2 * before.report.points
    assert after.report.mean_error_px < before.report.mean_error_px


def test_too_few_corners_leave_the_cameras_as_they_were(scene: scenes.Scene) -> None:
    config = replace(CONFIG, retrack_points=4)
    starved = estimate_cameras(
        scene.images,
        replace(config, retrack=True, min_retracked=0),
        generator=torch.Generator().manual_seed(0),
        pictures=Depth(scene),
    )
    alone = estimate_cameras(scene.images, replace(config, retrack=False), generator=torch.Generator().manual_seed(0))
    assert torch.equal(starved.world_from_cam, alone.world_from_cam)
