"""Settings of the per-scene optimisation; learning rates and densification follow the published 3DGS and 3DGS-MCMC recipes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from sceneexpander.errors import UserError
from sceneexpander.ranges import MAX_STEPS, OpenShare, Range, Rate, Share, Steps, Weight, check_ranges

MAX_GAUSSIANS = 50_000_000
StrategyName = Literal["default", "mcmc"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RatesConfig:
    """Adam's learning rates. ``means`` is in units of the scene's extent and falls to ``means_final`` geometrically."""

    means: Rate = 1.6e-4
    means_final: Rate = 1.6e-6
    scales: Rate = 5e-3
    rotations: Rate = 1e-3
    opacities: Rate = 5e-2
    colours: Rate = 2.5e-3
    view_colours: Rate = 1.25e-4  # of the coefficients that depend on the direction
    # of the cameras, rotation in radians and translation in extents; falls like that of the means; 0: cameras stay
    poses: Rate = 0.0

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class DensityConfig:
    """How the set of Gaussians changes: ``default`` clones, splits and prunes; ``mcmc`` moves dead ones and adds noise.

    Between the shares ``start`` and ``stop`` of the steps, every ``every`` steps. On CUDA the strategies are gsplat's.
    """

    strategy: StrategyName = "default"
    start: Share = 0.0167
    stop: Share = 0.5
    every: Annotated[int, Range(1, MAX_STEPS)] = 100
    max_gaussians: Annotated[int, Range(1, MAX_GAUSSIANS)] = 1_000_000
    min_opacity: OpenShare = 0.005  # below it a Gaussian is dead
    # default: of the projected centre, half images per unit loss; above it the place is too coarse
    gradient: Annotated[float, Range(0, 1000)] = 2e-4
    # default: extents; larger Gaussians are split, smaller ones cloned
    split_above: Annotated[float, Range(0, 1000)] = 0.01
    # default: extents; larger Gaussians go after the first reset
    prune_above: Annotated[float, Range(0, 1000, low_open=True)] = 0.1
    reset_every: Steps = 3000  # default: steps; 0: opacities are never reset
    growth: Annotated[float, Range(0, 10)] = 0.05  # mcmc: share of new Gaussians each time
    noise: Annotated[float, Range(0, 1e9)] = 5e5  # mcmc: times the learning rate of the means
    opacity_weight: Weight = 0.01  # mcmc: of the mean opacity in the loss
    scale_weight: Weight = 0.01  # mcmc: of the mean standard deviation in the loss

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.start > self.stop:
            raise UserError(f"is {self.start}, must be at most stop ({self.stop})", where="start")


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimiseConfig:
    """One optimisation. Views take turns in random order, one per step."""

    steps: Annotated[int, Range(1, MAX_STEPS)] = 7000  # a quarter of what 3DGS takes for hundreds of views
    # runs with different seeds; with more than one, tables show mean and spread
    repeats: Annotated[int, Range(1, 1000)] = 1
    # at most so many of the reconstruction's are kept, drawn at random and enlarged
    start_gaussians: Annotated[int, Range(1, MAX_GAUSSIANS)] = 1_000_000
    sh_degree: Annotated[int, Range(0, 3)] = 3  # of the colours; rises by one each thirtieth of the steps
    ssim_weight: Share = 0.2  # of 1 - SSIM beside the mean absolute error
    checkpoint_every: Annotated[int, Range(1, MAX_STEPS)] = 200  # steps
    rates: RatesConfig = field(default_factory=RatesConfig)
    density: DensityConfig = field(default_factory=DensityConfig)

    def __post_init__(self) -> None:
        check_ranges(self)
