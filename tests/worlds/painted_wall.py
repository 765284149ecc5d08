"""A painted wall and views of it."""

from __future__ import annotations

import numpy as np
import torch
from PIL import Image

HEIGHT, WIDTH = 120, 180


def blobs(seed: int, height: int, width: int) -> np.ndarray:
    """Soft patches of several sizes: something to match at any scale."""
    random = np.random.default_rng(seed)
    picture = np.zeros((height, width, 3))
    for cells in (6, 18, 54):
        coarse = Image.fromarray(random.integers(0, 256, (cells, cells * 3 // 2, 3), dtype=np.uint8))
        picture += np.asarray(coarse.resize((width, height), Image.Resampling.BICUBIC), dtype=np.float64) / 3
    return picture.astype(np.uint8)


WALL = blobs(0, 3 * HEIGHT, 3 * WIDTH)  # larger than any view of it


def view_of_wall(right: float, zoom: float = 1.0) -> np.ndarray:
    """What a camera sees that moved to the right, in pixels of the detail images; ``zoom`` > 1 is nearer."""
    width, height = 2 * WIDTH / zoom, 2 * HEIGHT / zoom
    left, top = (3 * WIDTH - width) / 2 + right, (3 * HEIGHT - height) / 2
    part = Image.fromarray(WALL).resize(
        (2 * WIDTH, 2 * HEIGHT), Image.Resampling.BICUBIC, box=(left, top, left + width, top + height)
    )
    return np.asarray(part)


def tensor(pixels: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(pixels.copy()).permute(2, 0, 1).float() / 255
