"""From trunk features to cameras and dense maps, as WorldMirror and OmniVGGT do it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.geometry.camera import pose_from_camera_vector
from sceneexpander.models.layers.activations import confidence, positive_exp, signed_expm1
from sceneexpander.models.layers.backbone import TrunkFeatures
from sceneexpander.models.layers.dpt import DptHead

Map = Float[Tensor, "batch view height width"]
VectorMap = Float[Tensor, "batch view height width 3"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Cameras:
    """Cameras of B scenes of S views."""

    vector: Float[Tensor, "batch view 9"]  # as in `Prediction.camera_vector`
    world_from_cam: Float[Tensor, "batch view 4 4"]
    intrinsics_px: Float[Tensor, "batch view 3 3"]


def cameras_from_vector(vector: Float[Tensor, "batch view 9"], size: tuple[int, int]) -> Cameras:
    """Decode camera vectors for images of (height, width) pixels."""
    world_from_cam, intrinsics = pose_from_camera_vector(vector, *size)
    return Cameras(vector=vector, world_from_cam=world_from_cam, intrinsics_px=intrinsics)


def dense_map(
    head: DptHead, features: TrunkFeatures, *, checkpoint: bool = False
) -> Float[Tensor, "batch view channel height width"]:
    """Raw channels of a dense head for every view."""
    raw = head(
        features.flat(),
        specials=features.specials,
        grid=features.grid,
        size=features.size,
        checkpoint=checkpoint,
    )
    return torch.unflatten(raw, 0, features.collected[0].shape[:2])


def depth_and_conf(raw: Float[Tensor, "batch view 2 height width"]) -> tuple[Map, Map]:
    """(z-depth, confidence) of a depth head's raw channels."""
    return positive_exp(raw[:, :, 0]), confidence(raw[:, :, 1])


def points_and_conf(raw: Float[Tensor, "batch view 4 height width"]) -> tuple[VectorMap, Map]:
    """(points, confidence) of a point head's raw channels."""
    return signed_expm1(channels_last(raw[:, :, :3])), confidence(raw[:, :, 3])


def channels_last(raw: Float[Tensor, "batch view channel height width"]) -> VectorMap:
    """The same map with its channels on the last axis."""
    return raw.permute(0, 1, 3, 4, 2)


def check_views(images: Float[Tensor, "view 3 height width"]) -> None:
    """Raise `ValueError` unless the images are those of one scene."""
    if images.ndim != 4 or images.shape[1] != 3:
        raise ValueError(f"images must be (view, 3, height, width), got {tuple(images.shape)}")
