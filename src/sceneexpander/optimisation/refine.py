"""A short fit of a reconstruction's Gaussians to its own pictures: what the splats of a feed-forward model lack to agree with each other.

Such a model makes every view's Gaussians by themselves. Each set shows its own picture, but where several share a pixel, their colours
and opacities do not add up to any of the pictures. Under a hundred steps of the rasteriser settle most of that, at the captured cameras
and between them (docs/refinement.md). Cameras, depth and normals stay as the model made them, and no Gaussian comes or goes: longer
optimisation with densification is `sceneexpander.optimisation.optimise`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.geometry.randomness import child_generator
from sceneexpander.geometry.rigid import rigid_inverse
from sceneexpander.optimisation.config import RatesConfig, RefineConfig
from sceneexpander.optimisation.optimise import photometric_loss, scene_extent
from sceneexpander.optimisation.splats import Splats
from sceneexpander.splatting import rasterise

_LAST_RATE = 0.05  # of the first, reached along a cosine


@dataclass(frozen=True, slots=True, kw_only=True)
class RefineReport:
    """Mean photometric loss over the target views before and after; the old Gaussians are kept if it did not fall."""

    steps: int
    before: float
    after: float

    @property
    def accepted(self) -> bool:
        """Whether the new Gaussians were kept."""
        return self.after < self.before


def refine(
    start: Reconstruction,
    images: Float[Tensor, "view 3 height width"],
    config: RefineConfig,
    *,
    weights: Float[Tensor, "view height width"] | None = None,
    seed: int,
    device: torch.device | str = "cpu",
    on_step: Callable[[int, float], None] | None = None,
) -> tuple[Reconstruction, RefineReport | None]:
    """Fit means, shapes, opacities and colours of ``start``'s Gaussians to the pictures of its posed views, on black.

    On a CPU the same input gives the same bits, for any number of threads of the rasteriser.

    Args:
        start: cameras and Gaussians.
        images: pictures of its views, in order, RGB in [0, 1], at its size.
        config: settings; without visits the start is returned.
        weights: of pixels, in [0, 1]: how much a picture is to be believed there; 1 everywhere by default.
        seed: order of the views.
        device: where to work.
        on_step: told the number of finished steps and the last loss.

    Returns:
        The reconstruction with other Gaussians, and what the fit changed (None: nothing to do).

    Raises:
        ValueError: sizes do not fit.
    """
    if images.shape[2:] != start.depth.shape[1:] or (weights is not None and weights.shape != start.depth.shape):
        raise ValueError(f"pictures of {tuple(images.shape)} do not fit depths of {tuple(start.depth.shape)}")
    targets = [
        view for view in start.posed.nonzero()[:, 0].tolist() if weights is None or bool((weights[view] > 0).any())
    ]
    steps = config.visits * len(targets)
    if steps == 0 or len(start.gaussians) == 0:
        return start, None
    fit = _Fit(start, images, config, weights, torch.device(device))
    before = fit.mean_loss(targets)
    for step in range(steps):
        turn, place = divmod(step, len(targets))
        order = torch.randperm(len(targets), generator=child_generator(seed, f"refine/{turn}"))
        loss = fit.step(targets[int(order[place])], step / steps)
        if on_step is not None:
            on_step(step + 1, loss)
    report = RefineReport(steps=steps, before=before, after=fit.mean_loss(targets))
    return (replace(start, gaussians=fit.splats.gaussians()) if report.accepted else start), report


class _Fit:
    """The Gaussians as they move."""

    def __init__(
        self,
        start: Reconstruction,
        images: Float[Tensor, "view 3 height width"],
        config: RefineConfig,
        weights: Float[Tensor, "view height width"] | None,
        device: torch.device,
    ) -> None:
        self._images = images.to(device)
        self._weights = None if weights is None else weights.to(device)
        self._cam_from_world = rigid_inverse(start.world_from_cam).to(device)
        self._intrinsics_px = start.intrinsics_px.to(device)
        self._ssim_weight = config.ssim_weight
        rates = RatesConfig(
            means=config.means,
            scales=config.scales,
            rotations=config.rotations,
            opacities=config.opacities,
            colours=config.colours,
        )
        self._degree = math.isqrt(start.gaussians.sh.shape[1]) - 1
        self.splats = Splats.of(start.gaussians.to(device), rates, extent=scene_extent(start), sh_degree=self._degree)
        self._rates = {name: o.param_groups[0]["lr"] for name, o in self.splats.optimisers.items()}

    def step(self, view: int, progress: float) -> float:
        """One view, one update; ``progress`` in [0, 1) says how far the rates have fallen."""
        share = max(0.5 * (1 + math.cos(math.pi * progress)), _LAST_RATE)
        for name, optimiser in self.splats.optimisers.items():
            optimiser.param_groups[0]["lr"] = self._rates[name] * share
        loss = self._loss(view)
        loss.backward()  # type: ignore[no-untyped-call]
        self.splats.step()
        return float(loss.detach())

    @torch.no_grad()
    def mean_loss(self, views: list[int]) -> float:
        """Of several views."""
        return float(torch.stack([self._loss(view) for view in views]).mean())

    def _loss(self, view: int) -> Float[Tensor, ""]:
        splats, one = self.splats, slice(view, view + 1)
        height, width = self._images.shape[2:]
        seen = rasterise(
            splats.params["means"],
            splats.params["quats"],
            splats.scales,
            splats.opacities,
            splats.colours(self._degree),
            self._cam_from_world[one],
            self._intrinsics_px[one],
            height,
            width,
            with_depth=False,
        )
        weights = None if self._weights is None else self._weights[view]
        return photometric_loss(seen.rgb[0], self._images[view], self._ssim_weight, weights)
