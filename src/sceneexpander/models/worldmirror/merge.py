"""Voxel merge: Gaussians that share a voxel become one (worldmirror spec 8.2), with provenance."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.models.worldmirror.gaussians import PixelGaussians

VOXEL_LIMIT = 2**40  # voxel indices are clamped to this, so that a wild depth cannot overflow
KEY_LIMIT = 2**62


def voxel_groups(means: Float[Tensor, "gaussian 3"], voxel_size: float) -> tuple[Int[Tensor, "gaussian"], int]:
    """(group of every Gaussian, number of groups); groups are numbered in ascending (x, y, z) voxel order."""
    index = torch.nan_to_num(torch.floor(means.detach() / voxel_size), nan=0.0)
    voxel = index.clamp(-VOXEL_LIMIT, VOXEL_LIMIT).to(torch.int64)
    voxel = voxel - voxel.amin(0)
    dims = [int(extent) + 1 for extent in voxel.amax(0)]
    if dims[0] * dims[1] * dims[2] < KEY_LIMIT:
        key = (voxel[:, 0] * dims[1] + voxel[:, 1]) * dims[2] + voxel[:, 2]
        unique, group = torch.unique(key, return_inverse=True)
    else:
        unique, group = torch.unique(voxel, dim=0, return_inverse=True)
    return group, int(unique.shape[0])


def merge_voxels(
    pixels: PixelGaussians,
    batch_index: int,
    *,
    voxel_size: float,
    source_view: Int[Tensor, "gaussian"],
    generated: Bool[Tensor, "gaussian"],
) -> Gaussians:
    """Weighted means of the Gaussians of one scene that fall in the same voxel, in ascending voxel order.

    The merged opacity is ``sum w^2 / sum w``: the predicted opacity is not used. A merged Gaussian takes the source view of its
    heaviest member (the first of equals) and counts as generated if generated members hold more than half of its weight.
    """
    means, weights = pixels.means[batch_index], pixels.weights[batch_index]
    group, count = voxel_groups(means, voxel_size)
    values = torch.cat(
        [
            means,
            pixels.scales[batch_index],
            pixels.sh[batch_index, :, 0],
            pixels.quats[batch_index],
            weights[:, None],
            torch.ones_like(weights)[:, None],
        ],
        dim=-1,
    )
    sums = values.new_zeros(count, values.shape[1]).index_add(0, group, values * weights[:, None])
    mean, scale, sh, quat, squares, total = torch.split(sums, [3, 3, 3, 4, 1, 1], dim=-1)
    total = total.clamp(min=1e-8)
    quat = quat / total
    heaviest, mostly_generated = _provenance(group, count, weights.detach(), generated)
    return Gaussians(
        means=mean / total,
        quat_wxyz=quat / quat.norm(dim=-1, keepdim=True).clamp(min=1e-8),
        scales=scale / total,
        opacities=(squares / total)[:, 0],
        sh=(sh / total)[:, None],
        source_view=source_view[heaviest],
        generated=mostly_generated,
    )


def _provenance(
    group: Int[Tensor, "gaussian"], count: int, weights: Float[Tensor, "gaussian"], generated: Bool[Tensor, "gaussian"]
) -> tuple[Int[Tensor, "group"], Bool[Tensor, "group"]]:
    """(index of each group's heaviest member, whether generated members hold more than half of its weight)."""
    top = weights.new_zeros(count).scatter_reduce(0, group, weights, "amax", include_self=False)
    member = torch.arange(group.shape[0], device=group.device)
    candidate = torch.where(weights == top[group], member, torch.full_like(member, group.shape[0] - 1))
    heaviest = torch.full((count,), group.shape[0] - 1, device=group.device).scatter_reduce(0, group, candidate, "amin")
    signed = torch.where(generated, weights, -weights)
    return heaviest, weights.new_zeros(count).index_add(0, group, signed) > 0


def leave_unmerged(
    pixels: PixelGaussians,
    batch_index: int,
    *,
    source_view: Int[Tensor, "gaussian"],
    generated: Bool[Tensor, "gaussian"],
) -> Gaussians:
    """The Gaussians of one scene as they are, with their predicted opacities."""
    return Gaussians(
        means=pixels.means[batch_index],
        quat_wxyz=pixels.quats[batch_index],
        scales=pixels.scales[batch_index],
        opacities=pixels.opacities[batch_index],
        sh=pixels.sh[batch_index],
        source_view=source_view,
        generated=generated,
    )
