"""Exposure of the inserted picture against a world whose cameras and light are known."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.insertion.colour import LARGEST_GAIN, Tone, match_tone
from sceneexpander.synthetic import SyntheticViews, make_views
from sceneexpander.synthetic.degrade import encode_radiance

VIEWS = 3
GENERATED = torch.tensor([False] * VIEWS + [True])


@pytest.fixture(scope="module")
def views() -> SyntheticViews:
    return make_views(11, views=VIEWS + 1, height=84, width=112, kind="room", degrade=False, split="test")


def cameras_of(views: SyntheticViews) -> Cameras:
    return Cameras(views.world_from_cam, views.intrinsics_px, *views.images.shape[2:])


def matched(views: SyntheticViews, images: torch.Tensor, generated: torch.Tensor = GENERATED) -> Tone | None:
    depth = torch.where(views.valid, views.depth, views.depth[views.valid].max())
    return match_tone(images, depth, cameras_of(views), generated=generated, view=VIEWS)


def recoloured(views: SyntheticViews, gains: tuple[float, float, float]) -> torch.Tensor:
    images = views.images.clone()
    images[VIEWS] = (images[VIEWS] * torch.tensor(gains)[:, None, None]).clamp(0, 1)
    return images


def test_the_gains_undo_exposure_and_white_balance(views: SyntheticViews) -> None:
    already = matched(views, views.images)
    changed = matched(views, recoloured(views, (1.25, 1.1, 0.9)))
    assert already is not None
    assert changed is not None
    # The views themselves agree to about a per cent; what was put in comes out on top of that.
    assert all(abs(gain - 1) < 0.03 for gain in already.gains)
    for gain, own, put_in in zip(changed.gains, already.gains, (1.25, 1.1, 0.9), strict=True):
        assert gain / own == pytest.approx(1 / put_in, rel=0.02)


def test_an_exposure_in_linear_light_is_undone_on_the_stored_picture() -> None:
    """Cameras change linear light; pictures are stored with the sRGB curve, which is nearly a power law."""
    light = torch.linspace(0.03, 0.6, 50).expand(1, 3, 50, 50).movedim(1, -1).numpy()
    brighter = torch.from_numpy(encode_radiance(light * 1.4, 1.0)).movedim(-1, 1)
    plain = torch.from_numpy(encode_radiance(light, 1.0)).movedim(-1, 1)
    gain = float((plain / brighter).median())
    corrected = Tone(gains=(gain, gain, gain), pairs=1).applied(brighter)
    assert float((brighter - plain).abs().mean()) > 0.06
    assert float((corrected - plain).abs().max()) < 0.02


def test_a_third_of_wrong_content_hardly_moves_it(views: SyntheticViews) -> None:
    images = recoloured(views, (1.2, 1.2, 1.2))
    images[VIEWS, :, :, :37] = torch.rand(3, 84, 37, generator=torch.Generator().manual_seed(0))
    found = matched(views, images)
    assert found is not None
    assert all(gain == pytest.approx(1 / 1.2, rel=0.06) for gain in found.gains)


def test_generated_views_and_strangers_have_no_say(views: SyntheticViews) -> None:
    images = recoloured(views, (1.2, 1.2, 1.2))
    images[0] *= 0.5
    alone = matched(views, images, torch.tensor([True, False, False, True]))
    assert alone is not None
    assert all(gain == pytest.approx(1 / 1.2, rel=0.04) for gain in alone.gains)
    assert matched(views, images, torch.ones(VIEWS + 1, dtype=torch.bool)) is None
    away = views.world_from_cam.clone()
    away[VIEWS, :3, 3] += 100.0
    cameras = replace(cameras_of(views), world_from_cam=away)
    depth = torch.where(views.valid, views.depth, views.depth[views.valid].max())
    assert match_tone(images, depth, cameras, generated=GENERATED, view=VIEWS) is None


def test_another_scene_is_not_taken_for_another_exposure(views: SyntheticViews) -> None:
    found = matched(views, recoloured(views, (0.4, 0.4, 0.4)))  # would take a gain of 2.5
    assert found is not None
    assert found.gains == pytest.approx((LARGEST_GAIN,) * 3)


def test_what_is_clipped_to_white_stays_white() -> None:
    image = torch.tensor([0.5, 0.85, 0.95, 1.0]).expand(3, 1, 4)
    darker = Tone(gains=(0.7, 0.8, 0.9), pairs=1).applied(image)
    torch.testing.assert_close(darker[:, 0, :2], image[:, 0, :2] * torch.tensor([0.7, 0.8, 0.9])[:, None])
    assert torch.equal(darker[:, 0, 3], torch.ones(3))
    assert (darker.diff(dim=-1) > 0).all(), "brighter stays brighter"
    brighter = Tone(gains=(1.2, 1.2, 1.2), pairs=1).applied(image)
    torch.testing.assert_close(brighter, (1.2 * image).clamp(max=1))


def test_a_photo_without_a_camera_has_no_say(views: SyntheticViews) -> None:
    images = recoloured(views, (1.2, 1.2, 1.2))
    images[0] *= 0.5
    depth = torch.where(views.valid, views.depth, views.depth[views.valid].max())
    cameras = cameras_of(views)

    def gains(posed: list[bool]) -> Tone | None:
        return match_tone(images, depth, cameras, generated=GENERATED, posed=torch.tensor(posed), view=VIEWS)

    found = gains([False, True, True, True])
    assert found is not None
    assert all(gain == pytest.approx(1 / 1.2, rel=0.04) for gain in found.gains)
    assert gains([True, True, True, False]) is None
    assert gains([False, False, False, True]) is None
