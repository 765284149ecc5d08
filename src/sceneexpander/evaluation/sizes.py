"""How a reconstruction holds when its pictures are drawn at other sizes than the one it was made from.

A splat scene can show its photos perfectly at one size and be dust at every other: Gaussians narrower than a pixel are widened by the
rasteriser's blur there, and leave gaps as soon as the same pixel becomes four. People look at scenes in windows of any size.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.catalogue.metrics import metrics_named
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.image import WINDOW
from sceneexpander.evaluation.likeness import compare_pictures
from sceneexpander.evaluation.measure import Measure, SeenView, Values
from sceneexpander.geometry.camera import resize_intrinsics
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.splatting import render

OPEN_ALPHA = 0.9  # below it one looks through a surface
_TIMES = {"half": 0.5, "double": 2.0, "quadruple": 4.0}
# Of each size the end of its metrics' names.
_CAPTURED = {
    "own": "at_photo_size",
    "half": "captured_half_size",
    "double": "captured_double_size",
    "quadruple": "captured_quadruple_size",
}
_INSERTED = {"own": "at_picture_size"}
SIZES = tuple(_CAPTURED)


@dataclass(frozen=True, slots=True, kw_only=True)
class SizeMetrics:
    """What a camera sees of the reconstruction when its picture is drawn at another size than the stored one, against the photo.

    ``open_share`` is the share of pixels that show something in the photo and where the reconstruction's alpha is below 0.9: one looks
    through it. The others compare with the photo brought to that size; None where it has not that many pixels. ST-LPIPS, by far the
    dearest, is measured at the photo's own size only.
    """

    open_share: float
    psnr_db: float | None = None
    ssim: float | None = None
    st_lpips: float | None = None


@torch.no_grad()
def at_sizes(
    reconstruction: Reconstruction,
    index: int,
    photo: Float[Tensor, "3 photo_height photo_width"],
    valid: Bool[Tensor, "height width"] | None,
    config: EvaluateConfig,
    names: tuple[str, ...] = SIZES,
) -> dict[str, SizeMetrics]:
    """One view of a reconstruction at sizes by name (`SIZES`), on black. Sizes too small to compare are left out.

    Args:
        reconstruction: what is drawn.
        index: of the view in it.
        photo: the view's picture in its own pixels.
        valid: stored pixels that show the place; None: all.
        config: settings.
        names: of the sizes.
    """
    stored = tuple(int(side) for side in reconstruction.depth.shape[1:])
    found = {}
    for name in names:
        size = (int(photo.shape[1]), int(photo.shape[2])) if name == "own" else _times(stored, _TIMES[name])
        if min(size) >= WINDOW:
            perceptual = config.st_lpips and name == "own"
            found[name] = _at_size(reconstruction, index, photo, valid, size, perceptual=perceptual)
    return found


def _times(stored: tuple[int, ...], factor: float) -> tuple[int, int]:
    height, width = stored
    return round(height * factor), round(width * factor)


def _at_size(
    reconstruction: Reconstruction,
    index: int,
    photo: Float[Tensor, "3 photo_height photo_width"],
    valid: Bool[Tensor, "height width"] | None,
    size: tuple[int, int],
    *,
    perceptual: bool,
) -> SizeMetrics:
    stored_height, stored_width = reconstruction.depth.shape[1:]
    height, width = size
    lens = resize_intrinsics(reconstruction.intrinsics_px[index], width / stored_width, height / stored_height)
    seen = render(
        reconstruction.gaussians, Cameras(reconstruction.world_from_cam[index][None], lens[None], height, width)
    )
    shown = None
    if valid is not None:
        shown = functional.interpolate(valid[None, None].to(photo), size=size, mode="nearest")[0, 0] > 0
    through = seen.alpha[0] < OPEN_ALPHA
    open_share = float((through if shown is None else through[shown]).double().mean())
    if height > photo.shape[1] or width > photo.shape[2]:
        return SizeMetrics(open_share=open_share)
    wanted = photo
    if size != tuple(photo.shape[1:]):
        wanted = functional.interpolate(photo[None], size=size, mode="bicubic", antialias=True)[0].clamp(0, 1)
    like = compare_pictures(seen.rgb[0], wanted, shown, perceptual=perceptual)
    return SizeMetrics(open_share=open_share, psnr_db=like.psnr_db, ssim=like.ssim, st_lpips=like.st_lpips)


def _as_stored(view: SeenView) -> SizeMetrics | None:
    """The numbers at the photo's own size if the photo is the stored picture: they are those of the stored size."""
    if view.photo.shape != view.picture.shape or not torch.equal(view.photo, view.picture):
        return None
    through, like = view.render.alpha[0] < OPEN_ALPHA, view.likeness
    return SizeMetrics(
        open_share=float((through if view.valid is None else through[view.valid]).double().mean()),
        psnr_db=like.psnr_db,
        ssim=like.ssim,
        st_lpips=like.st_lpips,
    )


class AtOtherSizes(Measure):
    """Captured views at the photo's own size and at multiples of the stored one, the inserted view at its picture's own."""

    metrics = metrics_named(
        *(
            name.format(where)
            for where in (*_CAPTURED.values(), *_INSERTED.values())
            for name in ("psnr_{}_db", "ssim_{}", "seen_through_{}")
        ),
        *(f"st_lpips_{names['own']}" for names in (_CAPTURED, _INSERTED)),
    )

    def of_view(self, view: SeenView) -> Values:
        """The numbers of every size that is large enough."""
        names = _INSERTED if view.generated else _CAPTURED
        known = {} if (stored := _as_stored(view)) is None else {"own": stored}
        left = tuple(name for name in names if name not in known)
        found = known | at_sizes(view.reconstruction, view.index, view.photo, view.valid, view.config, left)
        values: dict[str, float | None] = {}
        for size, measured in found.items():
            where = names[size]
            values[f"psnr_{where}_db"] = measured.psnr_db
            values[f"ssim_{where}"] = measured.ssim
            if size == "own":
                values[f"st_lpips_{where}"] = measured.st_lpips
            values[f"seen_through_{where}"] = measured.open_share
        return values
