"""What a generated picture must be, and what is worth a warning."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.views import ViewSet
from sceneexpander.errors import UserError
from sceneexpander.ingest.decode import Picture
from sceneexpander.ingest.load import is_single_colour
from sceneexpander.ingest.panorama import panorama_reason, strip_reason

SMALLEST_SIDE_PX = 64
_COPY_CELLS = 32
_COPY_DIFFERENCE = 0.1


def check_content(picture: Picture, where: str) -> None:
    """Raise `UserError` for a picture that decodes but cannot be a view: tiny, all of one colour, a strip or a panorama."""
    if min(picture.height, picture.width) < SMALLEST_SIDE_PX:
        raise UserError(
            f"has only {picture.width} x {picture.height} pixels",
            where=where,
            fix=f"use a picture of at least {SMALLEST_SIDE_PX} px on each side",
        )
    if is_single_colour(picture.pixels):
        raise UserError("shows a single colour", where=where, fix="use a picture of the place")
    reason = strip_reason(picture.height, picture.width) or panorama_reason(
        picture.pixels, picture.xmp, has_lens=picture.lens.focal_px is not None
    )
    if reason is not None:
        raise UserError(reason, where=where)


def nearest_copy(image: Float[Tensor, "3 height width"], references: ViewSet) -> str | None:
    """Name of a reference view that ``image`` (already in the common frame) is nearly a copy of, or None.

    Compared as coarse colour thumbnails: the mean absolute difference, relative to how much the reference itself varies, so that dark
    scenes are judged like bright ones. Survives recompression and rescaling.
    """
    thumbnails = _thumbnails(torch.cat([image[None], references.images.to(image)]))
    difference = (thumbnails[1:] - thumbnails[0]).abs().mean(dim=(1, 2, 3))
    spread = (thumbnails[1:] - thumbnails[1:].mean(dim=(2, 3), keepdim=True)).abs().mean(dim=(1, 2, 3))
    relative = difference / spread.clamp(min=1e-3)
    nearest = int(relative.argmin())
    return references.records[nearest].name if float(relative[nearest]) < _COPY_DIFFERENCE else None


def _thumbnails(images: Float[Tensor, "view 3 height width"]) -> Float[Tensor, "view 3 cell cell"]:
    return torch.nn.functional.adaptive_avg_pool2d(images, _COPY_CELLS)
