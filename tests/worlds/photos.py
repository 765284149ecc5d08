"""Folders of photos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image


def texture(seed: int, height: int = 180, width: int = 240, cells: int = 24) -> Image.Image:
    """A picture with structure of several sizes, another one for each seed."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width, 3))
    for count in (4, 9, cells):
        coarse = Image.fromarray(rng.integers(0, 255, (count, count + 3, 3), dtype=np.uint8))
        total += np.asarray(coarse.resize((width, height), Image.Resampling.BICUBIC), dtype=np.float64) / 3
    return Image.fromarray(total.astype(np.uint8))


def photos(folder: Path, count: int = 3, suffix: str = ".jpg") -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{k}{suffix}" for k in range(count)]
    for seed, path in enumerate(paths):
        texture(seed).save(path, quality=95)
    return paths
