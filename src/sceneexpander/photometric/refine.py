"""A short fit of a reconstruction's Gaussians to its own pictures: what the splats of a feed-forward model lack to agree with each other.

Such a model makes every view's Gaussians by themselves. Each set shows its own picture, but where several share a pixel, their colours
and opacities do not add up to any of the pictures. A few visits to every view settle most of that, at the captured cameras and between
them (docs/refinement.md). The pictures are taken at several sizes, that of the photos included, before a background of another colour each
time, and no Gaussian gets narrower than what its finest view resolves: so the scene holds at other distances, too. What photos differ in
by their exposure is left to them (`Exposures`). Cameras, depth and normals stay as the model made them, and no Gaussian comes or goes:
longer optimisation with densification is `sceneexpander.optimisation.optimise`.

Two things keep it from learning the photos by heart, which costs places seen from elsewhere. Where Gaussians overlap, a picture is a
mixture of their colours, and a fit that is free undoes the mixture: colours add up to the photo from its own camera, and only there. So a
colour has a price for its distance from the model's. And in one visit of four a photo has to be shown by the Gaussians of the others, as
any new picture has to be.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.geometry.gaussians import rgb_from_sh
from sceneexpander.geometry.randomness import child_generator
from sceneexpander.geometry.rigid import rigid_inverse
from sceneexpander.optimisation.config import RatesConfig
from sceneexpander.optimisation.optimise import photometric_loss, scene_extent
from sceneexpander.optimisation.pictures import Picture, Pictures
from sceneexpander.optimisation.splats import Splats
from sceneexpander.photometric.config import RefineConfig
from sceneexpander.photometric.exposure import Exposures
from sceneexpander.photometric.report import FitReport
from sceneexpander.splatting import RasterSettings, rasterise

_LAST_RATE = 0.05  # of the first, reached along a cosine
_TURNS = 4  # after so many visits the sizes come again
_OTHERS_TURN = 3  # of these: the view's own Gaussians stay away
_COVERED = 0.5  # alpha from which on a pixel of that counts
_COMPENSATED = RasterSettings(antialiased=True)


def refine(
    start: Reconstruction,
    images: Float[Tensor, "view 3 height width"],
    config: RefineConfig,
    *,
    photos: Sequence[UInt8[Tensor, "3 photo_height photo_width"]] | None = None,
    weights: Float[Tensor, "view height width"] | None = None,
    seed: int,
    device: torch.device | str = "cpu",
    on_step: Callable[[int, float], None] | None = None,
) -> tuple[Reconstruction, FitReport | None]:
    """Fit means, shapes, opacities and colours of ``start``'s Gaussians to the pictures of its posed views.

    On a CPU the same input gives the same bits, for any number of threads of the rasteriser.

    Args:
        start: cameras and Gaussians.
        images: pictures of its views, in order, RGB in [0, 1], at its size.
        config: settings; without visits the start is returned.
        photos: the same pictures in the photos' own pixels; None: nothing finer is known.
        weights: of pixels, in [0, 1]: how much a picture is to be believed there; 1 everywhere by default.
        seed: order of the views and backgrounds.
        device: where to work.
        on_step: told the number of finished steps and the last loss.

    Returns:
        The reconstruction with other Gaussians, meant for rasterisers that compensate for the screen blur (the old ones if the loss did
        not fall), and the mean photometric loss over the target views, as their photos show them (None: nothing to do).

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
    pictures = Pictures(images, photos, start.intrinsics_px, weights, torch.device(device))
    fit = _Fit(start, pictures, config, targets, torch.device(device))
    before = fit.mean_loss(targets)
    for step in range(steps):
        turn, place = divmod(step, len(targets))
        order = torch.randperm(len(targets), generator=child_generator(seed, f"refine/{turn}"))
        background = torch.rand(3, generator=child_generator(seed, f"refine/background/{step}"))
        loss = fit.step(targets[int(order[place])], turn, background, step / steps)
        if on_step is not None:
            on_step(step + 1, loss)
    report = FitReport(steps=steps, before=before, after=fit.mean_loss(targets))
    return (replace(start, gaussians=fit.splats.gaussians()) if report.accepted else start), report


