"""How alike a render and a picture of one size are: the three numbers that every size is reported with."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.evaluation.image import psnr, ssim
from sceneexpander.evaluation.perceptual import st_lpips

PSNR_CAP_DB = 100.0  # equal pictures would be infinite, and means of them nothing
_LEAST_SIDE_PX = 28  # smaller pictures vanish inside the network of ST-LPIPS


@dataclass(frozen=True, slots=True, kw_only=True)
class Likeness:
    """PSNR (capped), SSIM, and ST-LPIPS where it was asked for and can be had."""

    psnr_db: float
    ssim: float
    st_lpips: float | None


def compare_pictures(
    shown: Float[Tensor, "3 height width"],
    wanted: Float[Tensor, "3 height width"],
    valid: Bool[Tensor, "height width"] | None,
    *,
    perceptual: bool,
) -> Likeness:
    """Compare a render with a picture.

    Args:
        shown: the render on black.
        wanted: the picture.
        valid: pixels that count; None: all. The others are black on both sides for ST-LPIPS.
        perceptual: also ST-LPIPS, by far the dearest.

    Raises:
        ValueError: sizes differ, values are not finite, or too few pixels count.
    """
    distance = None
    if perceptual and min(wanted.shape[1:]) >= _LEAST_SIDE_PX:
        counted = 1.0 if valid is None else valid
        distance = st_lpips(shown * counted, wanted * counted)
    return Likeness(
        psnr_db=min(psnr(shown, wanted, valid), PSNR_CAP_DB), ssim=ssim(shown, wanted, valid), st_lpips=distance
    )
