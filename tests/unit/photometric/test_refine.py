"""The short fit: better pictures of the same scene, the same bits each time, and nothing believed that must not be."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch
from torch.nn import functional

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import to_bytes
from sceneexpander.errors import UserError
from sceneexpander.evaluation.image import psnr
from sceneexpander.geometry.camera import resize_intrinsics
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.geometry.sampling import BAND_LIMIT_PX, finest_pixel
from sceneexpander.optimisation.optimise import photometric_loss
from sceneexpander.photometric.config import RefineConfig
from sceneexpander.photometric.refine import refine
from sceneexpander.splatting import render
from tests.worlds.spoiled import TRUTH, VIEWS, spoiled
from tests.worlds.wall import made_reconstruction, own_pictures

CONFIG = RefineConfig(visits=20, colours=0.1, colour_prior=0.0)  # fast colours and free: the start is grey
IMAGES = VIEWS.images


def shown(reconstruction: object, view: int) -> float:
    """PSNR of one view's picture."""
    gaussians, one = reconstruction.gaussians, slice(view, view + 1)  # type: ignore[attr-defined]
    seen = render(gaussians, Cameras(TRUTH.world_from_cam[one], TRUTH.intrinsics_px[one], *IMAGES.shape[2:]))
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
    assert refine(start, IMAGES, RefineConfig(visits=0), seed=0) == (start, None)


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


def test_dark_surfaces_become_solid_and_not_transparent() -> None:
    faint = replace(TRUTH, gaussians=replace(TRUTH.gaussians, opacities=0.5 * TRUTH.gaussians.opacities))
    result, report = refine(faint, 0 * IMAGES, replace(CONFIG, visits=30), seed=0)
    assert report is not None
    assert report.accepted
    seen = render(result.gaussians, Cameras(TRUTH.world_from_cam, TRUTH.intrinsics_px, *IMAGES.shape[2:]))
    # Against a black background a picture without anything in it would be as good.
    assert float((seen.alpha[:, 3:-3, 3:-3] > 0.9).double().mean()) > 0.99
    assert float(seen.rgb.mean()) < 0.05


def test_nothing_gets_narrower_than_the_finest_view_resolves() -> None:
    dust = replace(TRUTH, gaussians=replace(TRUTH.gaussians, scales=0.05 * TRUTH.gaussians.scales))
    photos = [to_bytes(functional.interpolate(image[None], scale_factor=2)[0]) for image in IMAGES]
    height, width = IMAGES.shape[2:]
    for given, cameras in ((None, TRUTH.cameras), (photos, TRUTH.cameras.resized(2 * height, 2 * width))):
        result, report = refine(dust, IMAGES, replace(CONFIG, visits=12, colours=0.01), photos=given, seed=0)
        assert report is not None
        assert report.accepted
        pixel = finest_pixel(dust.gaussians.means, [cameras])
        assert bool((result.gaussians.scales >= 0.999 * BAND_LIMIT_PX * pixel[:, None]).all())
        assert result.gaussians.antialiased


def test_what_only_the_photos_show_is_fitted() -> None:
    height, width = IMAGES.shape[2:]
    fine = functional.interpolate(IMAGES, scale_factor=2, mode="bilinear")
    # Stripes that are even grey at the stored size.
    fine = (fine + 0.3 * ((torch.arange(2 * width) + 1) // 2 % 2 * 2 - 1)).clamp(0, 1)
    stored = functional.avg_pool2d(fine, 2)
    photos = [to_bytes(image) for image in fine]
    lens = resize_intrinsics(TRUTH.intrinsics_px, 2, 2)

    def own(gaussians: Gaussians) -> float:
        seen = render(gaussians, Cameras(TRUTH.world_from_cam[:1], lens[:1], 2 * height, 2 * width))
        return psnr(seen.rgb[0], fine[0])

    without, _ = refine(spoiled(), stored, CONFIG, seed=0)
    given, _ = refine(spoiled(), stored, CONFIG, photos=photos, seed=0)
    assert own(given.gaussians) > own(without.gaussians) + 0.3


def test_what_photos_do_not_agree_in_is_not_learnt_by_heart() -> None:
    whole = made_reconstruction((0.0, 0.3, 0.15), generated_last=False)
    posed = whole.posed.clone()
    posed[2] = False
    gaussians = whole.gaussians
    start = replace(whole, gaussians=gaussians.select(gaussians.source_view != 2), posed=posed)
    truth = own_pictures(whole).images
    # What a photo has for itself: here noise, in real ones mostly detail whose depth is wrong.
    photos = truth + 0.15 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(0))

    def held_out(result: Reconstruction) -> float:
        seen = render(result.gaussians, Cameras(whole.world_from_cam[2:], whole.intrinsics_px[2:], *truth.shape[2:]))
        return psnr(seen.rgb[0], truth[2])

    kept, _ = refine(start, photos, RefineConfig(visits=16), seed=0)
    free, _ = refine(start, photos, RefineConfig(visits=16, colour_prior=0.0), seed=0)
    assert held_out(kept) > held_out(free) + 2


def test_a_photo_is_shown_by_the_gaussians_of_the_others() -> None:
    whole = made_reconstruction((0.0, 0.1), generated_last=False)
    images, gaussians = own_pictures(whole).images, whole.gaussians
    # The second photo's are grey and lie behind those of the first, which show both photos almost: all at once, only these learn.
    behind = (gaussians.source_view == 1)[:, None]
    start = replace(
        whole,
        gaussians=replace(
            gaussians,
            means=gaussians.means + 0.2 * behind * torch.tensor([0.0, 0.0, 1.0]),
            sh=0.8 * gaussians.sh * ~behind[:, None],
            opacities=torch.full_like(gaussians.opacities, 0.99),
        ),
    )

    def shown_by_second(result: Reconstruction) -> float:
        others = result.gaussians.select(result.gaussians.source_view == 1)
        seen = render(others, Cameras(whole.world_from_cam[:1], whole.intrinsics_px[:1], *images.shape[2:]))
        return psnr(seen.rgb[0] / seen.alpha[0].clamp(min=0.5), images[0], seen.alpha[0] > 0.5)

    result, _ = refine(start, images, CONFIG, seed=0)
    assert shown_by_second(result) > shown_by_second(start) + 6
