"""A scene at other sizes than its own: what is closed, what is dust, and what cannot be compared."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import to_bytes
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.evaluate import evaluate
from sceneexpander.evaluation.sizes import AtOtherSizes, at_sizes
from sceneexpander.evaluation.views import see_views
from sceneexpander.geometry.camera import resize_intrinsics
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.splatting import render
from tests.worlds.wall import DEPTH, HEIGHT, WIDTH, made_reconstruction, own_pictures

CONFIG = EvaluateConfig(st_lpips=False)
PIXEL = DEPTH / 40


def scene(std_px: float, *, antialiased: bool) -> Reconstruction:
    """A wall of one layer, seen by one camera."""
    made = made_reconstruction((0.0, 5.0), generated_last=False)
    own = made.gaussians.select(made.gaussians.source_view == 0)
    layer = dataclasses.replace(
        own,
        scales=torch.full_like(own.scales, std_px * PIXEL),
        opacities=torch.full_like(own.opacities, 0.99),
        antialiased=antialiased,
    )
    return dataclasses.replace(made, gaussians=layer)


def photo_of(made: Reconstruction, times: int) -> torch.Tensor:
    lens = resize_intrinsics(made.intrinsics_px[:1], times, times)
    return (
        render(made.gaussians, Cameras(made.world_from_cam[:1], lens, times * HEIGHT, times * WIDTH)).rgb[0].clamp(0, 1)
    )


def test_dust_is_found_where_the_stored_size_hides_it() -> None:
    dust = scene(0.1, antialiased=False)
    found = at_sizes(dust, 0, photo_of(dust, 1), None, CONFIG)
    assert found["half"].open_share < 0.05
    assert found["double"].open_share > 0.9
    assert found["quadruple"].open_share > 0.9


def test_a_wall_of_wide_gaussians_is_closed_at_every_size() -> None:
    wall = scene(0.8, antialiased=True)
    inside = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    inside[3:-3, 3:-3] = True  # at the border of the layer half of the neighbours are missing
    for size in at_sizes(wall, 0, photo_of(wall, 2), inside, CONFIG).values():
        assert size.open_share == 0


def test_the_photo_itself_is_what_is_compared_with() -> None:
    wall = scene(0.8, antialiased=True)
    photo = photo_of(wall, 3)
    found = at_sizes(wall, 0, photo, None, CONFIG)
    assert found["own"].psnr_db == pytest.approx(100.0)
    assert found["own"].ssim == pytest.approx(1.0)
    # A shift by one of the photo's pixels must cost.
    moved = at_sizes(wall, 0, photo.roll(1, -1), None, CONFIG, ("own",))
    assert (moved["own"].psnr_db or 0) < 45


def test_a_size_that_the_photo_has_not_is_not_compared() -> None:
    wall = scene(0.8, antialiased=True)
    found = at_sizes(wall, 0, photo_of(wall, 2), None, CONFIG)
    assert found["double"].psnr_db is not None
    assert found["quadruple"].psnr_db is None
    assert found["quadruple"].ssim is None


def test_pixels_that_show_nothing_of_the_place_are_not_open() -> None:
    wall = scene(0.8, antialiased=True)
    half_wall = dataclasses.replace(wall, gaussians=wall.gaussians.select(wall.gaussians.means[:, 0] > 0))
    shown = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    shown[4:-4, WIDTH // 2 + 4 : -4] = True
    assert at_sizes(half_wall, 0, photo_of(wall, 1), shown, CONFIG)["own"].open_share == 0
    assert at_sizes(half_wall, 0, photo_of(wall, 1), None, CONFIG)["own"].open_share > 0.4


def test_a_photo_of_the_stored_size_has_the_same_numbers_measured_once_or_again() -> None:
    made = made_reconstruction()
    views = own_pictures(made)
    views = dataclasses.replace(views, images=(views.images * 0.9 + 0.02), detail_images=(views.images * 0.9 + 0.02))
    for view in see_views(made, views, CONFIG):
        again = at_sizes(made, view.index, view.photo, view.valid, CONFIG, ("own",))["own"]
        as_stored = dataclasses.replace(view, picture=view.photo)
        named = "at_picture_size" if view.generated else "at_photo_size"
        once = AtOtherSizes().of_view(as_stored)
        assert once[f"psnr_{named}_db"] == again.psnr_db
        assert once[f"ssim_{named}"] == again.ssim
        assert once[f"seen_through_{named}"] == again.open_share
        # Another picture than the photo says nothing about the photo.
        other = dataclasses.replace(view, picture=view.photo * 0.5)
        assert AtOtherSizes().of_view(other)[f"psnr_{named}_db"] == again.psnr_db


def test_rows_hold_the_means_over_captured_views() -> None:
    made = made_reconstruction()
    views = own_pictures(made)
    finer = torch.nn.functional.interpolate(views.images, scale_factor=2, mode="bicubic").clamp(0, 1)
    views = dataclasses.replace(views, photos=tuple(to_bytes(finer)))
    row = evaluate(made, views, CONFIG, scene="s", round_number=1, seed=0)
    own = [view.values["psnr_at_photo_size_db"] for view in row.views if not view.generated]
    assert len(own) == 2
    assert row.values["psnr_at_photo_size_db"] == pytest.approx(sum(own) / 2)
    assert 0 <= row.values["seen_through_at_photo_size"] < 1
    assert "psnr_at_picture_size_db" in row.values
