"""Exposures: what photos differ in by their exposure is theirs, and not painted onto the scene."""

from __future__ import annotations

from dataclasses import replace

import torch

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.evaluation.image import psnr
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import rgb_from_sh, sh_from_rgb
from sceneexpander.photometric.config import RefineConfig
from sceneexpander.photometric.exposure import Exposures
from sceneexpander.photometric.refine import refine
from sceneexpander.splatting import render
from tests.worlds.spoiled import TRUTH, VIEWS, spoiled

CONFIG = RefineConfig(visits=10, colours=0.1, colour_prior=0.0)  # fast colours and free: the start is grey
IMAGES = VIEWS.images
GAIN = torch.tensor([1.2, 1 / 1.2, 1.0])[:, None, None, None]  # of two photos; the third picture is generated


def shown(reconstruction: Reconstruction, view: int) -> float:
    """PSNR of one view's picture."""
    one = slice(view, view + 1)
    camera = Cameras(TRUTH.world_from_cam[one], TRUTH.intrinsics_px[one], *IMAGES.shape[2:])
    return psnr(render(reconstruction.gaussians, camera).rgb[0], IMAGES[view])


def test_photos_of_other_exposures_teach_the_scene_of_the_middle_one() -> None:
    pictures = (IMAGES * GAIN).clamp(0, 1)
    exposed, _ = refine(spoiled(), pictures, replace(CONFIG, exposures=1e-2), seed=0)
    painted, _ = refine(spoiled(), pictures, replace(CONFIG, exposures=0.0), seed=0)
    for view in (0, 1):
        assert shown(exposed, view) > shown(painted, view) + 0.5


def test_they_are_relative_to_the_photos_mean() -> None:
    exposures = Exposures(3, [0, 1], rate=1e-2, device=torch.device("cpu"))
    picture = torch.full((3, 4, 4), 0.5)
    for _ in range(5):
        ((exposures.applied(picture, 0) - 0.6).square().mean() + exposures.penalty()).backward()
        exposures.step(1.0)
    brighter, darker = exposures.applied(picture, 0), exposures.applied(picture, 1)
    assert (brighter > picture).all()
    assert (darker < picture).all()
    assert torch.equal(exposures.applied(picture, 2), picture)


def test_a_single_photo_has_none() -> None:
    exposures = Exposures(1, [0], rate=1e-2, device=torch.device("cpu"))
    picture = torch.full((3, 4, 4), 0.5)
    (exposures.applied(picture, 0) - 0.6).square().mean().backward()
    exposures.step(1.0)
    torch.testing.assert_close(exposures.applied(picture, 0), picture)


def test_colours_of_gaussians_are_exposed_as_the_photos_they_were_made_from() -> None:
    exposures = Exposures(3, [0, 1], rate=1e-2, device=torch.device("cpu"))
    for _ in range(5):
        (exposures.applied(torch.full((3, 4, 4), 0.5), 0) - 0.6).square().mean().backward()
        exposures.step(1.0)
    colours = torch.rand(6, 3, generator=torch.Generator().manual_seed(0), requires_grad=True)
    views = torch.tensor([2, 0, 1, 1, 0, 2])
    found = exposures.applied_to_each(colours, views)
    for colour, view, applied in zip(colours, views.tolist(), found, strict=True):
        torch.testing.assert_close(applied, exposures.applied(colour[:, None, None], view)[:, 0, 0])
    assert float(found[1].detach().mean()) > float(colours[1].detach().mean())
    without = Exposures(3, [0, 1], rate=0.0, device=torch.device("cpu"))
    assert torch.equal(without.applied_to_each(colours, views), colours)


def test_a_price_on_changed_colours_does_not_hold_on_to_exposures() -> None:
    first, second = (TRUTH.gaussians.source_view[:, None] == view for view in (0, 1))
    gain = torch.where(first, GAIN[0, 0, 0, 0], torch.where(second, GAIN[1, 0, 0, 0], 1.0))
    colours = sh_from_rgb(gain * rgb_from_sh(TRUTH.gaussians.sh[:, 0]))
    start = replace(TRUTH, gaussians=replace(TRUTH.gaussians, sh=colours[:, None]))
    pictures = (IMAGES * GAIN).clamp(0, 1)
    config = RefineConfig(visits=16, exposures=3e-2)
    free, _ = refine(start, pictures, replace(config, colour_prior=0.0), seed=0)
    priced, _ = refine(start, pictures, config, seed=0)
    for view in (0, 1):
        assert shown(priced, view) > shown(free, view) - 0.5
