"""What views hold where points of the world project into them."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.geometry.rigid import rigid_inverse, transform_points

_NEAREST = 1e-6  # depth below which a point has no place in a view


def project_to_views(
    points_world: Float[Tensor, "point 3"],
    cam_from_world: Float[Tensor, "view 4 4"],
    intrinsics_px: Float[Tensor, "view 3 3"],
    height: int,
    width: int,
) -> tuple[Float[Tensor, "view point 2"], Float[Tensor, "view point"], Bool[Tensor, "view point"]]:
    """(place for `sample_at`, depth there (positive; behind the camera a tiny one), whether it is in frame) of points in views."""
    points = transform_points(cam_from_world, points_world.expand(len(cam_from_world), -1, -1))
    depth = points[..., 2].clamp(min=_NEAREST)
    grid = grid_of_pixels((points @ intrinsics_px.transpose(-1, -2))[..., :2] / depth[..., None], height, width)
    in_frame = (points[..., 2] > _NEAREST) & (grid.abs() < 1).all(-1)
    # Far outside coordinates would overflow the sampler's integers.
    return grid.clamp(-2, 2), depth, in_frame


def grid_of_pixels(pixel: Float[Tensor, "*batch 2"], height: int, width: int) -> Float[Tensor, "*batch 2"]:
    """Pixel coordinates as the sampler's: from -1 to 1 between the outer edges of the frame."""
    return pixel / pixel.new_tensor([width / 2, height / 2]) - 1


def sample_at(
    content: Float[Tensor, "view channel height width"], grid: Float[Tensor, "view point 2"], mode: str = "bilinear"
) -> Float[Tensor, "view channel point"]:
    """Samples at places of `project_to_views`; outside the frame the border is repeated."""
    sampled = torch.nn.functional.grid_sample(
        content, grid[:, :, None], mode=mode, padding_mode="border", align_corners=False
    )
    return sampled[..., 0]


def seen_at(
    points_world: Float[Tensor, "point 3"],
    content: Float[Tensor, "view channel height width"],
    world_from_cam: Float[Tensor, "view 4 4"],
    intrinsics_px: Float[Tensor, "view 3 3"],
    mode: str,
) -> tuple[Float[Tensor, "view channel point"], Float[Tensor, "view point"], Bool[Tensor, "view point"]]:
    """(views' content where the points project, the points' depth there, whether they are in frame)."""
    height, width = content.shape[-2:]
    grid, z, in_frame = project_to_views(points_world, rigid_inverse(world_from_cam), intrinsics_px, height, width)
    return sample_at(content, grid, mode), z, in_frame


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
