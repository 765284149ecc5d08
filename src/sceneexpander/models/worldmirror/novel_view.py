"""The novel-view protocol: Gaussians from the context views, cameras for all views in one scale (worldmirror spec 8.4)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.models.layers.outputs import Cameras
from sceneexpander.models.protocol import ALL_HEADS, Head
from sceneexpander.models.worldmirror.model import BatchPrediction, GaussianOutput, WorldMirror
from sceneexpander.models.worldmirror.priors import BatchPriors


@dataclass(frozen=True, slots=True, kw_only=True)
class NovelViews:
    """Result of `predict_novel_views`."""

    prediction: BatchPrediction  # of all views; `gaussians` is None
    context: GaussianOutput  # of the context views only, in the context pass's world
    cameras: Cameras  # of all views, translations rescaled to the context pass: render with these
    valid: Bool[Tensor, "batch view height width"]  # pixels that count in a comparison


def predict_novel_views(
    model: WorldMirror,
    images: Float[Tensor, "batch view 3 height width"],
    is_target: Bool[Tensor, "batch view"] | None = None,
    priors: BatchPriors | None = None,
    valid: Bool[Tensor, "batch view height width"] | None = None,
) -> NovelViews:
    """Pose the targets together with the context, but build the Gaussians from the context alone.

    Args:
        model: with a Gaussian head.
        images: context views first, then target views; RGB in [0, 1].
        is_target: which views are targets; the count is that of the first scene. Default: none.
        priors: normalised over all views, then cut to the context.
        valid: pixels with known truth, handed through (default: all).

    Raises:
        ValueError: if the model has no Gaussian head, or the targets do not come last.
    """
    if Head.GAUSSIANS not in model.config.heads:
        raise ValueError("the novel-view protocol needs the Gaussian head")
    count = images.shape[1] if is_target is None else int((~is_target[0]).sum())
    if is_target is not None and (bool(is_target[:, :count].any()) or not bool(is_target[:, count:].all())):
        raise ValueError("context views must come first, the same number in every scene")
    context_views = slice(0, count)
    normalised = model.normalise(priors, images)
    prediction = model.decode(model.encode(images, normalised), images, heads=ALL_HEADS - {Head.GAUSSIANS})
    context_images = images[:, context_views]
    context_priors = None if normalised is None else normalised.select(context_views)
    features = model.encode(context_images, context_priors)
    context_cameras = model.cameras(features)
    gaussians = model.gaussians(features, context_images, context_cameras)
    cameras = _rescaled(prediction.cameras, context_cameras)
    if valid is None:
        batch, views, _, height, width = images.shape
        valid = torch.ones(batch, views, height, width, dtype=torch.bool, device=images.device)
    return NovelViews(prediction=prediction, context=gaussians, cameras=cameras, valid=valid)


def _rescaled(cameras: Cameras, context: Cameras) -> Cameras:
    """The cameras with centres scaled so that the context's mean distance to the origin is that of the context pass."""
    count = context.world_from_cam.shape[1]

    def mean_distance(world_from_cam: Tensor) -> Tensor:
        return world_from_cam[:, :count, :3, 3].norm(dim=-1).mean(dim=1)

    factor = mean_distance(context.world_from_cam) / (mean_distance(cameras.world_from_cam) + 1e-6)
    scale = torch.ones_like(cameras.world_from_cam)
    scale[..., :3, 3] = factor[:, None, None]
    return replace(cameras, world_from_cam=cameras.world_from_cam * scale)
