"""The distances and losses of the paper, each the mirror of its equation.

Reduction policy: mean over pixels and over the entries of a camera vector, **sum** over views (as Eq. anchor writes it).
All distances return one value per view.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.adaptation.config import AdaptConfig, DepthDistance


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewGeometry:
    """(P, D, N) of some views: camera 9-vectors, depth, normals; beyond the paper their pixels' Gaussians.

    ``splats``: opacity and the logarithms of the three scales; None: not asked for.
    """

    camera_vector: Float[Tensor, "view 9"]
    depth: Float[Tensor, "view height width"]
    normals: Float[Tensor, "view height width 3"]
    splats: Float[Tensor, "view height width 4"] | None = None

    def view(self, start: int, stop: int | None = None) -> ViewGeometry:
        """A slice of the views."""
        return self._changed(lambda values: values[start:stop])

    def clone(self) -> ViewGeometry:
        """The same values in memory of their own."""
        return self._changed(Tensor.clone)

    def detach(self) -> ViewGeometry:
        """The same values as targets, outside the autograd graph."""
        return self._changed(Tensor.detach)

    def _changed(self, change: Callable[[Tensor], Tensor]) -> ViewGeometry:
        return ViewGeometry(
            camera_vector=change(self.camera_vector),
            depth=change(self.depth),
            normals=change(self.normals),
            splats=None if self.splats is None else change(self.splats),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class LossTerms:
    """The three summands of Eq. (anchor) or Eq. (gen), already weighted and summed over views."""

    camera: Float[Tensor, ""]
    depth: Float[Tensor, ""]
    normal: Float[Tensor, ""]

    @property
    def total(self) -> Float[Tensor, ""]:
        """Their sum."""
        return self.camera + self.depth + self.normal


def camera_distance(
    predicted: Float[Tensor, "view 9"], target: Float[Tensor, "view 9"], huber: float
) -> Float[Tensor, "view"]:
    """d_cam: mean smooth-L1 over the 9 entries, the target's quaternion given the sign that is nearer to the prediction.

    q and -q are the same rotation; without the alignment equal cameras could have a large distance.
    """
    quat = target[:, 3:7]
    sign = torch.where((predicted[:, 3:7].detach() * quat).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    aligned = torch.cat([target[:, :3], quat * sign, target[:, 7:]], dim=-1)
    return torch.nn.functional.smooth_l1_loss(predicted, aligned, beta=huber, reduction="none").mean(-1)


def depth_distance(
    predicted: Float[Tensor, "view height width"],
    target: Float[Tensor, "view height width"],
    kind: DepthDistance,
    weights: Float[Tensor, "view height width"] | None = None,
) -> Float[Tensor, "view"]:
    """d_D: mean absolute difference, in scene units; or the scale-invariant log error (standard deviation of the log ratio)."""
    if kind is DepthDistance.L1:
        return _mean((predicted - target).abs(), weights)
    log_ratio = predicted.log() - target.log()
    variance = _mean(log_ratio.square(), weights) - _mean(log_ratio, weights).square()
    # The square root has no derivative at 0, which is where an unadapted student starts.
    return (variance.clamp(min=0) + 1e-8).sqrt() - 1e-4


def normal_distance(
    predicted: Float[Tensor, "view height width 3"],
    target: Float[Tensor, "view height width 3"],
    weights: Float[Tensor, "view height width"] | None = None,
) -> Float[Tensor, "view"]:
    """d_N: mean of 1 - cosine. Inputs are unit vectors."""
    return _mean(1 - (predicted * target).sum(-1), weights)


def splat_distance(
    predicted: Float[Tensor, "view height width 4"], target: Float[Tensor, "view height width 4"]
) -> Float[Tensor, "view"]:
    """Mean absolute difference of opacities plus that of the scales' logarithms (beyond the paper)."""
    difference = (predicted - target).abs().mean((1, 2))
    return difference[:, 0] + difference[:, 1:].mean(1)


def _mean(
    values: Float[Tensor, "view height width"], weights: Float[Tensor, "view height width"] | None
) -> Float[Tensor, "view"]:
    """Mean over pixels, weighted if there are weights."""
    if weights is None:
        return values.mean((-2, -1))
    return (values * weights).sum((-2, -1)) / weights.sum((-2, -1)).clamp(min=1e-6)


def distillation_terms(
    student: ViewGeometry,
    target: ViewGeometry,
    config: AdaptConfig,
    *,
    depth_weight: float,
    normal_weight: float,
    pixel_weights: Float[Tensor, "view height width"] | None = None,
) -> LossTerms:
    """Eq. (anchor) with alpha, Eq. (gen) with beta: the same three distances, summed over the views given."""
    depth = depth_distance(student.depth, target.depth, config.depth_distance, pixel_weights)
    return LossTerms(
        camera=camera_distance(student.camera_vector, target.camera_vector, config.camera_huber).sum(),
        depth=depth_weight * depth.sum(),
        normal=normal_weight * normal_distance(student.normals, target.normals, pixel_weights).sum(),
    )


def anchor_loss(student: ViewGeometry, anchors: ViewGeometry, config: AdaptConfig) -> LossTerms:
    """Eq. (anchor) over the captured views of the batch; ``anchors`` are constants."""
    return distillation_terms(
        student, anchors.detach(), config, depth_weight=config.alpha_depth, normal_weight=config.alpha_normal
    )


def generation_loss(
    student: ViewGeometry,
    teacher: ViewGeometry,
    config: AdaptConfig,
    pixel_weights: Float[Tensor, "1 height width"] | None = None,
) -> LossTerms:
    """Eq. (gen) on the inserted view; the EMA teacher's outputs are constants. ``pixel_weights`` are ours, see `consistency`."""
    return distillation_terms(
        student,
        teacher.detach(),
        config,
        depth_weight=config.beta_depth,
        normal_weight=config.beta_normal,
        pixel_weights=pixel_weights,
    )
