"""Photographs and cameras on their way in (ttt3r spec 4)."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageOps
from torch import Tensor

from sceneexpander.geometry.rigid import transform_points

RELEASED_SIZE = 512
SQUARE_SIZE = 224  # the only size that is cropped to a square instead of a multiple of the patch
PATCH = 16


def preprocess_image(image: Image.Image, *, size: int = RELEASED_SIZE) -> Float[Tensor, "3 height width"]:
    """RGB in [0, 1], resized and cropped centrally as the official inference does it.

    The longer side becomes ``size`` and both are cropped to multiples of 16; pictures that are square by then to 4:3. With
    ``size`` 224 the shorter side becomes 224 and the longer one is cropped to it. The orientation tag is applied.

    Raises:
        ValueError: if the picture is too narrow to keep a patch.
    """
    image = ImageOps.exif_transpose(image).convert("RGB")
    long_side = max(image.size)
    target = round(size * long_side / min(image.size)) if size == SQUARE_SIZE else size
    width, height = (round(side * target / long_side) for side in image.size)
    kernel = Image.Resampling.LANCZOS if long_side > target else Image.Resampling.BICUBIC
    centre_x, centre_y = width // 2, height // 2
    if size == SQUARE_SIZE:
        half_x = half_y = min(centre_x, centre_y)
    else:
        half_x, half_y = (2 * centre // PATCH * (PATCH // 2) for centre in (centre_x, centre_y))
        if width == height:
            half_y = int(3 * half_x / 4)
    if not half_x * half_y:
        raise ValueError(f"a picture of {image.width} x {image.height} leaves no patch at size {size}")
    box = (centre_x - half_x, centre_y - half_y, centre_x + half_x, centre_y + half_y)
    pixels = np.asarray(image.resize((width, height), kernel).crop(box), dtype=np.float32)
    return torch.from_numpy(pixels).permute(2, 0, 1) / 255


def signed_rgb(images: Float[Tensor, "*batch 3 height width"]) -> Float[Tensor, "*batch 3 height width"]:
    """RGB in [0, 1] -> [-1, 1], as the encoder reads it."""
    return (images - 0.5) / 0.5


def ray_map(
    world_from_cam: Float[Tensor, "*batch 4 4"], intrinsics_px: Float[Tensor, "*batch 3 3"], height: int, width: int
) -> Float[Tensor, "*batch height width 6"]:
    """Origin and "direction" of every pixel's ray, as the network was trained with it.

    The direction is the world point at unit depth, translation included, divided by its norm. Pixels count from 0 at their centres
    here: ``intrinsics_px`` must have its origin there, half a pixel from this project's usual one.

    Args:
        world_from_cam: cameras in the first camera's frame.
        intrinsics_px: pinhole intrinsics with the first pixel centre at (0, 0).
        height: of the map.
        width: of the map.
    """
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([columns, rows, torch.ones_like(rows)], dim=-1).to(intrinsics_px).flatten(0, 1)
    points = transform_points(world_from_cam, pixels @ torch.linalg.inv(intrinsics_px).transpose(-1, -2))
    origins = world_from_cam[..., None, :3, 3].expand(points.shape)
    rays = torch.cat([origins, points / points.norm(dim=-1, keepdim=True)], dim=-1)
    return torch.unflatten(rays, -2, (height, width))
