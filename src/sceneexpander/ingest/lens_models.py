"""Cameras as capture software describes them: intrinsics in the original's pixels and, where the lens bends lines, how."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import cv2
import numpy as np
from jaxtyping import Float, Float32

from sceneexpander.errors import UserError
from sceneexpander.ingest.samples import Mask, Pixels

_SAME_ASPECT = 0.01  # pictures were scaled if both sides changed by the same factor, rounding apart
_LARGEST = 1e6  # focal lengths and principal points beyond it are no pixels
_MOST_DISTORTION = 1e3


class Projection(StrEnum):
    """What ``distortion`` means: OpenCV's pinhole or fisheye model, or COLMAP's THIN_PRISM_FISHEYE (ETH3D)."""

    PINHOLE = "pinhole"  # k1, k2, p1, p2, k3, k4, k5, k6
    FISHEYE = "fisheye"  # k1, k2, k3, k4
    THIN_PRISM_FISHEYE = "thin_prism_fisheye"  # k1, k2, p1, p2, k3, k4, sx1, sy1


_COEFFICIENTS = {
    Projection.PINHOLE: (0, 4, 5, 8),
    Projection.FISHEYE: (4,),
    Projection.THIN_PRISM_FISHEYE: (8,),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Lens:
    """A calibrated camera. Pixels of the original, origin at the top-left corner of its top-left pixel.

    Attributes:
        focal_px: (fx, fy).
        centre_px: (cx, cy), the principal point.
        size: (height, width) of the pictures that it was calibrated on; None if that is not said.
        distortion: coefficients in the order of `Projection`; empty if straight lines stay straight.
        projection: the model that ``distortion`` belongs to.
    """

    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    size: tuple[int, int] | None = None
    distortion: tuple[float, ...] = ()
    projection: Projection = Projection.PINHOLE

    def __post_init__(self) -> None:
        values = (*self.focal_px, *self.centre_px)
        if not all(np.isfinite(values)) or min(self.focal_px) <= 0 or max(map(abs, values)) > _LARGEST:
            raise UserError(
                f"has the focal lengths {self.focal_px} and the principal point {self.centre_px}, no camera"
            )
        if len(self.distortion) not in _COEFFICIENTS[self.projection]:
            raise UserError(f"has {len(self.distortion)} distortion coefficients for the model {self.projection}")
        if not all(np.isfinite(self.distortion)) or any(abs(k) > _MOST_DISTORTION for k in self.distortion):
            raise UserError(f"has the distortion {self.distortion}, no lens")

    @property
    def bends(self) -> bool:
        """Whether pictures have to be straightened for a pinhole camera."""
        return self.projection is not Projection.PINHOLE or any(self.distortion)

    @property
    def intrinsics(self) -> Float[np.ndarray, "3 3"]:
        """The pinhole camera of the straightened pictures."""
        matrix = np.eye(3)
        matrix[[0, 1], [0, 1]], matrix[:2, 2] = self.focal_px, self.centre_px
        return matrix

    def of_size(self, size: tuple[int, int]) -> Lens | None:
        """The camera of the same pictures scaled to ``size`` (height, width); None if these cannot be the same pictures."""
        if self.size is None or self.size == size:
            return replace(self, size=size)
        down, along = size[0] / self.size[0], size[1] / self.size[1]
        # Half a pixel of rounding on the shorter side is what scaling may have cost.
        if abs(down / along - 1) > _SAME_ASPECT + 1.0 / min(size):
            return None
        return replace(
            self,
            focal_px=(self.focal_px[0] * along, self.focal_px[1] * down),
            centre_px=(self.centre_px[0] * along, self.centre_px[1] * down),
            size=size,
        )

    def distorted(self, xy: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "point 2"]:
        """Pixels of the pinhole camera `intrinsics` as the lens shows them."""
        plane = (np.asarray(xy, np.float64) - self.centre_px) / self.focal_px
        return self._bent(plane) * self.focal_px + self.centre_px

    def _bent(self, plane: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "point 2"]:
        """Normalised image coordinates of a pinhole camera as the lens has them."""
        if self.projection is Projection.PINHOLE:
            k1, k2, p1, p2, k3, k4, k5, k6 = (*self.distortion, *(0.0,) * 8)[:8]
            square = (plane**2).sum(1)
            gain = (1 + square * (k1 + square * (k2 + square * k3))) / (1 + square * (k4 + square * (k5 + square * k6)))
            return plane * gain[:, None] + _tangential(plane, p1, p2)
        radius = np.linalg.norm(plane, axis=1)
        angle = np.arctan(radius)
        equidistant = plane * np.where(radius > 1e-9, angle / np.maximum(radius, 1e-9), 1.0)[:, None]
        square = (equidistant**2).sum(1)
        if self.projection is Projection.FISHEYE:
            k1, k2, k3, k4 = self.distortion
            return equidistant * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))[:, None]
        k1, k2, p1, p2, k3, k4, sx1, sy1 = self.distortion
        gain = 1 + square * (k1 + square * (k2 + square * (k3 + square * k4)))
        prism = np.stack([sx1 * square, sy1 * square], 1)
        return equidistant * gain[:, None] + _tangential(equidistant, p1, p2) + prism

    def straightening(self, height: int, width: int) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
        """Per pixel of the pinhole picture where it lies in the original, x and y, in OpenCV's pixels (centres at whole numbers)."""
        x, y = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
        columns = np.arange(width) + 0.5
        step = max(1, 2**20 // width)  # rows at a time: bounds memory for large pictures
        for top in range(0, height, step):
            rows = np.arange(top, min(height, top + step)) + 0.5
            grid = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
            source = self.distorted(grid).reshape(len(rows), width, 2) - 0.5
            x[top : top + step], y[top : top + step] = source[..., 0], source[..., 1]
        return x, y


def _tangential(plane: Float[np.ndarray, "point 2"], p1: float, p2: float) -> Float[np.ndarray, "point 2"]:
    x, y = plane[:, 0], plane[:, 1]
    square = x * x + y * y
    return np.stack([2 * p1 * x * y + p2 * (square + 2 * x * x), p1 * (square + 2 * y * y) + 2 * p2 * x * y], 1)


def straighten_picture(pixels: Pixels, valid: Mask | None, lens: Lens) -> tuple[Pixels, Mask | None]:
    """(pixels as the lens's pinhole camera shows them, which of these show something; None: all), in the original's size."""
    height, width = pixels.shape[:2]
    x, y = lens.straightening(height, width)
    made = cv2.remap(pixels, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    seen = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
    if valid is not None:
        seen &= cv2.remap(valid.astype(np.uint8), x, y, cv2.INTER_NEAREST) > 0
    return np.ascontiguousarray(made), None if bool(seen.all()) else seen
