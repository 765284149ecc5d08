"""A view against other cameras by its matches alone, and the lenses that come of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sfm_worlds as worlds

from sceneexpander.frontend.bundle import LOG_FOCAL, SHIFT_X, SHIFT_Y, Lenses, rotation_exp
from sceneexpander.frontend.epipolar import EpipolarFit, OtherView, freedom_of, held_lens
from sceneexpander.frontend.features import Features
from sceneexpander.frontend.lens_tests import settle_lenses
from sceneexpander.frontend.mapping import CropOfMain, Mapping
from sceneexpander.frontend.matching import Matches
from sceneexpander.frontend.sfm_types import SfmConfig
from sceneexpander.frontend.twoview import PairMatches

NOISE = 0.3


def noisy(world: worlds.PointWorld, seed: int = 0) -> worlds.PointWorld:
    rng = np.random.default_rng(seed)
    return replace(world, pixel_xy=world.pixel_xy + rng.normal(0, NOISE, world.pixel_xy.shape))


def fit_of(world: worlds.PointWorld, view: int) -> EpipolarFit:
    others = [
        OtherView(
            view=other,
            rotation=world.rotations[other],
            translation=world.translations[other],
            intrinsics=world.intrinsics[other],
            own_xy=world.pixel_xy[:, other],
            view_xy=world.pixel_xy[:, view],
        )
        for other in range(len(world.rotations))
        if other != view
    ]
    return EpipolarFit(others, world.intrinsics[view], np.full(2, 768.0), noise_px=0.5)


def seen_through(
    world: worlds.PointWorld, view: int, *, zoom: float = 1.0, shift: tuple[float, float] = (0.0, 0.0)
) -> worlds.PointWorld:
    """The world with one view zoomed about its centre and its centre moved."""
    pixel_xy = world.pixel_xy.copy()
    centre = world.intrinsics[view, :2, 2]
    pixel_xy[:, view] = (pixel_xy[:, view] - centre) * zoom + centre + 768 * np.array(shift)
    return replace(world, pixel_xy=pixel_xy)


def test_sampson_distance_is_the_distance_from_the_line() -> None:
    world = worlds.point_world(40)
    fit = fit_of(world, 2)
    pose = world.rotations[2], world.translations[2], np.zeros(5)
    np.testing.assert_allclose(fit.errors_px(*pose), 0, atol=1e-6)
    # Moving the view's pixels by d moves them off their lines by at most d, half of it on average; Sampson splits it between both.
    moved = replace(world, pixel_xy=world.pixel_xy + np.eye(len(world.rotations))[2][None, :, None] * [1.0, 0.0])
    errors = np.abs(fit_of(moved, 2).errors_px(*pose))
    assert errors.max() < 1.0
    assert errors.max() > 0.3


@pytest.mark.parametrize(("zoom", "shift"), [(2.0, (0.0, 0.0)), (0.6, (0.0, 0.0)), (1.0, (0.2, 0.15))])
def test_pose_and_lens_come_back_from_matches(zoom: float, shift: tuple[float, float]) -> None:
    world = noisy(seen_through(worlds.point_world(41), 4, zoom=zoom, shift=shift))
    fit = fit_of(world, 4)
    start = rotation_exp(np.array([0.05, -0.04, 0.02])) @ world.rotations[4]
    freedom = {LOG_FOCAL: (-2.0, 2.0, np.inf)}
    if any(shift):
        freedom |= {SHIFT_X: (-0.5, 0.5, np.inf), SHIFT_Y: (-0.5, 0.5, np.inf)}
    found = fit.refine(start, world.translations[4] + 0.1, np.zeros(5), freedom_of(freedom, np.zeros(5)))
    assert np.exp(found.lens[LOG_FOCAL]) == pytest.approx(zoom, rel=0.03)
    assert found.lens[[SHIFT_X, SHIFT_Y]] == pytest.approx(shift, abs=0.02)
    held = fit.refine(world.rotations[4], world.translations[4], np.zeros(5), held_lens())
    assert found.cost < 0.5 * held.cost


def model_of(world: worlds.PointWorld) -> tuple[Mapping, list[Features], list[PairMatches]]:
    """A model that takes all views for one lens, begun at the truth and finished so, and its matches."""
    views = len(world.rotations)
    lenses = Lenses.nominal(views)
    lenses.free[:, LOG_FOCAL] = True
    lenses.low[:, LOG_FOCAL], lenses.high[:, LOG_FOCAL] = -1.0, 1.5
    mapping = Mapping(
        world.tracks,
        world.intrinsics,
        SfmConfig(),
        unit_px=1.0,
        seed=1,
        lenses=lenses,
        crops={4: CropOfMain(log_focal=0.0, limit_x=0.25, limit_y=0.25)},
    )
    mapping.rotations, mapping.translations = world.rotations.copy(), world.translations.copy()
    mapping.registered[:] = True
    mapping.grow(refine_focal=True)
    mapping.finish(refine_focal=True)
    nothing = np.zeros((0, 128), np.float32)
    features = [Features(pixel_xy=world.pixel_xy[:, view], descriptors=nothing) for view in range(views)]
    index = np.arange(len(world.points))
    matches = Matches(index_a=index, index_b=index, ratio=np.zeros(len(index)))
    pairs = [
        PairMatches(view_a=a, view_b=b, loose=matches, tentative=len(index), verified=matches)
        for a in range(views)
        for b in range(a + 1, views)
    ]
    return mapping, features, pairs


def test_photos_of_one_lens_keep_it() -> None:
    mapping, features, pairs = model_of(noisy(worlds.point_world(42, points=300)))
    assert not settle_lenses(mapping, features, pairs)
    assert len(set(mapping.lens_of.tolist())) == 1


@pytest.mark.parametrize("view", [0, 4])
def test_a_zoomed_photo_is_found_out(view: int) -> None:
    world = noisy(seen_through(worlds.point_world(43, points=300), view, zoom=1.8))
    mapping, features, pairs = model_of(world)
    assert settle_lenses(mapping, features, pairs)
    mapping.grow(refine_focal=True)
    mapping.finish(refine_focal=True)
    alone = [v for v in range(5) if (mapping.lens_of == mapping.lens_of[v]).sum() == 1]
    assert alone == [view]
    focal = mapping.intrinsics[:, 0, 0]
    assert focal[view] / np.delete(focal, view).mean() == pytest.approx(1.8, rel=0.05)
    turn, _ = worlds.pose_errors_deg(mapping.rotations, mapping.translations, world)
    assert turn.max() < 0.6


def test_a_cropped_photo_keeps_the_focal_and_gets_its_centre() -> None:
    world = noisy(seen_through(worlds.point_world(44, points=300), 4, shift=(0.2, 0.16)))
    mapping, features, pairs = model_of(world)
    mapping.lens_of[4] = 4
    assert settle_lenses(mapping, features, pairs)
    for _ in range(2):
        mapping.grow(refine_focal=True)
        mapping.finish(refine_focal=True)
    assert mapping.lenses.focal_of[4] == mapping.lens_of[0]
    shift = mapping.lenses.resolved[4, [SHIFT_X, SHIFT_Y]]
    assert shift == pytest.approx((0.2, 0.16), abs=0.02)
    turn, direction = worlds.pose_errors_deg(mapping.rotations, mapping.translations, world)
    assert turn.max() < 0.3
    assert direction.max() < 2.0
