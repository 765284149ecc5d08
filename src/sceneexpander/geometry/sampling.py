"""How finely cameras sample a scene, and the narrowest Gaussian that such samples can tell apart.

A Gaussian much narrower than the pixels it was made from is a guess: it shows the right colour at that one size because the rasteriser's
blur widens it, and leaves gaps at every larger one. Mip-Splatting (Yu et al., CVPR 2024, section 4.1) therefore smooths every Gaussian
with a low-pass filter as wide as the samples of the camera that resolves it best.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.rigid import transform_points

BAND_LIMIT_PX = 0.2**0.5  # standard deviation of the filter, pixels of the best camera; Mip-Splatting's constant
_MARGIN = 0.15  # of the image size beyond its border: a Gaussian there still reaches into the picture


@torch.no_grad()
def finest_pixel(points: Float[Tensor, "point 3"], cameras: Iterable[Cameras]) -> Float[Tensor, " point"]:
    """Side of the smallest pixel, scene units, with which any camera samples each point; 0 where no camera sees it.

    Args:
        points: world frame.
        cameras: groups of one picture size each.
    """
    finest = torch.full_like(points[:, 0], torch.inf)
    for group in cameras:
        height, width = group.height, group.width
        for cam_from_world, k in zip(group.cam_from_world, group.intrinsics_px, strict=True):
            x, y, z = transform_points(cam_from_world, points).unbind(-1)
            depth = z.clamp(min=torch.finfo(z.dtype).tiny)
            u, v = k[0, 0] * x / depth + k[0, 2], k[1, 1] * y / depth + k[1, 2]
            inside = (u > -_MARGIN * width) & (u < (1 + _MARGIN) * width)
            inside &= (v > -_MARGIN * height) & (v < (1 + _MARGIN) * height) & (z > 0)
            side = depth / torch.maximum(k[0, 0], k[1, 1])
            finest = torch.where(inside, torch.minimum(finest, side), finest)
    return torch.where(torch.isfinite(finest), finest, torch.zeros_like(finest))


def band_limited(scales: Float[Tensor, "*batch axis"], pixel: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch axis"]:
    """Standard deviations of Gaussians after the filter: none is below `BAND_LIMIT_PX` times the ``pixel`` (a side, scene units)."""
    return (scales.square() + (BAND_LIMIT_PX * pixel)[..., None].square()).sqrt()
