"""What follows from a depth map when a network has no head for it: normals and Gaussians, the same way for every method."""

from __future__ import annotations

from dataclasses import replace

from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.geometry.normals import normals_from_depth
from sceneexpander.models.pixel_aligned import pixel_aligned
from sceneexpander.models.protocol import Head, Prediction


def with_depth(
    prediction: Prediction,
    depth: Float[Tensor, "view height width"],
    conf: Float[Tensor, "view height width"],
    *,
    images: Float[Tensor, "view 3 height width"],
    heads: frozenset[Head],
    generated: Bool[Tensor, "view"] | None,
) -> Prediction:
    """The prediction with what was asked for of depth, normals and Gaussians.

    Normals have the confidence of the depth: they can be no surer than what they are made of. Gaussians follow
    `sceneexpander.models.pixel_aligned`.
    """
    if Head.DEPTH in heads:
        prediction = replace(prediction, depth=depth, depth_conf=conf)
    if not heads & {Head.NORMALS, Head.GAUSSIANS}:
        return prediction
    normals = normals_from_depth(depth, prediction.intrinsics_px)
    if Head.NORMALS in heads:
        prediction = replace(prediction, normals=normals, normals_conf=conf)
    if Head.GAUSSIANS in heads:
        gaussians = pixel_aligned(
            images=images,
            depth=depth,
            depth_conf=conf,
            cameras=prediction.cameras_of(*images.shape[2:]),
            normals=normals,
            generated=generated,
        )
        prediction = replace(prediction, gaussians=gaussians, gaussian_depth=depth)
    return prediction
