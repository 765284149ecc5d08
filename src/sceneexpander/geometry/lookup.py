"""Maps sampled at places of their frame."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def grid_of_pixels(pixel: Float[Tensor, "*batch 2"], height: int, width: int) -> Float[Tensor, "*batch 2"]:
    """Pixel coordinates as the sampler's: from -1 to 1 between the outer edges of the frame."""
    return pixel / pixel.new_tensor([width / 2, height / 2]) - 1


def sample_at(
    content: Float[Tensor, "view channel height width"], grid: Float[Tensor, "view point 2"], mode: str = "bilinear"
) -> Float[Tensor, "view channel point"]:
    """Samples at places in coordinates of `grid_of_pixels`; outside the frame the border is repeated."""
    sampled = torch.nn.functional.grid_sample(
        content, grid[:, :, None], mode=mode, padding_mode="border", align_corners=False
    )
    return sampled[..., 0]


def warp_maps(
    maps: Float[Tensor, "channel height width"], grid: Float[Tensor, "height width 2"]
) -> Float[Tensor, "channel height width"]:
    """Maps resampled (bilinear) where a grid says, in coordinates of `grid_of_pixels`; outside the frame the border is repeated."""
    sampled = torch.nn.functional.grid_sample(
        maps[None], grid[None].to(maps), mode="bilinear", padding_mode="border", align_corners=False
    )
    return sampled[0]


def warp_known(
    values: Float[Tensor, "height width"], known: Bool[Tensor, "height width"], grid: Float[Tensor, "height width 2"]
) -> tuple[Float[Tensor, "height width"], Bool[Tensor, "height width"]]:
    """(a warped map, where it is known): a pixel is known if all that it was made from is."""
    moved = warp_maps(torch.stack([values, known.to(values)]), grid)
    return moved[0], moved[1] > 1 - 1e-4
