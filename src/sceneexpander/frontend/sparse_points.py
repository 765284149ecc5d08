"""Triangulated points and where the views saw them: what the sparse front-end hands to the dense one."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class SparsePoints:
    """P points in the world frame of the poses they were triangulated with, and O observations of them.

    Observation ``o`` says: view ``view_index[o]`` saw point ``point_index[o]`` at pixel ``pixel_xy[o]`` (pixels of the given
    images, first pixel centre at 0.5). Points may have any number of observations; an empty set is valid.

    Raises:
        ValueError: lengths that do not agree, or an index out of range.
    """

    points_world: Float[Tensor, "point 3"]
    view_index: Int[Tensor, "observation"]
    point_index: Int[Tensor, "observation"]
    pixel_xy: Float[Tensor, "observation 2"]

    def __post_init__(self) -> None:
        count = self.view_index.shape[0]
        if self.point_index.shape[0] != count or tuple(self.pixel_xy.shape) != (count, 2):
            raise ValueError(
                f"{count} view indices, {self.point_index.shape[0]} point indices and pixels of shape "
                f"{tuple(self.pixel_xy.shape)} do not describe the same observations"
            )
        points = self.points_world.shape[0]
        if count and (int(self.point_index.min()) < 0 or int(self.point_index.max()) >= points):
            raise ValueError(
                f"point_index must lie in [0, {points}), is in [{self.point_index.min()}, {self.point_index.max()}]"
            )
        if count and int(self.view_index.min()) < 0:
            raise ValueError(f"view_index must not be negative, found {self.view_index.min()}")

    @classmethod
    def empty(cls) -> SparsePoints:
        """No points: what an image set without verified matches has."""
        none = torch.zeros(0, dtype=torch.long)
        return cls(points_world=torch.zeros(0, 3), view_index=none, point_index=none, pixel_xy=torch.zeros(0, 2))
