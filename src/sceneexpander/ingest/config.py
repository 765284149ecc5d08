"""How pictures are brought to one common size."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Literal

from sceneexpander.errors import UserError
from sceneexpander.ranges import Range, check_ranges

Fit = Literal["crop", "pad"]
FITS: tuple[Fit, ...] = ("crop", "pad")


class CameraAxes(StrEnum):
    """Axes of the cameras in a ``transforms.json``: as the file says, else OpenGL's (y up, looking along -z)."""

    AUTO = "auto"
    OPENGL = "opengl"
    OPENCV = "opencv"


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
        use_intrinsics: whether calibrated lenses that came with the pictures are believed; without, pictures are not straightened.
        use_poses: whether camera poses that came with the pictures are believed.
        use_depth: whether depth maps that came with the pictures are believed.
        camera_axes: of a ``transforms.json``.
        video_fps: frames of a video looked at: of each part of one over this many seconds the sharpest frame is a candidate.
        video_frames: at most this many frames of a video are used, evenly over its length.
    """

    long_side_px: Annotated[int, Range(1, 4096)] = 336
    detail_scale: Annotated[int, Range(1, 8)] = 2
    fit: Fit = "crop"
    multiple: Annotated[int, Range(1, 256)] = 14
    max_views: Annotated[int, Range(1, 1000)] = 30
    max_megapixels: Annotated[float, Range(0, 1000, low_open=True)] = 200.0
    allow_single_view: bool = False
    use_intrinsics: bool = True
    use_poses: bool = True
    use_depth: bool = True
    camera_axes: CameraAxes = CameraAxes.AUTO
    video_fps: Annotated[float, Range(0, 120, low_open=True)] = 2.0
    video_frames: Annotated[int, Range(2, 1000)] = 24

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.long_side_px % self.multiple:
            lower = max(1, self.long_side_px // self.multiple) * self.multiple
            raise UserError(
                f"is {self.long_side_px}, which is not a multiple of {self.multiple}",
                where="ingest.long_side_px",
                fix=f"use {lower} or {lower + self.multiple}",
            )
        if self.fit not in FITS:
            raise UserError(f"is {self.fit!r}", where="ingest.fit", fix=f"use one of: {', '.join(FITS)}")
