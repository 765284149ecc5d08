"""Radial lens distortion as a map between the pixels of pictures as taken and those of a pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

_ITERATIONS = 12  # of the inversion; six reach double precision for all but fisheye lenses
_LEAST_SLOPE = 0.1  # where distortion would fold the picture over, it is followed no further


@dataclass(frozen=True, slots=True, kw_only=True)
class Distortion:
    """Per view ``x_d = x (1 + k1 r^2 + k2 r^4)`` in coordinates normalised by ``intrinsics`` (which both pictures share)."""

    intrinsics: Float[np.ndarray, "view 3 3"]
    k: Float[np.ndarray, "view 2"]

    def distorted(self, view: int, xy: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "point 2"]:
        """Pixels of a pinhole camera as the lens shows them."""
        focal, centre = self.intrinsics[view, [0, 1], [0, 1]], self.intrinsics[view, :2, 2]
        plane = (xy - centre) / focal
        radius2 = (plane**2).sum(-1, keepdims=True)
        return plane * (1 + radius2 * (self.k[view, 0] + radius2 * self.k[view, 1])) * focal + centre

    def undistorted(self, view: int, xy: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "point 2"]:
        """Pixels as the lens shows them where a pinhole camera has them."""
        if len(xy) == 0 or not self.k[view].any():
            return xy
        focal, centre = self.intrinsics[view, [0, 1], [0, 1]], self.intrinsics[view, :2, 2]
        k1, k2 = self.k[view]
        bent = (xy - centre) / focal
        target = np.linalg.norm(bent, axis=1)
        radius = target.copy()
        for _ in range(
            _ITERATIONS
        ):  # Newton on r (1 + k1 r^2 + k2 r^4) = r_d; the slope stays positive inside the frame
            square = radius**2
            excess = radius * (1 + square * (k1 + square * k2)) - target
            slope = np.maximum(1 + square * (3 * k1 + 5 * square * k2), _LEAST_SLOPE)
            radius = np.maximum(radius - excess / slope, 0.0)
        gain = np.where(target > 0, radius / np.maximum(target, 1e-12), 1.0)
        return bent * gain[:, None] * focal + centre

    def distorted_tracks(self, pixel_xy: Float[np.ndarray, "track view 2"]) -> Float[np.ndarray, "track view 2"]:
        """All views' pixels as their lenses show them."""
        return np.stack([self.distorted(view, pixel_xy[:, view]) for view in range(len(self.k))], 1)

    def coefficients_at(self, view: int, intrinsics: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 2"]:
        """(k1, k2) that bend pixels alike at another focal."""
        ratio = float(intrinsics[0, 0] / self.intrinsics[view, 0, 0])
        return self.k[view] * np.array([ratio**2, ratio**4])

    def scaled(self, scale_xy: Float[np.ndarray, " 2"]) -> Distortion:
        """The same for pictures whose pixels are ``scale_xy`` as many."""
        return Distortion(intrinsics=self.intrinsics * np.array([*scale_xy, 1.0])[:, None], k=self.k)

    def straightened(
        self, images: Float[Tensor, "view channel height width"]
    ) -> tuple[Float[Tensor, "view channel height width"], Bool[Tensor, "view height width"]]:
        """(pictures of a pinhole camera, where the originals have something to show there), bilinear, as ``intrinsics`` frame them.

        A barrel's corners fall outside the frame; a cushion's frame is not filled at its border.
        """
        height, width = images.shape[-2:]
        made, seen = images.clone(), torch.ones((len(images), height, width), dtype=torch.bool)
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        grid = np.stack([columns.ravel(), rows.ravel()], 1)
        for view in np.flatnonzero(self.k.any(1)):
            source = self.distorted(int(view), grid).reshape(height, width, 2)
            x, y = (source[..., axis].astype(np.float32) - np.float32(0.5) for axis in (0, 1))
            picture = np.ascontiguousarray(images[view].permute(1, 2, 0).cpu().numpy())
            warped = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            made[view] = torch.from_numpy(warped.reshape(height, width, -1)).permute(2, 0, 1)
            inside = (source >= 0).all(-1) & (source[..., 0] <= width) & (source[..., 1] <= height)
            seen[view] = torch.from_numpy(inside)
        return made, seen
