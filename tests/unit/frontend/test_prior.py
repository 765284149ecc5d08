"""Both halves of the front-end together: one frame, one scale."""

from __future__ import annotations

from dataclasses import replace

import dense_scenes as scenes
import pytest
import torch

from sceneexpander.frontend.prior import FrontendConfig, SettledCameras, build_priors, keep_settled
from sceneexpander.frontend.sfm import SfmConfig
from sceneexpander.frontend.sfm_types import LearnedUse
from sceneexpander.geometry.priors import EVIDENCE_CHANNELS
from sceneexpander.geometry.rigid import rotation_angle_deg
from sceneexpander.geometry.similarity import Similarity

CONFIG = FrontendConfig(sfm=SfmConfig(max_features=1000, learned=LearnedUse.NEVER))


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_poses_points_and_depth_share_one_scale() -> None:
    scene = scenes.render(scenes.room(1), scenes.arc(3, 1.0), 290.0, 240, 320)
    priors, sparse = build_priors(scene.images, CONFIG, generator=generator(), known_intrinsics_px=scene.intrinsics_px)
    assert priors.depth is not None
    assert priors.world_from_cam is not None
    assert priors.evidence is not None
    assert priors.posed is not None
    assert priors.posed.all()
    assert priors.depth.shape == (3, 240, 320)
    assert priors.evidence.shape == (3, len(EVIDENCE_CHANNELS), 240, 320)
    assert float(priors.depth[0].median()) == pytest.approx(1.0, abs=1e-5)
    torch.testing.assert_close(priors.world_from_cam, sparse.world_from_cam)
    torch.testing.assert_close(priors.world_from_cam[0], torch.eye(4))
    # Sparse points of view 0 against its dense depth: the same surface at the same scale.
    mine = sparse.sparse.view_index == 0
    column, row = sparse.sparse.pixel_xy[mine].long().unbind(1)
    ratio = sparse.sparse.points_world[sparse.sparse.point_index[mine], 2] / priors.depth[0, row, column]
    assert float(ratio.median()) == pytest.approx(1.0, abs=0.02)
    # Baselines against the truth at the depth's scale: pose and depth agree about the size of the world.
    scale = float((priors.depth / scene.depth).median())
    true = (scene.world_from_cam[0, :3, 3] - scene.world_from_cam[2, :3, 3]).norm() * scale
    assert float(priors.world_from_cam[2, :3, 3].norm()) == pytest.approx(float(true), rel=0.05)


def test_one_plain_picture_gives_finite_flat_priors() -> None:
    priors, sparse = build_priors(torch.full((1, 3, 48, 64), 0.5), CONFIG, generator=generator())
    assert priors.depth is not None
    assert torch.isfinite(priors.depth).all()
    assert (priors.depth > 0).all()
    assert float(priors.depth[0].median()) == pytest.approx(1.0)
    assert sparse.report.points == 0


def test_a_camera_that_is_settled_stays_where_it_was_among_those_that_are_found_again() -> None:
    scene = scenes.render(scenes.room(1), scenes.arc(4, 1.0), 290.0, 120, 160)
    _, sparse = build_priors(scene.images, CONFIG, generator=generator(), known_intrinsics_px=scene.intrinsics_px)
    assert sparse.posed.all()
    # What was known before: another frame and unit, three views, the last of them elsewhere than it is found now.
    elsewhere = Similarity(
        scale=3.0, rotation=scene.world_from_cam[1, :3, :3].double(), translation=torch.ones(3).double()
    )
    before = elsewhere.poses(sparse.world_from_cam[:3].double())
    before[2] = before[2] @ scene.world_from_cam[0].double()
    settled = SettledCameras(
        world_from_cam=before.float(),
        intrinsics_px=1.1 * sparse.intrinsics_px[:3],
        posed=torch.ones(3, dtype=torch.bool),
        kept=torch.tensor([False, False, True]),
    )
    held = keep_settled(replace(sparse, posed=torch.tensor([True, True, False, True])), settled)
    wanted = elsewhere.inverse().poses(before)
    torch.testing.assert_close(held.world_from_cam[:3].double(), wanted, atol=1e-4, rtol=0)
    assert float(rotation_angle_deg(held.world_from_cam[2, :3, :3], sparse.world_from_cam[2, :3, :3])) > 1
    torch.testing.assert_close(held.world_from_cam[3], sparse.world_from_cam[3])
    torch.testing.assert_close(held.intrinsics_px[2], settled.intrinsics_px[2])
    assert held.posed.all()
    # What it saw belongs to the other camera.
    assert not (held.sparse.view_index == 2).any()
    others = sparse.sparse.view_index != 2
    torch.testing.assert_close(held.sparse.pixel_xy, sparse.sparse.pixel_xy[others])
    # One camera in common fixes no scale.
    alone = replace(settled, posed=torch.tensor([True, False, True]))
    assert keep_settled(sparse, alone) is sparse
