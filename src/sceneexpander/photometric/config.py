"""Settings of the fits to pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from sceneexpander.ranges import LearningRate, OpenShare, Range, Rate, Share, Steps, Weight, check_ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class WarmupConfig:
    """How long and how strongly to fit the captured views before anything is inserted."""

    steps: Steps = 0  # 0: off
    learning_rate: LearningRate = 2e-4
    held_out: OpenShare = 0.25  # share of the cells that the loss never sees
    cell_px: Annotated[int, Range(1, 4096)] = 16
    others_weight: Weight = 1.0  # weight of the rendering without the view's own Gaussians
    min_alpha: Share = 0.5  # pixels of that rendering count where the other views cover them at least this much

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class HeadConfig:
    """How long and how strongly the Gaussian head alone is trained on the captured photos, after Algorithm 1."""

    steps: Steps = 0  # 0: off
    learning_rate: LearningRate = 3e-3
    others_weight: Weight = 0.5  # weight of the same photos without the view's own Gaussians

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class RefineConfig:
    """How long and how fast the short fit (`refine`) is. Rates are Adam's; that of the means is in units of the scene's extent."""

    visits: Steps = 8  # steps per view: a view more takes nothing from the others; 0: Gaussians stay as made
    means: Rate = 1e-3
    scales: Rate = 5e-2
    rotations: Rate = 3e-3
    opacities: Rate = 0.3
    colours: Rate = 3e-2
    exposures: Rate = 1e-2  # of each photo's gains and offsets; 0: photos are taken to be exposed alike
    ssim_weight: Share = 0.2  # of 1 - SSIM beside the mean absolute error
    solid_weight: Weight = 0.2  # of the light that passes through what a picture shows
    colour_prior: Weight = (
        20.0  # of the mean squared distance of colours from the model's, each as its own photo was exposed
    )

    def __post_init__(self) -> None:
        check_ranges(self)
