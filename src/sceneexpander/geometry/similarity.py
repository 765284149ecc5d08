"""Similarity transforms (scale, rotation, translation) and how to find them from points or from camera poses."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.geometry.rigid import rigid_from_parts

_RELATIVE_SPREAD = 1e-6  # below it points count as one point, or as lying on one line


@dataclass(frozen=True, slots=True, kw_only=True)
class Similarity:
    """``x_target = scale * rotation @ x_source + translation``, with scale > 0."""

    scale: float
    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]

    def points(self, points_source: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Points of the source frame in the target frame."""
        return self.scale * points_source @ self.rotation.T + self.translation

    def poses(self, source_from_cam: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
        """Camera poses (rigid) of the source frame in the target frame; depths seen by them change by ``scale``."""
        rotation = self.rotation @ source_from_cam[..., :3, :3]
        return rigid_from_parts(rotation, self.points(source_from_cam[..., :3, 3]))

    def enlarged(self, factor: float) -> Similarity:
        """The same, followed by multiplying the target frame by ``factor``."""
        return Similarity(scale=self.scale * factor, rotation=self.rotation, translation=self.translation * factor)

    def inverse(self) -> Similarity:
        """The map from target to source."""
        rotation = self.rotation.T
        translation = -(rotation @ self.translation) / self.scale
        return Similarity(scale=1 / self.scale, rotation=rotation, translation=translation)


def umeyama(source: Float[Tensor, "point 3"], target: Float[Tensor, "point 3"]) -> Similarity:
    """The similarity that maps ``source`` to ``target`` with the least sum of squared distances (Umeyama 1991, proper rotations).

    Raises:
        ValueError: fewer than three points, or points on one line: the rotation is not determined (see `align_poses`).
    """
    if source.shape != target.shape or source.shape[0] < 3:
        raise ValueError(f"umeyama needs three or more pairs, got {tuple(source.shape)} and {tuple(target.shape)}")
    points_s, points_t = source.double(), target.double()
    mean_s, mean_t = points_s.mean(0), points_t.mean(0)
    centred_s, centred_t = points_s - mean_s, points_t - mean_t
    for name, centred in (("source", centred_s), ("target", centred_t)):
        spread = torch.linalg.svdvals(centred)
        if not float(spread[1]) > _RELATIVE_SPREAD * float(spread[0]):
            raise ValueError(f"umeyama: the {name} points lie on one line, singular values {spread.tolist()}")
    u, singular, vt = torch.linalg.svd(centred_t.T @ centred_s)
    sign = torch.ones(3, dtype=torch.float64, device=u.device)
    sign[2] = torch.sign(torch.linalg.det(u) * torch.linalg.det(vt))
    rotation = u @ torch.diag(sign) @ vt
    scale = float((singular * sign).sum() / (centred_s**2).sum())
    return _as_similarity(scale, rotation, mean_t - scale * rotation @ mean_s, source)


def align_poses(
    source_from_cam: Float[Tensor, "view 4 4"],
    target_from_cam: Float[Tensor, "view 4 4"],
    *,
    scale: float | None = None,
) -> Similarity:
    """The similarity that brings camera poses together, determined for any number of views.

    The rotation is the chordal mean of what the views' orientations ask for, so cameras on a straight line are no problem (unlike in
    `umeyama`); then scale and translation are least squares on the camera centres.

    Args:
        source_from_cam: poses in the source frame.
        target_from_cam: the same cameras in the target frame.
        scale: use this scale instead of estimating it.

    Raises:
        ValueError: no views, or no scale was given and the centres do not determine it.
    """
    if source_from_cam.shape != target_from_cam.shape or source_from_cam.shape[0] == 0:
        raise ValueError(f"align_poses: {tuple(source_from_cam.shape)} and {tuple(target_from_cam.shape)} poses")
    poses_s, poses_t = source_from_cam.double(), target_from_cam.double()
    u, _, vt = torch.linalg.svd((poses_t[:, :3, :3] @ poses_s[:, :3, :3].transpose(-1, -2)).sum(0))
    sign = torch.ones(3, dtype=torch.float64, device=u.device)
    sign[2] = torch.sign(torch.linalg.det(u @ vt))
    rotation = u @ torch.diag(sign) @ vt
    centres_s, centres_t = poses_s[:, :3, 3], poses_t[:, :3, 3]
    mean_s, mean_t = centres_s.mean(0), centres_t.mean(0)
    if scale is None:
        turned = (centres_s - mean_s) @ rotation.T
        spread = float((turned**2).sum())
        scale = float((turned * (centres_t - mean_t)).sum()) / spread if spread > 0 else 0.0
        if not scale > 0:
            raise ValueError("align_poses: the camera centres do not determine a positive scale")
    return _as_similarity(scale, rotation, mean_t - scale * rotation @ mean_s, source_from_cam)


def align_views(
    source_from_cam: Float[Tensor, "view 4 4"],
    source_depth: Float[Tensor, "view height width"],
    target_from_cam: Float[Tensor, "view 4 4"],
    target_depth: Float[Tensor, "view height width"],
    *,
    posed: Bool[Tensor, "view"] | None = None,
) -> Similarity:
    """The similarity between two estimates of the same views: poses as in `align_poses`, the median ratio of depths as scale.

    Unlike distances of cameras, the ratio of depths is determined for one view and steady for short baselines.

    Args:
        source_from_cam: poses in the source frame.
        source_depth: depths of the same views; pixels that are not positive in both take no part.
        target_from_cam: poses in the target frame.
        target_depth: depths in the target's scale.
        posed: views whose pose is an estimate on both sides; placeholders take no part, unless there is nothing else.

    Raises:
        ValueError: no views, or no pixel with a depth on both sides.
    """
    if posed is not None and bool(posed.any()):
        source_from_cam, target_from_cam = source_from_cam[posed], target_from_cam[posed]
        source_depth, target_depth = source_depth[posed], target_depth[posed]
    known = (source_depth > 0) & (target_depth > 0)
    if not bool(known.any()):
        raise ValueError("align_views: no pixel has a depth on both sides")
    scale = float((target_depth[known] / source_depth[known]).median())
    return align_poses(source_from_cam, target_from_cam, scale=scale)


def _as_similarity(scale: float, rotation: Tensor, translation: Tensor, like: Tensor) -> Similarity:
    return Similarity(scale=scale, rotation=rotation.to(like), translation=translation.to(like))
