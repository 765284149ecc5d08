"""The short fit: better pictures of the same scene, the same bits each time, and nothing believed that must not be."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch

from sceneexpander.errors import UserError
from sceneexpander.evaluation.image import psnr
from sceneexpander.optimisation.config import RefineConfig
from sceneexpander.optimisation.optimise import photometric_loss
from sceneexpander.optimisation.refine import refine
from sceneexpander.splatting import render
from tests.unit.optimisation.test_optimise import TRUTH, VIEWS, spoiled

CONFIG = RefineConfig(visits=20, colours=0.1)  # fast colours: the start is grey
IMAGES = VIEWS.images


def shown(reconstruction: object, view: int) -> float:
    """PSNR of one view's picture."""
    gaussians, one = reconstruction.gaussians, slice(view, view + 1)  # type: ignore[attr-defined]
    seen = render(gaussians, TRUTH.world_from_cam[one], TRUTH.intrinsics_px[one], *IMAGES.shape[2:])
    return psnr(seen.rgb[0], IMAGES[view])


def test_every_picture_gets_better_and_only_the_gaussians_change() -> None:
    start = spoiled()
    result, report = refine(start, IMAGES, CONFIG, seed=0)
    assert report is not None
    assert report.accepted
    assert report.after < 0.5 * report.before
    for view in range(len(IMAGES)):
        assert shown(result, view) > shown(start, view) + 3
    for field in fields(start):
        if field.name != "gaussians":
            assert getattr(result, field.name) is getattr(start, field.name)
    for name in ("source_view", "generated"):
        assert torch.equal(getattr(result.gaussians, name), getattr(start.gaussians, name))


def test_same_seed_same_bits() -> None:
    one, _ = refine(spoiled(), IMAGES, replace(CONFIG, visits=2), seed=1)
    two, _ = refine(spoiled(), IMAGES, replace(CONFIG, visits=2), seed=1)
    other, _ = refine(spoiled(), IMAGES, replace(CONFIG, visits=2), seed=2)
    assert torch.equal(one.gaussians.sh, two.gaussians.sh)
    assert torch.equal(one.gaussians.means, two.gaussians.means)
    assert not torch.equal(one.gaussians.sh, other.gaussians.sh)


def test_every_view_gets_its_visits_however_many_there_are() -> None:
    posed = TRUTH.posed.clone()
    posed[2] = False
    for start in (spoiled(), replace(spoiled(), posed=posed)):
        _, report = refine(start, IMAGES, replace(CONFIG, visits=3), seed=0)
        assert report is not None
        assert report.steps == 3 * int(start.posed.sum())


def test_without_visits_it_is_the_start_itself() -> None:
    start = spoiled()
    assert refine(start, IMAGES, RefineConfig(), seed=0) == (start, None)


def test_what_makes_it_worse_is_taken_back() -> None:
    wild = RefineConfig(visits=1, means=100.0, scales=5.0)
    result, report = refine(TRUTH, IMAGES, wild, seed=0)
    assert report is not None
    assert not report.accepted
    assert result is TRUTH


def test_pixels_without_weight_and_views_without_a_pose_teach_nothing() -> None:
    misleading = IMAGES.clone()
    misleading[2] = 1 - misleading[2]
    weights = torch.ones(TRUTH.depth.shape)
    weights[2] = 0
    start = spoiled()
    weighted, _ = refine(start, misleading, CONFIG, weights=weights, seed=0)
    posed = TRUTH.posed.clone()
    posed[2] = False
    unposed, _ = refine(replace(start, posed=posed), misleading, CONFIG, seed=0)
    believed, _ = refine(start, misleading, CONFIG, seed=0)
    for result in (weighted, unposed):
        assert shown(result, 2) > shown(start, 2)
        assert shown(result, 0) > shown(believed, 0) + 1


def test_weights_of_one_are_no_weights_and_half_of_them_half_the_loss() -> None:
    image, reference = IMAGES[0], IMAGES[1]
    whole = photometric_loss(image, reference, 0.2)
    ones = torch.ones(image.shape[1:])
    torch.testing.assert_close(photometric_loss(image, reference, 0.2, ones), whole)
    torch.testing.assert_close(photometric_loss(image, reference, 0.2, ones / 2), whole / 2)


def test_bad_settings_are_named() -> None:
    with pytest.raises(UserError, match="visits"):
        RefineConfig(visits=-1)
    with pytest.raises(UserError, match="colours"):
        RefineConfig(colours=-1.0)
    with pytest.raises(ValueError, match="do not fit"):
        refine(TRUTH, IMAGES[..., :-1], CONFIG, seed=0)