class _Fit:
    """The Gaussians as they move."""

    def __init__(
        self,
        start: Reconstruction,
        pictures: Pictures,
        config: RefineConfig,
        targets: list[int],
        device: torch.device,
    ) -> None:
        self._pictures = pictures
        world_from_cam = start.world_from_cam.to(device)
        self._cam_from_world = rigid_inverse(world_from_cam)
        self._ssim_weight, self._solid = config.ssim_weight, config.solid_weight
        # A generated picture is brought to the photos' colours before (`corrections.colour`), and is no measurement of an exposure.
        photos = [view for view in targets if not bool(start.generated[view])]
        self._exposures = Exposures(len(start.view_ids), photos, rate=config.exposures, device=device)
        rates = RatesConfig(
            means=config.means,
            scales=config.scales,
            rotations=config.rotations,
            opacities=config.opacities,
            colours=config.colours,
        )
        gaussians = pictures.compensated(start.gaussians.to(device), world_from_cam)
        self._degree = math.isqrt(gaussians.sh.shape[1]) - 1
        self.splats = Splats.of(
            gaussians,
            rates,
            extent=scene_extent(start),
            sh_degree=self._degree,
            finest=pictures.finest_pixel(gaussians.means, world_from_cam, targets),
        )
        self._rates = {name: o.param_groups[0]["lr"] for name, o in self.splats.optimisers.items()}
        self._colour_prior = config.colour_prior
        self._first_colours = self._colours().detach().clone()

    def step(self, view: int, turn: int, background: Float[Tensor, "3"], progress: float) -> float:
        """One view, one update: its visit number ``turn``; ``progress`` in [0, 1) says how far the rates have fallen."""
        size = turn % _TURNS
        picture = (self._pictures.own, self._pictures.stored, self._pictures.own, self._pictures.half)[size](view)
        share = max(0.5 * (1 + math.cos(math.pi * progress)), _LAST_RATE)
        for name, optimiser in self.splats.optimisers.items():
            optimiser.param_groups[0]["lr"] = self._rates[name] * share
        others = self.splats.params["source_view"] != view if size == _OTHERS_TURN else None
        if others is not None and bool(others.any()):
            loss = self._loss_of_others(view, picture, others)
        else:
            loss = self._loss(view, picture, background)
        (loss + self._exposures.penalty() + self._distance_from_model()).backward()  # type: ignore[no-untyped-call]
        self.splats.step()
        self._exposures.step(share)
        return float(loss.detach())

    @torch.no_grad()
    def mean_loss(self, views: list[int]) -> float:
        """Of several views, on grey."""
        grey = torch.full((3,), 0.5)
        return float(torch.stack([self._loss(view, self._pictures.own(view), grey) for view in views]).mean())

    def _loss(self, view: int, picture: Picture, background: Float[Tensor, "3"]) -> Float[Tensor, ""]:
        rgb, alpha = self._seen(view, picture, self.splats.opacities, background)
        through = 1 - alpha
        if picture.weights is not None:
            through = through * picture.weights
        return self._photometric(view, rgb, picture.rgb, picture.weights) + self._solid * through.mean()

    def _loss_of_others(self, view: int, picture: Picture, others: Bool[Tensor, " gaussian"]) -> Float[Tensor, ""]:
        """Of what the other views' Gaussians show of a picture, where they cover it: what they leave open is not theirs to close."""
        opacities = self.splats.opacities * others
        rgb, alpha = self._seen(view, picture, opacities, torch.zeros(3))
        weights = (alpha.detach() > _COVERED).to(rgb)
        if picture.weights is not None:
            weights = weights * picture.weights
        # The colour of what is there, not of the black behind it.
        return self._photometric(view, rgb / alpha.clamp(min=_COVERED), picture.rgb, weights)

    def _seen(
        self, view: int, picture: Picture, opacities: Float[Tensor, " gaussian"], background: Float[Tensor, "3"]
    ) -> tuple[Float[Tensor, "3 height width"], Float[Tensor, "height width"]]:
        """Colours before a background, and alpha, at the size of a picture."""
        splats = self.splats
        seen = rasterise(
            splats.params["means"],
            splats.params["quats"],
            splats.scales,
            opacities,
            splats.colours(self._degree),
            self._cam_from_world[view : view + 1],
            picture.intrinsics_px[None],
            picture.height,
            picture.width,
            background=background.to(picture.rgb),
            with_depth=False,
            settings=_COMPENSATED,
        )
        return seen.rgb[0], seen.alpha[0]

    def _photometric(
        self,
        view: int,
        rgb: Float[Tensor, "3 height width"],
        picture: Float[Tensor, "3 height width"],
        weights: Float[Tensor, "height width"] | None,
    ) -> Float[Tensor, ""]:
        return photometric_loss(self._exposures.applied(rgb, view), picture, self._ssim_weight, weights)

    def _colours(self) -> Float[Tensor, "gaussian 3"]:
        return rgb_from_sh(self.splats.params["sh0"][:, 0])

    def _distance_from_model(self) -> Float[Tensor, ""]:
        """Price of colours that are not the model's any more.

        The model took its colours from photos of different exposures, and the scene has their mean: each is compared as its own photo would
        show it.
        """
        as_taken = self._exposures.applied_to_each(self._colours(), self.splats.params["source_view"])
        return self._colour_prior * (as_taken - self._first_colours).square().mean()
