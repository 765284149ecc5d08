"""What the evaluation lets one choose."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.ranges import OpenShare, check_ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateConfig:
    """Settings of `evaluate`.

    Attributes:
        coverage_alpha: a pixel counts as covered if its alpha is above this.
        cross_view: also compare each view with what the other views' Gaussians show (one more rendering per view).
        st_lpips: also the perceptual distance, where the package ``stlpips-pytorch`` is installed.
    """

    coverage_alpha: OpenShare = 0.5
    cross_view: bool = True
    st_lpips: bool = True

    def __post_init__(self) -> None:
        check_ranges(self)
