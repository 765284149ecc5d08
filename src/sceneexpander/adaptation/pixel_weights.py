"""How much each pixel of the inserted view counts in Eq. (gen), see `InsertedWeights` (beyond the paper)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.geometry.agreement import agreement
from sceneexpander.models.protocol import Prediction


def confidence_weight(confidence: Float[Tensor, "*batch height width"]) -> Float[Tensor, "*batch height width"]:
    """A confidence (> 1, larger is surer) as a weight in [0, 1): 1 - 1 / confidence."""
    return 1 - 1 / confidence.clamp(min=1)


@torch.no_grad()
def inserted_weights(
    prediction: Prediction, anchored_depth: Float[Tensor, "captured height width"]
) -> Float[Tensor, "1 height width"]:
    """Weights of the inserted view's pixels with mean 1: agreement with the captured views x the model's own confidence.

    Args:
        prediction: of some captured views, then the inserted one.
        anchored_depth: of those captured views.
    """
    count = len(anchored_depth)
    if prediction.depth is None:
        raise ValueError("the weights need the depth head")
    cameras = prediction.cameras_of(*prediction.depth.shape[1:])
    points = cameras[count:].unproject(prediction.depth[count:])[0]
    weight = agreement(points, anchored_depth, cameras[:count]).weight
    if prediction.depth_conf is not None:
        weight = weight * confidence_weight(prediction.depth_conf[count])
    return (weight / weight.mean().clamp(min=1e-6))[None]
