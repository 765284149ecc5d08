"""A rendered place whose last view stands a little off."""

from __future__ import annotations

import pytest
import torch

from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.geometry.priors import EVIDENCE_CHANNELS, Priors
from sceneexpander.synthetic import make_views

VIEWS = 3


@pytest.fixture(scope="module")
def world() -> tuple[Priors, Anchors, torch.Tensor]:
    """True priors of three captured views and one more, which stands for the inserted one."""
    made = make_views(11, views=VIEWS + 1, height=84, width=112, kind="room", degrade=False, split="test")
    depth = torch.where(made.valid, made.depth, made.depth[made.valid].max())
    priors = Priors(
        world_from_cam=made.world_from_cam,
        intrinsics_px=made.intrinsics_px,
        depth=depth,
        evidence=torch.zeros(VIEWS + 1, len(EVIDENCE_CHANNELS), 84, 112),
        posed=torch.ones(VIEWS + 1, dtype=torch.bool),
    )
    anchors = Anchors(
        weights_sha256="",
        view_ids=tuple("abc"),
        camera_vector=torch.zeros(VIEWS, 9),
        depth=depth[:VIEWS],
        depth_conf=torch.ones(VIEWS, 84, 112),
        normals=made.normals[:VIEWS],
        normals_conf=torch.ones(VIEWS, 84, 112),
    )
    return priors, anchors, made.images


def moved(priors: Priors, degrees: float, scale: float) -> Priors:
    """The priors in another scale, with the last camera turned."""
    assert priors.world_from_cam is not None
    assert priors.depth is not None
    angle = torch.deg2rad(torch.tensor(degrees))
    turn = torch.eye(4)
    turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = angle.cos(), angle.sin(), -angle.sin(), angle.cos()
    poses = priors.world_from_cam.clone()
    poses[-1] = poses[-1] @ turn
    poses[:, :3, 3] *= scale
    return Priors(
        world_from_cam=poses,
        intrinsics_px=priors.intrinsics_px,
        depth=priors.depth * scale,
        evidence=priors.evidence,
        posed=priors.posed,
    )
