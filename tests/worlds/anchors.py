"""Anchors of a prediction."""

from __future__ import annotations

from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.models.protocol import Prediction


def anchors_of(frozen: Prediction) -> Anchors:
    """What frozen weights say of the captured views, as the anchors of an adaptation."""
    assert frozen.depth is not None
    assert frozen.depth_conf is not None
    assert frozen.normals is not None
    assert frozen.normals_conf is not None
    return Anchors(
        weights_sha256="0",
        view_ids=tuple(f"{index:03d}" for index in range(len(frozen.depth))),
        camera_vector=frozen.camera_vector,
        depth=frozen.depth,
        depth_conf=frozen.depth_conf,
        normals=frozen.normals,
        normals_conf=frozen.normals_conf,
    )
