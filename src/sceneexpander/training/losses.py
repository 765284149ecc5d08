"""Training losses. Each is the mean over valid pixels; weights live in the caller."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from sceneexpander.geometry.camera import camera_vector_from_pose
from sceneexpander.models.protocol import Prediction
from sceneexpander.training.sample import Sample

FARTHEST = 12.0  # pixels beyond this multiple of the scene's median depth carry no depth loss
_NEAR, _NEAR_WEIGHT = 0.2, 0.5  # of the saturating term: it weighs as much as |log error| up to about this error
_SSIM_C1, _SSIM_C2 = 0.01**2, 0.03**2


def masked_mean(values: Float[Tensor, "*shape"], weights: Tensor) -> Float[Tensor, ""]:
    """Weighted mean; 0 where nothing has weight."""
    weights = weights.to(values.dtype)
    return (values * weights).sum() / weights.sum().clamp(min=1e-6)


def supervised_pixels(sample: Sample) -> Bool[Tensor, "view height width"]:
    """Input pixels with a surface that is not extremely far."""
    log_depth = sample.log_depth[: sample.inputs]
    valid = log_depth.isfinite()
    median = log_depth[valid].median() if bool(valid.any()) else log_depth.new_zeros(())
    return valid & (log_depth - median < torch.tensor(FARTHEST).log())


def log_depth_error(
    log_depth: Float[Tensor, "view height width"], sample: Sample, valid: Bool[Tensor, "view height width"]
) -> Float[Tensor, "view height width"]:
    """log predicted - log true depth, 0 where not valid. A view without a pose has a free scale: its median is taken off."""
    truth = torch.where(valid, sample.log_depth[: sample.inputs], 0.0)
    error = torch.where(valid, log_depth - truth, 0.0)
    for view in torch.nonzero(~sample.posed)[:, 0].tolist():
        if bool(valid[view].any()):
            shift = error[view][valid[view]].median().detach()
            error = torch.where((torch.arange(len(error)) == view)[:, None, None] & valid, error - shift, error)
    return error


def depth_loss(
    error: Float[Tensor, "view height width"],
    valid: Bool[Tensor, "view height width"],
    confident: Float[Tensor, "view height width"],
) -> Float[Tensor, ""]:
    """Mean |log error| and a term that saturates; pixels that the base is not confident of weigh twice.

    Where the pictures leave several depths possible, |log error| alone asks for one in between, which is none of them.
    """
    size = error.abs()
    return masked_mean(size + _NEAR_WEIGHT * (1 - (-size / _NEAR).exp()), valid * (2 - confident))


def scale_loss(
    log_depth: Float[Tensor, "view height width"], sample: Sample, valid: Bool[Tensor, "view height width"]
) -> Float[Tensor, ""]:
    """Mean |mean log error| over the views without a pose: their scale, which `log_depth_error` leaves free.

    It is a guess from what pictures of such places are like, so it must not be paid for with their shape.
    """
    lost = torch.nonzero(~sample.posed)[:, 0].tolist()
    truth = torch.where(valid, sample.log_depth[: sample.inputs], 0.0)
    errors = [masked_mean(log_depth[view] - truth[view], valid[view]).abs() for view in lost]
    return torch.stack(errors).sum() / sample.inputs if errors else log_depth.new_zeros(())


def confidence_loss(
    error: Float[Tensor, "view height width"],
    confidence: Float[Tensor, "view height width"],
    valid: Bool[Tensor, "view height width"],
) -> Float[Tensor, ""]:
    """Laplace negative log-likelihood of the error with scale 1 / confidence; the error itself gets no gradient."""
    return masked_mean(confidence * error.detach().abs() - confidence.log(), valid)


def gradient_loss(
    error: Float[Tensor, "view height width"],
    valid: Bool[Tensor, "view height width"],
    strides: tuple[int, ...] = (1, 2, 4),
) -> Float[Tensor, ""]:
    """Mean |difference of the error between neighbours| at several strides: edges and slopes."""
    terms = []
    for stride in strides:
        e, m = error[:, ::stride, ::stride], valid[:, ::stride, ::stride]
        terms.append(masked_mean((e[:, :, 1:] - e[:, :, :-1]).abs(), m[:, :, 1:] & m[:, :, :-1]))
        terms.append(masked_mean((e[:, 1:] - e[:, :-1]).abs(), m[:, 1:] & m[:, :-1]))
    return torch.stack(terms).mean()


def normal_losses(
    normals: Float[Tensor, "view height width 3"],
    confidence: Float[Tensor, "view height width"],
    sample: Sample,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """(mean 1 - cosine, Laplace negative log-likelihood of it)."""
    truth = sample.normals[: sample.inputs]
    valid = sample.valid[: sample.inputs]
    distance = 1 - (normals * truth).sum(-1)
    return masked_mean(distance, valid), masked_mean(confidence * distance.detach() - confidence.log(), valid)


def camera_loss(prediction: Prediction, sample: Sample, scale: float) -> Float[Tensor, ""]:
    """Huber loss (beta 0.1) of the camera vectors of posed views, translations over the scene's scale."""
    inputs = sample.inputs
    height, width = sample.images.shape[-2:]
    truth = camera_vector_from_pose(sample.world_from_cam[:inputs], sample.intrinsics_px[:inputs], height, width)
    unit = truth.new_tensor([scale] * 3 + [1.0] * 6)
    error = (prediction.camera_vector - truth) / unit
    weights = truth.new_tensor([2.0] * 3 + [4.0] * 4 + [1.0] * 2) * sample.posed[:, None]
    return masked_mean(functional.smooth_l1_loss(error, torch.zeros_like(error), beta=0.1, reduction="none"), weights)


def render_loss(
    rendered: Float[Tensor, "view 3 height width"], truth: Float[Tensor, "view 3 height width"]
) -> Float[Tensor, ""]:
    """0.8 L1 + 0.2 (1 - SSIM)."""
    return 0.8 * (rendered - truth).abs().mean() + 0.2 * (1 - box_ssim(rendered, truth))


def box_ssim(
    first: Float[Tensor, "view 3 height width"], second: Float[Tensor, "view 3 height width"], window: int = 7
) -> Float[Tensor, ""]:
    """Mean structural similarity with a box window (a training signal; the reported metric is the evaluation's own)."""

    def blur(x: Tensor) -> Tensor:
        return functional.avg_pool2d(x, window, stride=1)

    mean_a, mean_b = blur(first), blur(second)
    var_a = blur(first * first) - mean_a * mean_a
    var_b = blur(second * second) - mean_b * mean_b
    covariance = blur(first * second) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + _SSIM_C1) / (mean_a.square() + mean_b.square() + _SSIM_C1)
    structure = (2 * covariance + _SSIM_C2) / (var_a + var_b + _SSIM_C2)
    return (luminance * structure).mean()
