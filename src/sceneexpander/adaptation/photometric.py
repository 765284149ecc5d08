"""Rendered pictures as a learning signal: what the Gaussians show at a captured camera against the photo taken there."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.adaptation.config import AdaptConfig
from sceneexpander.adaptation.inputs import AdaptationInputs
from sceneexpander.adaptation.objective import NonFiniteLoss
from sceneexpander.geometry.randomness import child_generator
from sceneexpander.models.protocol import ALL_HEADS, Head, Prediction, Reconstructor
from sceneexpander.splatting import render

_COVERED = 0.5  # alpha from which on the other views are taken to cover a pixel


def photometric_error(
    prediction: Prediction,
    images: Float[Tensor, "view 3 height width"],
    view: int,
    mask: Bool[Tensor, "height width"] | None = None,
    *,
    others_weight: float,
    min_alpha: float,
) -> Float[Tensor, ""]:
    """Mean absolute error of the photo of ``view`` rendered from all Gaussians, plus that from the other views' Gaussians.

    Args:
        prediction: with Gaussians.
        images: the photos, in the prediction's order.
        view: which of them.
        mask: pixels that count; all of them by default.
        others_weight: weight of the rendering without the view's own Gaussians.
        min_alpha: pixels of that rendering count where the other views cover them at least this much.
    """
    gaussians = prediction.gaussians
    if gaussians is None:
        raise ValueError("a rendered picture needs the Gaussian head")
    height, width = images.shape[-2:]
    counted = torch.ones(height, width, dtype=torch.bool, device=images.device) if mask is None else mask
    pose, intrinsics = prediction.world_from_cam[view : view + 1], prediction.intrinsics_px[view : view + 1]
    whole = render(gaussians, pose, intrinsics, height, width)
    total = _masked_mean((whole.rgb[0] - images[view]).abs().mean(0), counted)
    if others_weight > 0 and images.shape[0] > 1:
        others = render(gaussians.select(gaussians.source_view != view), pose, intrinsics, height, width)
        covered = (others.alpha[0].detach() > min_alpha) & counted
        # Colour of what is there, not of the black behind it: the loss is to move geometry, not to fill holes.
        colour = others.rgb[0] / others.alpha[0].clamp(min=min_alpha)
        total = total + others_weight * _masked_mean((colour - images[view]).abs().mean(0), covered)
    return total


def learn_from_photo(
    model: Reconstructor, inputs: AdaptationInputs, config: AdaptConfig, *, inserted: bool, seed: int, step: int
) -> float:
    """Add the gradient of ``lambda_splat`` x `photometric_error` at one captured view, drawn for the step; returns the error.

    The captured views are given as they are and all of them (with the inserted one if ``inserted``), as they will be when the scene
    is made. A pass of its own: its activations never meet those of the other losses.

    Raises:
        NonFiniteLoss: the prediction cannot be rendered, or the error is not finite.
    """
    images, priors = inputs.captured, inputs.captured_priors
    if inserted:
        images, priors = torch.cat([images, inputs.inserted[None]]), inputs.joint_priors
    prediction = model.predict(images, priors, heads=ALL_HEADS - {Head.POINTS})
    if not renderable(prediction):
        raise NonFiniteLoss(f"cameras or Gaussians cannot be rendered at step {step}")
    generator = child_generator(seed, f"adapt/splat/{step}")
    view = int(torch.randint(len(inputs.captured), (), generator=generator))
    error = photometric_error(prediction, images, view, others_weight=config.splat_others, min_alpha=_COVERED)
    value = float(error.detach())
    if not math.isfinite(value):
        raise NonFiniteLoss(f"splat is {value} at step {step}")
    (config.lambda_splat * error).backward()  # type: ignore[no-untyped-call]
    return value


def renderable(prediction: Prediction) -> bool:
    """Whether cameras and Gaussians are finite and the focal lengths positive."""
    values = [prediction.world_from_cam, prediction.intrinsics_px]
    if prediction.gaussians is not None:
        values += [prediction.gaussians.means, prediction.gaussians.scales, prediction.gaussians.opacities]
    finite = all(bool(torch.isfinite(value).all()) for value in values)
    return finite and bool((prediction.intrinsics_px[:, [0, 1], [0, 1]] > 0).all())


def _masked_mean(values: Float[Tensor, "height width"], mask: Bool[Tensor, "height width"]) -> Float[Tensor, ""]:
    return (values * mask).sum() / mask.sum().clamp(min=1)
