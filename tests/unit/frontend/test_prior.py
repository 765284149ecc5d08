"""Both halves of the front-end together: one frame, one scale."""

from __future__ import annotations

import dense_scenes as scenes
import pytest
import torch

from sceneexpander.frontend.prior import FrontendConfig, build_priors
from sceneexpander.frontend.sfm import SfmConfig
from sceneexpander.frontend.sfm_types import LearnedUse
from sceneexpander.geometry.priors import EVIDENCE_CHANNELS

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
