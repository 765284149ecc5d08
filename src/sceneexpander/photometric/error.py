"""Rendered pictures as a learning signal: what the Gaussians show at a captured camera against the photo taken there."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.models.protocol import Prediction
from sceneexpander.splatting import render


def photometric_error(
    prediction: Prediction,
    images: Float[Tensor, "view 3 height width"],
    view: int,
    mask: Bool[Tensor, "height width"] | None = None,
    *,
    others_weight: float,
    min_alpha: float,
    squared: bool = False,
) -> Float[Tensor, ""]:
    """Mean error of the photo of ``view`` rendered from all Gaussians, plus that from the other views' Gaussians.

    Args:
        prediction: with Gaussians.
        images: the photos, in the prediction's order.
        view: which of them.
        mask: pixels that count; all of them by default.
        others_weight: weight of the rendering without the view's own Gaussians.
        min_alpha: pixels of that rendering count where the other views cover them at least this much.
        squared: mean squared colour differences instead of absolute ones.
    """
    gaussians = prediction.gaussians
    if gaussians is None:
        raise ValueError("a rendered picture needs the Gaussian head")
    height, width = images.shape[-2:]
    counted = torch.ones(height, width, dtype=torch.bool, device=images.device) if mask is None else mask
    pose, intrinsics = prediction.world_from_cam[view : view + 1], prediction.intrinsics_px[view : view + 1]
    whole = render(gaussians, Cameras(pose, intrinsics, height, width))
    distance = torch.square if squared else torch.abs
    total = _masked_mean(distance(whole.rgb[0] - images[view]).mean(0), counted)
    if others_weight > 0 and images.shape[0] > 1:
        others = render(gaussians.select(gaussians.source_view != view), Cameras(pose, intrinsics, height, width))
        covered = (others.alpha[0].detach() > min_alpha) & counted
        # Colour of what is there, not of the black behind it: the loss is to move geometry, not to fill holes.
        colour = others.rgb[0] / others.alpha[0].clamp(min=min_alpha)
        total = total + others_weight * _masked_mean(distance(colour - images[view]).mean(0), covered)
    return total


def renderable(prediction: Prediction) -> bool:
    """Whether cameras and Gaussians are finite and the focal lengths positive."""
    values = [prediction.world_from_cam, prediction.intrinsics_px]
    if prediction.gaussians is not None:
        values += [prediction.gaussians.means, prediction.gaussians.scales, prediction.gaussians.opacities]
    finite = all(bool(torch.isfinite(value).all()) for value in values)
    return finite and bool((prediction.intrinsics_px[:, [0, 1], [0, 1]] > 0).all())


def _masked_mean(values: Float[Tensor, "height width"], mask: Bool[Tensor, "height width"]) -> Float[Tensor, ""]:
    return (values * mask).sum() / mask.sum().clamp(min=1)
