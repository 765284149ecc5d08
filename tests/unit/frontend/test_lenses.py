"""Which views share a lens, what their files say, and what follows for the intrinsics to begin with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from sceneexpander.frontend.lenses import LensPlan, ViewOptics
from sceneexpander.frontend.sfm_setup import KnownCameras, known_cameras, prepare
from sceneexpander.frontend.sfm_types import FocalSource, SfmConfig

HEIGHT, WIDTH = 252, 336


def covering(height: int, width: int, **facts: object) -> ViewOptics:
    """A photo that was scaled until it covers the frame, the rest cut off evenly."""
    scale = max(HEIGHT / height, WIDTH / width)
    left, top = (WIDTH - width * scale) / 2, (HEIGHT - height * scale) / 2
    return ViewOptics(
        original_size=(height, width),
        image_from_original=((scale, 0.0, left), (0.0, scale, top)),
        **facts,  # type: ignore[arg-type]
    )


def plan_of(*optics: ViewOptics, known: torch.Tensor | None = None, hint: float | None = None) -> LensPlan:
    images = torch.zeros(len(optics), 3, HEIGHT, WIDTH)
    setup = prepare(images, None, SfmConfig(), torch.Generator().manual_seed(0), None)
    cameras: KnownCameras = known_cameras(setup, known, None)
    return LensPlan.make(SfmConfig(), setup, cameras, optics, hint)


LEVEL, TURNED = covering(3000, 4000), covering(4000, 3000)


def test_a_camera_held_level_and_turned_has_one_focal_in_original_pixels() -> None:
    plan = plan_of(LEVEL, TURNED, LEVEL)
    assert plan.lens_of.tolist() == [0, 0, 0]
    stored = plan.intrinsics(0.75)
    for view, optics in enumerate((LEVEL, TURNED, LEVEL)):
        scale = optics.image_from_original[0][0]
        assert stored[view, 0, 0] / scale == pytest.approx(0.75 * 4000)
        assert stored[view, 1, 1] == pytest.approx(stored[view, 0, 0])
    assert stored[1, 0, 0] > 1.3 * stored[0, 0, 0], "a turned photo is enlarged to cover the frame"


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (covering(3000, 4000), covering(1500, 2000)),  # sent smaller
        (covering(3000, 4000), covering(2100, 2800)),  # cropped
        (covering(3000, 4000, lens="phone 26 mm"), covering(3000, 4000, lens="phone 77 mm")),
        (covering(3000, 4000), covering(3000, 4000, generated=True)),
        (covering(3000, 4000, generated=True), covering(3000, 4000, generated=True)),
    ],
)
def test_photos_that_need_not_be_of_one_lens_are_not_held_to_one(one: ViewOptics, other: ViewOptics) -> None:
    plan = plan_of(one, one if not one.generated else LEVEL, other)
    assert plan.lens_of[2] != plan.lens_of[0]


def test_the_lens_of_most_photos_leads_and_others_begin_where_it_is_likely() -> None:
    small = covering(1500, 2000)
    plan = plan_of(small, LEVEL, LEVEL)
    assert plan.main == 1
    same_view, same_pixels = plan.guesses(0, 0.8)
    assert same_view == pytest.approx(0.8)
    assert same_pixels == pytest.approx(1.6), "if it was cut out, its focal in pixels is that of the whole"
    assert plan.intrinsics(0.8)[0, 0, 0] == pytest.approx(0.8 * WIDTH)


def test_a_part_of_a_picture_can_have_its_centre_as_far_off_as_was_cut_away() -> None:
    plan = plan_of(LEVEL, LEVEL, covering(2100, 2800), covering(4000, 5000), covering(3000, 4000, generated=True))
    crop = plan.crop_of_main(2)
    assert crop is not None
    assert crop == pytest.approx((1200 / 2 / 2800, 900 / 2 / 2800), abs=0.011)
    assert plan.crop_of_main(0) is None
    assert plan.crop_of_main(3) is None, "larger than the others"
    assert plan.crop_of_main(4) is None


def test_files_that_say_a_focal_are_believed_first_and_outvoted_at_a_price() -> None:
    said = replace(LEVEL, focal_px=3200.0)
    plan = plan_of(said, said, said, said)
    assert plan.source is FocalSource.HINT
    assert plan.starts[0].ratio == pytest.approx(0.8)
    assert plan.starts[0].penalty == 0
    others = plan.starts[1:]
    assert others
    assert all(start.penalty > 0 and start.source is None for start in others)
    assert min(abs(np.log(start.ratio / 0.8)) for start in others) > 0.05, "near ones would be the same start"


def test_a_second_lens_is_scaled_by_what_both_files_say() -> None:
    wide, tele = replace(LEVEL, focal_px=3000.0, lens="a"), replace(LEVEL, focal_px=9000.0, lens="b")
    plan = plan_of(wide, wide, tele)
    assert plan.guesses(2, 0.7)[0] == pytest.approx(0.7 * 3)


def test_few_photos_choose_among_usual_focals_only() -> None:
    ratios = [start.ratio for start in plan_of(LEVEL, LEVEL).starts]
    assert min(ratios) > 0.5
    assert max(ratios) < 1.4
    assert max(start.ratio for start in plan_of(*[LEVEL] * 5).starts) > 2


def test_given_intrinsics_are_kept() -> None:
    known = torch.eye(3).repeat(2, 1, 1)
    known[:, 0, 0] = known[:, 1, 1] = 300.0
    known[:, 0, 2], known[:, 1, 2] = 150.0, 120.0
    plan = plan_of(LEVEL, TURNED, known=known)
    assert plan.source is FocalSource.KNOWN
    np.testing.assert_allclose(plan.intrinsics(9.9), known.numpy())
