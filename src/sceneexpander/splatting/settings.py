"""How to rasterise: everything that is not the scene or the cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Backend = Literal["auto", "cpu", "torch", "gsplat"]
BACKENDS: tuple[Backend, ...] = ("auto", "cpu", "torch", "gsplat")

MIN_ALPHA = 1.0 / 255.0  # a Gaussian is skipped where its alpha is lower
MIN_TRANSMITTANCE = 1e-4  # a pixel stops before the Gaussian that would bring it here or lower
MIN_DETERMINANT = 1e-10  # of the blurred 2-D covariance, pixels^4; degenerate Gaussians are not drawn
MIN_COMPENSATION = 0.005  # floor of the antialiased opacity factor
MIN_COVERAGE = 1e-10  # floor of alpha where a sum is turned into a mean (expected depth, shares)
JACOBIAN_MARGIN = 0.15  # of the image size: beyond it the local affine map is frozen


@dataclass(frozen=True, slots=True, kw_only=True)
class RasterSettings:
    """Numerical conventions of the image formation; the defaults agree with gsplat's development version.

    ``threads`` = 0 takes torch's thread count. The result does not depend on it, bit for bit (``cpu`` backend).
    ``band_bytes`` bounds the memory that Gaussian-tile intersections may take at once (``cpu`` and ``torch`` backends).
    """

    near: float = 0.01  # visible if z > near, scene units
    far: float = 1e10  # and z < far
    eps2d: float = 0.3  # added to the diagonal of the 2-D covariance, pixels^2
    antialiased: bool = False  # compensate opacities for that blur
    max_alpha: float = 0.99  # cap of one Gaussian's alpha (gsplat 1.5.3 has 0.999)
    backend: Backend = "auto"
    threads: int = 0
    band_bytes: int = 512 * 1024 * 1024

    def __post_init__(self) -> None:
        if not 0 < self.near < self.far:
            raise ValueError(f"RasterSettings needs 0 < near < far, got near {self.near}, far {self.far}")
        if not self.eps2d >= 0:
            raise ValueError(f"RasterSettings.eps2d must be >= 0, got {self.eps2d}")
        if not MIN_ALPHA <= self.max_alpha < 1:
            raise ValueError(f"RasterSettings.max_alpha must be in [1/255, 1), got {self.max_alpha}")
        if self.backend not in BACKENDS:
            raise ValueError(f"RasterSettings.backend must be one of {', '.join(BACKENDS)}, got {self.backend!r}")
        if self.threads < 0 or self.band_bytes < 1:
            raise ValueError(f"RasterSettings: threads {self.threads} or band_bytes {self.band_bytes} out of range")
