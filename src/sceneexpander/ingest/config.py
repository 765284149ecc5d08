"""How pictures are brought to one common size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sceneexpander.errors import UserError

Fit = Literal["crop", "pad"]
FITS: tuple[Fit, ...] = ("crop", "pad")
# Beyond these a stage would only run out of memory: no reconstructor takes more.
_LARGEST = {"long_side_px": 4200, "detail_scale": 8, "multiple": 512, "max_views": 1000, "max_megapixels": 1000.0}


@dataclass(frozen=True, slots=True, kw_only=True)
class IngestConfig:
    """Settings of `load_scene` and `load_photos`.

    Attributes:
        long_side_px: long side of the stored images; a multiple of ``multiple``.
        detail_scale: detail images are this many times the stored size, or less if no original has that many pixels.
        fit: ``crop`` scales a picture until it covers the common frame and cuts the rest off evenly; ``pad`` keeps all of it and
            fills the border with neutral grey.
        multiple: both stored sides are multiples of this (the patch size of the reconstructors).
        max_views: more captured views than this are refused: memory and time grow with their number.
        max_megapixels: larger pictures are refused before they are decoded, as are files of few bytes that announce many pixels.
        allow_single_view: accept a scene of one photo.
    """

    long_side_px: int = 336
    detail_scale: int = 2
    fit: Fit = "crop"
    multiple: int = 14
    max_views: int = 30
    max_megapixels: float = 200.0
    allow_single_view: bool = False

    def __post_init__(self) -> None:
        for name, largest in _LARGEST.items():
            value = getattr(self, name)
            if not 0 < value <= largest:
                problem = f"must be positive, is {value}" if not value > 0 else f"is {value}, more than {largest:g}"
                raise UserError(problem, where=f"ingest.{name}", fix=f"use at most {largest:g}")
        if self.long_side_px % self.multiple:
            lower = max(1, self.long_side_px // self.multiple) * self.multiple
            raise UserError(
                f"is {self.long_side_px}, which is not a multiple of {self.multiple}",
                where="ingest.long_side_px",
                fix=f"use {lower} or {lower + self.multiple}",
            )
        if self.fit not in FITS:
            raise UserError(f"is {self.fit!r}", where="ingest.fit", fix=f"use one of: {', '.join(FITS)}")
