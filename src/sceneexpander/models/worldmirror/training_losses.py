"""The losses WorldMirror was trained with (worldmirror spec 12.1).

Kept for training from scratch and for agreement with recorded values; test-time adaptation has its own losses. Maps are
(batch, view, height, width); masks are boolean. Non-finite values count as zero, as in the released code.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.geometry.rigid import rigid_inverse
from sceneexpander.models.layers.quaternion import raw_camera_vector
from sceneexpander.models.worldmirror.gaussians import unproject_integer_pixels

CLAMP = 100.0
GAMMA, ALPHA, QUANTILE = 1.0, 0.2, 0.98
MANY = 1000  # up to this many values, the quantile filter does nothing
FEW_PIXELS = 100  # below this many valid pixels a loss is zero
FEW_NORMALS = 10

Map = Float[Tensor, "batch view height width"]
Mask = Bool[Tensor, "batch view height width"]
VectorMap = Float[Tensor, "batch view height width 3"]
SpatialTerm = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True, slots=True, kw_only=True)
class RegressionTerms:
    """The three parts of a regression loss; the loss is their sum."""

    conf: Float[Tensor, ""]
    reg: Float[Tensor, ""]
    spatial: Float[Tensor, ""]

    @property
    def total(self) -> Float[Tensor, ""]:
        """The loss."""
        return self.conf + self.reg + self.spatial


def finite(values: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """NaN and infinities become 0, the rest is clamped to [-100, 100]."""
    clean = torch.where(torch.isfinite(values), values, torch.zeros_like(values))
    return clean.clamp(-CLAMP, CLAMP)


def camera_loss(
    camera_vector: Float[Tensor, "batch view 9"], truth: Float[Tensor, "batch view 9"]
) -> tuple[Float[Tensor, ""], Float[Tensor, ""], Float[Tensor, ""]]:
    """L1 of (translation, quaternion, fields of view); the loss is ``t + q + 0.5 fov``."""
    difference = (camera_vector - truth).abs()
    translation, quaternion, fov = torch.split(difference, [3, 4, 2], dim=-1)
    return finite(translation).mean(), finite(quaternion).mean(), finite(fov).mean()


def camera_vector_truth(
    world_from_cam: Float[Tensor, "batch view 4 4"],
    intrinsics_px: Float[Tensor, "batch view 3 3"],
    height: int,
    width: int,
) -> Float[Tensor, "batch view 9"]:
    """Ground truth of `camera_loss`: ``[cam_from_world t, quat xyzw with w >= 0, vertical fov, horizontal fov]``."""
    return raw_camera_vector(rigid_inverse(world_from_cam), intrinsics_px, height, width)


def point_loss(points: VectorMap, truth: VectorMap, mask: Mask, conf: Map) -> RegressionTerms:
    """Regression of world points, with normals as the spatial term."""
    return regression_loss(points, truth, mask, conf, normal_term)


def depth_loss(depth: Map, truth: Map, mask: Mask, conf: Map | None) -> RegressionTerms:
    """Regression of depth, with gradients as the spatial term. Without ``conf`` the confidence part is zero."""
    return regression_loss(depth[..., None], truth[..., None], mask, conf, gradient_term)


def regression_loss(
    prediction: Float[Tensor, "batch view height width channel"],
    truth: Float[Tensor, "batch view height width channel"],
    mask: Mask,
    conf: Map | None,
    spatial: SpatialTerm,
) -> RegressionTerms:
    """``R(pred, gt, mask, conf)``: confidence-weighted and plain distance, filtered by quantile, plus a spatial term."""
    zero = (prediction * 0.0).sum()
    if int(mask.sum()) < FEW_PIXELS:
        return RegressionTerms(conf=zero, reg=zero, spatial=zero)
    residual = finite((truth[mask] - prediction[mask]).norm(dim=-1))
    weighted = zero
    if conf is not None:
        weighted = filtered_mean(finite(GAMMA * residual * conf[mask] - ALPHA * torch.log(conf[mask])))
    return RegressionTerms(conf=weighted, reg=filtered_mean(residual), spatial=spatial(prediction, truth, mask))


def filtered_mean(values: Float[Tensor, "value"]) -> Float[Tensor, ""]:
    """Mean of the values below their 98 % quantile, if there are more than 1000 of them."""
    if values.numel() > MANY:
        values = values.clamp(max=CLAMP)
        rank = round(QUANTILE * (values.numel() - 1)) + 1
        threshold = torch.kthvalue(values.detach(), rank).values
        below = values[values < threshold]
        if below.numel() > MANY:
            values = below
    return values.mean()


def gradient_term(
    prediction: Float[Tensor, "batch view height width channel"],
    truth: Float[Tensor, "batch view height width channel"],
    mask: Mask,
) -> Float[Tensor, ""]:
    """Mean over scales 1, 2, 4, 8 of the absolute first differences of the error per valid pixel."""
    scales = [
        _gradient_at(prediction[:, :, ::s, ::s], truth[:, :, ::s, ::s], mask[:, :, ::s, ::s]) for s in (1, 2, 4, 8)
    ]
    return torch.stack(scales).mean()


def _gradient_at(prediction: Tensor, truth: Tensor, mask: Tensor) -> Tensor:
    valid = mask[..., None].to(prediction.dtype)
    count = valid.sum()
    if not bool(count > 0):
        return (prediction * 0.0).sum()
    error = valid * torch.where(mask[..., None], prediction - truth, torch.zeros_like(prediction))
    total = (prediction * 0.0).sum()
    for axis in (2, 3):
        length = error.shape[axis]
        ahead, behind = error.narrow(axis, 1, length - 1), error.narrow(axis, 0, length - 1)
        both = valid.narrow(axis, 1, length - 1) * valid.narrow(axis, 0, length - 1)
        total = total + ((ahead - behind).abs() * both).clamp(max=CLAMP).sum()
    return total / count


def normal_term(prediction: VectorMap, truth: VectorMap, mask: Mask) -> Float[Tensor, ""]:
    """Mean over scales 1, 2, 4 of ``1 - cos`` between the normals of the two point maps."""
    scales = [_normals_at(prediction[:, :, ::s, ::s], truth[:, :, ::s, ::s], mask[:, :, ::s, ::s]) for s in (1, 2, 4)]
    return torch.stack(scales).mean()


def _normals_at(prediction: Tensor, truth: Tensor, mask: Tensor) -> Tensor:
    predicted, valid = corner_normals(prediction, mask)
    actual, also_valid = corner_normals(truth, mask)
    both = valid & also_valid
    if int(both.sum()) < FEW_NORMALS:
        return (prediction * 0.0).sum()
    cosine = (predicted[both] * actual[both]).sum(-1)
    return (1 - cosine).clamp(max=CLAMP).mean()


def corner_normals(
    points: VectorMap, mask: Mask
) -> tuple[Float[Tensor, "corner batch view height width 3"], Bool[Tensor, "corner batch view height width"]]:
    """Four unit normals per pixel, one per pair of adjacent neighbours, and where all three pixels are valid."""
    padded = F.pad(points, (0, 0, 1, 1, 1, 1))
    known = F.pad(mask, (1, 1, 1, 1))
    centre = padded[:, :, 1:-1, 1:-1]
    up, down = padded[:, :, :-2, 1:-1] - centre, padded[:, :, 2:, 1:-1] - centre
    left, right = padded[:, :, 1:-1, :-2] - centre, padded[:, :, 1:-1, 2:] - centre
    has_up, has_down = known[:, :, :-2, 1:-1], known[:, :, 2:, 1:-1]
    has_left, has_right = known[:, :, 1:-1, :-2], known[:, :, 1:-1, 2:]
    pairs = ((up, left), (left, down), (down, right), (right, up))
    held = ((has_up, has_left), (has_left, has_down), (has_down, has_right), (has_right, has_up))
    normals = torch.stack([F.normalize(torch.linalg.cross(a, b), dim=-1, eps=1e-8) for a, b in pairs])
    return normals, torch.stack([mask & a & b for a, b in held])


def normal_loss(normals: VectorMap, truth: VectorMap, mask: Mask) -> Float[Tensor, ""]:
    """Mean angle (radians) between the normals over valid pixels whose cosine is not extreme."""
    # The pseudo-normals are not quite of unit length.
    cosine = F.cosine_similarity(normals, truth, dim=-1)
    used = mask & (cosine.detach().abs() < 0.999)
    if not bool(used.any()):
        return (normals * 0.0).sum()
    return torch.acos(cosine[used]).mean()


def pseudo_normals(depth: Map, intrinsics_px: Float[Tensor, "batch view 3 3"], mask: Mask) -> tuple[VectorMap, Mask]:
    """Camera-frame normals from a depth map, facing the camera (zero without all four ±2 neighbours), and where they are valid.

    An outer cross product from the neighbours two pixels away and an inner one from -1/+2 neighbours (the +2 is how the released
    code does it), each flipped to face the camera, are summed.
    """
    identity = torch.eye(4, dtype=depth.dtype, device=depth.device).expand(*depth.shape[:2], 4, 4)
    points = unproject_integer_pixels(depth, intrinsics_px, identity)
    height, width = depth.shape[-2:]
    padded = F.pad(points, (0, 0, 2, 2, 2, 2))

    def shifted(rows: int, columns: int) -> Tensor:
        return padded[:, :, 2 + rows : 2 + rows + height, 2 + columns : 2 + columns + width]

    def facing(normal: Tensor) -> Tensor:
        return torch.where((normal * points).sum(-1, keepdim=True) > 0, -normal, normal)

    def unit(normal: Tensor) -> Tensor:
        return normal / (torch.sqrt((normal * normal).sum(-1, keepdim=True) + 1e-4) + 1e-8)

    def crossed(back: int, ahead: int) -> Tensor:
        across = shifted(0, ahead) - shifted(0, back)
        along = shifted(ahead, 0) - shifted(back, 0)
        return unit(facing(torch.linalg.cross(across, along)))

    normals = facing(unit(crossed(-2, 2) + crossed(-1, 2)))
    known = F.pad(mask, (2, 2, 2, 2))
    framed = torch.ones_like(mask)
    for rows, columns in ((0, -2), (0, 2), (-2, 0), (2, 0)):
        framed &= known[:, :, 2 + rows : 2 + rows + height, 2 + columns : 2 + columns + width]
    return torch.where(framed[..., None], normals, torch.zeros_like(normals)), framed & mask


def render_loss(rendered: VectorMap, photo: VectorMap, mask: Mask, context_views: int) -> Float[Tensor, ""]:
    """Squared colour error summed over channels, per valid pixel. All context pixels count, of targets only the valid ones."""
    used = mask.clone()
    used[:, :context_views] = True
    error = ((rendered - photo) ** 2).sum(-1)
    return (error * used).sum() / used.sum().clamp(min=1)
