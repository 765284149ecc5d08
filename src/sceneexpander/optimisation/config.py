"""Settings of the per-scene optimisation; learning rates and densification follow the published 3DGS and 3DGS-MCMC recipes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from sceneexpander.errors import UserError

StrategyName = Literal["default", "mcmc"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RatesConfig:
    """Adam's learning rates. ``means`` is in units of the scene's extent and falls to ``means_final`` geometrically."""

    means: float = 1.6e-4
    means_final: float = 1.6e-6
    scales: float = 5e-3
    rotations: float = 1e-3
    opacities: float = 5e-2
    colours: float = 2.5e-3
    view_colours: float = 1.25e-4  # of the coefficients that depend on the direction
    poses: float = 0.0  # of the cameras, rotation in radians and translation in extents; falls like that of the means; 0: cameras stay


@dataclass(frozen=True, slots=True, kw_only=True)
class DensityConfig:
    """How the set of Gaussians changes: ``default`` clones, splits and prunes; ``mcmc`` moves dead ones and adds noise.

    Between the shares ``start`` and ``stop`` of the steps, every ``every`` steps. On CUDA the strategies are gsplat's.
    """

    strategy: StrategyName = "default"
    start: float = 0.0167
    stop: float = 0.5
    every: int = 100
    max_gaussians: int = 1_000_000
    min_opacity: float = 0.005  # below it a Gaussian is dead
    gradient: float = (
        2e-4  # default: of the projected centre, half images per unit loss; above it the place is too coarse
    )
    split_above: float = 0.01  # default: extents; larger Gaussians are split, smaller ones cloned
    prune_above: float = 0.1  # default: extents; larger Gaussians go after the first reset
    reset_every: int = 3000  # default: steps; 0: opacities are never reset
    growth: float = 0.05  # mcmc: share of new Gaussians each time
    noise: float = 5e5  # mcmc: times the learning rate of the means
    opacity_weight: float = 0.01  # mcmc: of the mean opacity in the loss
    scale_weight: float = 0.01  # mcmc: of the mean standard deviation in the loss

    def __post_init__(self) -> None:
        if not 0 <= self.start <= self.stop <= 1:
            raise UserError(f"needs 0 <= start <= stop <= 1, is {self.start}, {self.stop}", where="start")
        if self.every < 1 or self.max_gaussians < 1:
            raise UserError("every and max_gaussians must be at least 1", where="every")
        if not 0 < self.min_opacity < 1:
            raise UserError(f"must be within (0, 1), is {self.min_opacity}", where="min_opacity")


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimiseConfig:
    """One optimisation. Views take turns in random order, one per step."""

    steps: int = 7000  # a quarter of what 3DGS takes for hundreds of views
    repeats: int = 1  # runs with different seeds; with more than one, tables show mean and spread
    start_gaussians: int = 1_000_000  # at most so many of the reconstruction's are kept, drawn at random and enlarged
    sh_degree: int = 3  # of the colours; rises by one each thirtieth of the steps
    ssim_weight: float = 0.2  # of 1 - SSIM beside the mean absolute error
    checkpoint_every: int = 200  # steps
    rates: RatesConfig = field(default_factory=RatesConfig)
    density: DensityConfig = field(default_factory=DensityConfig)

    def __post_init__(self) -> None:
        for name in ("steps", "repeats", "start_gaussians", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise UserError(f"must be at least 1, is {getattr(self, name)}", where=name)
        if not 0 <= self.sh_degree <= 3:
            raise UserError(f"must be 0 to 3, is {self.sh_degree}", where="sh_degree")
        if not 0 <= self.ssim_weight <= 1:
            raise UserError(f"must be within [0, 1], is {self.ssim_weight}", where="ssim_weight")
