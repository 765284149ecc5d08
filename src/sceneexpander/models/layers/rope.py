"""Two-dimensional rotary position embedding (worldmirror spec 4.2).

A head of width d is split in two halves: the first is rotated by the row, the second by the column. Within a half of length
D = d/2, channel j pairs with channel j + D/2 and turns by ``position * base**(-2j/D)``. Position 0 is the identity.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor


@dataclass(frozen=True, slots=True)
class RopeTable:
    """Cosines and sines of the rotation of each token: axis 1 is (row, column), axis 2 the frequencies."""

    cos: Float[Tensor, "token 2 quarter"]
    sin: Float[Tensor, "token 2 quarter"]

    def repeat(self, views: int) -> RopeTable:
        """The table of ``views`` identical token sequences, one after the other."""
        return RopeTable(self.cos.repeat(views, 1, 1), self.sin.repeat(views, 1, 1))

    def first(self, count: int) -> RopeTable:
        """The table of the first ``count`` tokens."""
        return RopeTable(self.cos[:count], self.sin[:count])


def grid_positions(rows: int, columns: int, *, specials: int, origin: int = 0) -> NDArray[np.int32]:
    """(row, column) of every token: ``specials`` tokens at (origin, origin), then the grid, row-major, from origin + 1 on."""
    grid = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), axis=-1).reshape(-1, 2) + 1
    return np.concatenate([np.zeros((specials, 2), dtype=np.int32), grid.astype(np.int32)]) + np.int32(origin)


def rope_angles(positions: Int[np.ndarray, "token 2"], head_dim: int, base: float) -> NDArray[np.float32]:
    """Rotation angles in radians, (token, 2, head_dim / 4), in float32 as the released models compute them."""
    if head_dim % 4:
        raise ValueError(f"2D rotary embedding needs a head width divisible by 4, got {head_dim}")
    half = head_dim // 2
    exponents = np.arange(0, half, 2, dtype=np.float32) / np.float32(half)
    frequencies = (np.float32(1.0) / np.float32(base) ** exponents).astype(np.float32)
    return positions.astype(np.float32)[:, :, None] * frequencies


@lru_cache(maxsize=64)
def _grid_cos_sin(
    rows: int, columns: int, specials: int, origin: int, head_dim: int, base: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    angles = rope_angles(grid_positions(rows, columns, specials=specials, origin=origin), head_dim, base)
    return np.cos(angles), np.sin(angles)


def grid_rope(
    rows: int, columns: int, *, specials: int, head_dim: int, base: float, like: Tensor, origin: int = 0
) -> RopeTable:
    """Table of one view at the positions of `grid_positions`. Device follows ``like``; always float32.

    The numbers are cached as numpy arrays, not tensors: tensors made in inference mode or under a fake-tensor mode must not
    leak into a later training step.
    """
    cos, sin = _grid_cos_sin(rows, columns, specials, origin, head_dim, base)
    return RopeTable(torch.tensor(cos, device=like.device), torch.tensor(sin, device=like.device))


def apply_rope(
    heads: Float[Tensor, "batch token head width"], table: RopeTable, *, half: bool = False
) -> Float[Tensor, "batch token head width"]:
    """Rotate queries or keys; the dtype is kept. ``half`` rounds what goes in and what comes out to float16."""
    if half:
        return apply_rope(heads.half().float(), table).half().to(heads.dtype)
    halves = torch.unflatten(heads, -1, (2, 2, heads.shape[-1] // 4))
    first, second = halves[..., 0, :], halves[..., 1, :]
    cos = table.cos[:, None].to(heads.dtype)
    sin = table.sin[:, None].to(heads.dtype)
    turned = torch.stack([first * cos - second * sin, second * cos + first * sin], dim=-2)
    return turned.flatten(-3)
