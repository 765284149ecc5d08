"""What the evaluation lets one choose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from sceneexpander.errors import UserError
from sceneexpander.ranges import OpenShare, Range, check_ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateConfig:
    """Settings of `evaluate`.

    Attributes:
        coverage_alpha: a pixel counts as covered if its alpha is above this.
        cross_view: also compare each view with what the other views' Gaussians show (one more rendering per view).
        ghosting: with ``cross_view``, also look the photos' structure up in what the other views show.
        consistency_frames: frames of the camera path on which registration, cameras, TSED and steadiness are measured; 0: not at all.
        hold_out: photos that are left out of everything and measured on; ``auto``: one of five or more.
        flip: also FLIP, where the package ``flip-evaluator`` is installed.
        cvvdp: also ColorVideoVDP, where the package ``cvvdp`` is installed.
        lpips_weights: file with the official weights of AlexNet; None: LPIPS is not measured. Never downloaded.
        st_lpips: also the perceptual distance, where the package ``stlpips-pytorch`` is installed.
    """

    coverage_alpha: OpenShare = 0.5
    cross_view: bool = True
    ghosting: bool = True
    consistency_frames: Annotated[int, Range(0, 64)] = 0
    hold_out: Annotated[int, Range(0, 1000)] | Literal["auto"] = "auto"
    flip: bool = True
    cvvdp: bool = False
    lpips_weights: str | None = None
    st_lpips: bool = True

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.lpips_weights == "":
            raise UserError("is empty", where="lpips_weights", fix="name a file, or null")
        if 0 < self.consistency_frames < 3:
            raise UserError(f"is {self.consistency_frames}, must be 0 or at least 3", where="consistency_frames")
