"""What speaks for a camera, and what does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sfm_worlds as worlds
from test_epipolar import model_of, noisy, seen_through

from sceneexpander.frontend import evidence
from sceneexpander.frontend.bundle import LOG_FOCAL, SHIFT_X, SHIFT_Y, rotation_exp
from sceneexpander.frontend.evidence import ViewEvidence, common_doubt, halves_apart_deg, weigh_evidence
from sceneexpander.frontend.features import Features
from sceneexpander.frontend.lens_tests import (
    doubt_focal,
    find_apart_group,
    outvote_focal,
    pair_costs,
    release_focal,
    rival_lens_deg,
    settle_lenses,
)
from sceneexpander.frontend.mapping import Mapping, directions_between_deg
from sceneexpander.frontend.search import CameraSearch
from sceneexpander.frontend.sfm_setup import KnownCameras
from sceneexpander.frontend.sfm_types import SfmConfig
from sceneexpander.frontend.tracks import Tracks
from sceneexpander.frontend.twoview import PairMatches

CONFIG = SfmConfig()
FINE = ViewEvidence(
    agreeing=0.95,
    rotation_gap_deg=0.3,
    direction_sigma_deg=0.4,
    lens_sigma_deg=0.0,
    rival_angle_deg=0.0,
    halves_deg=0.0,
    spread_deg=0.0,
)


def flat(world: worlds.PointWorld) -> worlds.PointWorld:
    """The same cameras before a wall that hardly has relief."""
    points = world.points.copy()
    points[:, 2] = 5 + (points[:, 2] - 5) * 0.02
    world = replace(world, points=points)
    return replace(world, pixel_xy=worlds.project(world))


def test_right_cameras_have_all_evidence() -> None:
    mapping, features, pairs = model_of(noisy(worlds.point_world(50, points=250)))
    for found in weigh_evidence(mapping, features, pairs, [False] * 5).values():
        assert found.agreeing > 0.95
        assert found.rotation_gap_deg < 1.5
        assert found.direction_sigma_deg < 3
        assert found.lens_sigma_deg == 0
        assert not found.refusal(CONFIG)
        assert not found.doubt(CONFIG)


def test_a_wrong_camera_is_refused_whatever_its_own_points_say() -> None:
    mapping, features, pairs = model_of(noisy(worlds.point_world(51, points=250)))
    mapping.rotations[2] = rotation_exp(np.array([0.1, 0.25, 0.0])) @ mapping.rotations[2]
    found = weigh_evidence(mapping, features, pairs, [False] * 5)
    assert "of its matches" in found[2].refusal(CONFIG)
    assert found[2].agreeing < 0.2 < 0.6 < min(found[view].agreeing for view in (0, 1, 3, 4))


@pytest.mark.parametrize(("relief", "refused"), [(True, False), (False, True)])
def test_a_focal_of_its_own_needs_depth_to_be_believed(relief: bool, refused: bool) -> None:
    world = worlds.point_world(52, points=250)
    world = noisy(seen_through(world if relief else flat(world), 4, zoom=1.8))
    mapping, features, pairs = model_of(worlds.point_world(52, points=250))
    mapping.tracks, mapping.registered[:] = world.tracks, True
    mapping.rotations, mapping.translations, mapping.points = world.rotations, world.translations, world.points
    mapping.split_lens(4)
    lens = np.zeros(5)
    lens[0] = np.log(1.8)
    mapping.set_lens(4, lens)
    mapping.lenses = replace(mapping.lenses, values=np.where(np.arange(5)[:, None] == 4, lens, 0.0))
    features = [replace(own, pixel_xy=world.pixel_xy[:, view]) for view, own in enumerate(features)]
    found = weigh_evidence(mapping, features, pairs, [False] * 5)[4]
    assert ("zoomed" in found.refusal(CONFIG)) == refused, found
    hinted = weigh_evidence(mapping, features, pairs, [False] * 4 + [True])[4]
    assert not hinted.refusal(CONFIG), "what its file says is not left to the pictures"


@pytest.mark.parametrize(("relief", "open_to_another"), [(1.0, False), (0.2, False), (0.004, True)])
def test_two_photos_of_something_flat_allow_another_place(relief: float, open_to_another: bool) -> None:
    """A plane seen twice has two explanations; which of them is right only relief tells."""
    full = worlds.point_world(53, points=250)
    wall = full.points.copy()
    wall[:, 2] = 5 + 0.6 * wall[:, 0] + (wall[:, 2] - 5) * relief
    world = replace(full, points=wall)
    world = noisy(replace(world, pixel_xy=worlds.project(world)))
    mapping, features, pairs = model_of(full)
    mapping.tracks, mapping.points = world.tracks, world.points
    mapping.registered[:] = np.arange(5) < 2
    features = [replace(own, pixel_xy=world.pixel_xy[:, view]) for view, own in enumerate(features)]
    found = weigh_evidence(mapping, features, pairs, [False] * 5)[1]
    assert ("flat" in replace(found, direction_sigma_deg=0.0).doubt(CONFIG)) == open_to_another, found


@pytest.mark.parametrize(("relief", "settled"), [(True, True), (False, False)])
def test_how_a_photo_of_another_size_was_cut_out_needs_depth_to_be_known(relief: bool, settled: bool) -> None:
    """Before a wall a centre somewhere else is another direction; view 4 of the model may be a part of a photo."""
    world = worlds.point_world(57, points=250)
    mapping, features, pairs = model_of(noisy(world if relief else flat(world)))
    mapping.registered[1:4] = False
    found = weigh_evidence(mapping, features, pairs, [False] * 5)
    assert (found[4].spread_deg < CONFIG.max_spread_deg) == settled, found[4]
    assert found[0].spread_deg == 0, "it has the size of the main lens"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"agreeing": 0.3}, "30%"),
        ({"rotation_gap_deg": 50.0}, "contradict"),
        ({"lens_sigma_deg": 9.0}, "zoomed"),
    ],
)
def test_each_kind_of_evidence_can_fail(change: dict[str, float], said: str) -> None:
    assert said in replace(FINE, **change).refusal(CONFIG)


def test_doubts_are_no_refusals() -> None:
    for change in (
        {"agreeing": 0.6},
        {"rotation_gap_deg": 12.0},
        {"direction_sigma_deg": 20.0},
        {"rival_angle_deg": 20.0},
        {"halves_deg": 20.0},
        {"spread_deg": 20.0},
    ):
        found = replace(FINE, **change)
        assert found.doubt(CONFIG)
        assert not found.refusal(CONFIG)
    nothing = replace(FINE, agreeing=float("nan"), rotation_gap_deg=float("nan"), direction_sigma_deg=float("nan"))
    assert not nothing.refusal(CONFIG)
    assert not nothing.doubt(CONFIG)


@pytest.mark.parametrize("relief", [1.0, 0.005])
def test_halves_of_the_matches_tell_one_camera_only_where_there_is_depth(relief: float) -> None:
    mapping, tracks = seen_before(relief)
    apart = halves_apart_deg(mapping, tracks).max()
    assert apart < 0.5 if relief == 1 else apart > CONFIG.max_halves_deg


def test_one_half_that_is_flat_by_chance_is_a_quarter_of_the_doubt(monkeypatch: pytest.MonkeyPatch) -> None:
    mapping, tracks = seen_before(1.0)
    told = iter([np.full(5, degrees) for degrees in (8.0, 1.0, 1.0, 2.0)])
    monkeypatch.setattr(evidence, "directions_between_deg", lambda *_: next(told))
    assert np.allclose(halves_apart_deg(mapping, tracks), 3.0)
    assert next(told, None) is None, "four ways to halve"


def test_halves_say_nothing_of_given_poses_nor_where_there_is_little() -> None:
    mapping, tracks = seen_before(0.005)
    assert not halves_apart_deg(mapping, tracks, np.zeros(5, bool)).any()
    few = replace(tracks, seen=tracks.seen & (np.arange(tracks.count) < 50)[:, None])
    assert not halves_apart_deg(mapping, few).any()


def seen_before(relief: float) -> tuple[Mapping, Tracks]:
    """A model, and what it is made from, before a wall with a share of the relief of a cloud."""
    world = worlds.point_world(58, points=400)
    points = world.points.copy()
    points[:, 2] = 5 + (points[:, 2] - 5) * relief
    world = replace(world, points=points)
    world = noisy(replace(world, pixel_xy=worlds.project(world)))
    return model_of(world)[0], world.tracks


def test_two_lenses_taken_for_one_fall_apart_and_one_lens_does_not() -> None:
    world = worlds.point_world(53, points=250)
    mapping, features, pairs = model_of(noisy(world))
    assert find_apart_group(mapping, pair_costs(mapping, features, pairs)) == []
    two = seen_through(seen_through(world, 1, zoom=0.5), 3, zoom=0.5)
    mapping, features, pairs = model_of(noisy(two))
    assert sorted(find_apart_group(mapping, pair_costs(mapping, features, pairs))) == [1, 3]


def test_a_view_that_another_focal_explains_better_is_in_doubt_and_no_other_is() -> None:
    world = worlds.point_world(58, points=250)
    assert (rival_lens_deg(*model_of(noisy(world))) == 0).all()
    turned = rival_lens_deg(*model_of(noisy(seen_through(world, 4, zoom=1.5))))
    assert turned[4] > CONFIG.max_spread_deg
    assert (turned[:4] == 0).all()


def told(seed: int, views: int, factor: float) -> tuple[Mapping, list[Features], list[PairMatches]]:
    """A model of some views whose focal is held to what their files say: that many times the right one."""
    mapping, features, pairs = model_of(noisy(worlds.point_world(seed, points=250)))
    mapping.registered[views:] = False
    mapping.move_main_focal(np.log(factor))
    prior, sigma = mapping.lenses.prior.copy(), mapping.prior_sigma.copy()
    prior[:, LOG_FOCAL], sigma[:, LOG_FOCAL] = np.log(factor), CONFIG.focal_hint_sigma
    mapping.lenses, mapping.prior_sigma = replace(mapping.lenses, prior=prior), sigma
    mapping.finish(refine_focal=False)
    return mapping, features, pairs


@pytest.mark.parametrize("views", [2, 3])
def test_a_focal_that_files_say_rightly_is_left_alone(views: int) -> None:
    mapping, features, pairs = told(60, views, 1.0)
    assert outvote_focal(mapping) is None
    assert doubt_focal(mapping) is None
    assert not settle_lenses(mapping, features, pairs, focal_said=True)


@pytest.mark.parametrize(("views", "factor"), [(2, 0.65), (3, 1.5)])
def test_a_focal_that_files_say_wrongly_is_let_go(views: int, factor: float) -> None:
    mapping = told(60, views, factor)[0]
    assert release_focal(mapping)
    mapping.finish(refine_focal=False)
    np.testing.assert_allclose(mapping.log_focal, 0.0, atol=0.12)
    assert not release_focal(mapping), "it is held to nothing any more"


def test_a_whole_set_whose_files_lie_finds_its_focal() -> None:
    mapping, features, pairs = told(60, 5, 1.5)
    for _ in range(CONFIG.lens_rounds):
        if not settle_lenses(mapping, features, pairs, focal_said=True):
            break
        mapping.finish(refine_focal=True)
    np.testing.assert_allclose(mapping.log_focal, 0.0, atol=0.03)
    np.testing.assert_allclose(mapping.lenses.values[:, [SHIFT_X, SHIFT_Y]], 0.0, atol=0.01)


def test_two_photos_that_go_a_little_better_with_another_focal_are_in_doubt() -> None:
    mapping = told(61, 2, 1.5)[0]
    assert not release_focal(mapping)
    other = doubt_focal(mapping)
    assert other is not None
    assert other.log_focal[0] < mapping.log_focal[0] - 0.2
    assert directions_between_deg(mapping, [other]).max() > 0.5


def test_matches_behind_a_camera_do_not_agree_with_it() -> None:
    """The epipolar lines of a camera and of one on the other side of its neighbours are the same."""
    mapping, features, pairs = model_of(noisy(worlds.point_world(54, points=250)))
    right = weigh_evidence(mapping, features, pairs, [False] * 5)
    assert min(found.agreeing for found in right.values()) > 0.95
    centres = mapping.centres
    mapping.registered[:] = np.arange(5) < 2
    mapping.translations[1] = -mapping.rotations[1] @ (2 * centres[0] - centres[1])
    assert weigh_evidence(mapping, features, pairs, [False] * 5)[1].agreeing < 0.05


def test_directions_between_two_models_are_angles_at_the_views() -> None:
    mapping, _, _ = model_of(noisy(worlds.point_world(55, points=250)))
    mapping.registered[:] = np.arange(5) < 2
    other = mapping.copy()
    turned = rotation_exp(np.array([0.0, 0.0, np.deg2rad(30.0)]))
    mapping.rotations[:2], mapping.translations[0] = np.eye(3), 0.0
    other.rotations[:2], other.translations[0] = np.eye(3), 0.0
    mapping.translations[1], other.translations[1] = [1.0, 0.0, 0.0], turned @ [2.0, 0.0, 0.0]
    np.testing.assert_allclose(directions_between_deg(mapping, [other])[:2], 30.0)
    mapping.registered[2], other.registered[2] = True, True  # beside view 1, on another side of it in each
    mapping.rotations[2] = other.rotations[2] = np.eye(3)
    mapping.translations[2], other.translations[2] = [1.0, 0.02, 0.0], turned @ [2.0, 0.0, 0.02]
    np.testing.assert_allclose(directions_between_deg(mapping, [other])[:2], 30.0, atol=2)
    assert not directions_between_deg(mapping, [mapping]).any()


def test_a_long_lens_that_got_stuck_is_moved_on_and_says_what_else_fits() -> None:
    """A far cloud of little depth, and cameras settled at a focal 40 % off."""
    near = worlds.point_world(56, points=300, focal=2600.0)
    far = np.array([0.0, 0.0, 12.0])
    points = near.points * [1.0, 1.0, 0.5] + far
    translations = near.translations - np.einsum("vij,j->vi", near.rotations, far) + far
    world = replace(near, points=points, translations=translations)
    world = noisy(replace(world, pixel_xy=worlds.project(world)))
    model, features, pairs = model_of(world)
    right = model.copy()
    model.move_main_focal(-0.5)
    model.finish(refine_focal=False)
    known = KnownCameras(cam_from_world=np.tile(np.eye(4), (5, 1, 1)), posed=np.zeros(5, bool), intrinsics=None)
    search = CameraSearch(
        features=features,
        pairs=pairs,
        found=None,  # type: ignore[arg-type]
        known=known,
        plan=None,  # type: ignore[arg-type]
        config=CONFIG,
        setup=None,  # type: ignore[arg-type]
    )
    moved = search._with_focal_elsewhere(model)
    assert abs(model.log_focal[0] - right.log_focal[0]) > 0.3
    assert moved.score() > model.score()
    np.testing.assert_allclose(moved.log_focal[0], right.log_focal[0], atol=0.01)
    assert 0 < moved.spread_deg.max() < CONFIG.max_spread_deg


@pytest.mark.parametrize(
    ("photos", "sure", "doubted"),
    [
        (5, 5, False),
        (5, 4, False),
        (5, 3, False),
        (5, 2, True),
        (5, 1, True),
        (5, 0, True),
        (2, 2, False),
        (2, 1, True),
        (1, 1, False),
    ],
)
def test_no_camera_is_sure_among_others_that_are_rough(photos: int, sure: int, doubted: bool) -> None:
    assert bool(common_doubt(photos, sure=sure, depth=True, focal_is_guess=False)) == doubted


def test_no_camera_is_sure_without_depth_or_a_focal() -> None:
    assert "no depth" in common_doubt(5, sure=5, depth=False, focal_is_guess=False)
    assert "focal" in common_doubt(5, sure=5, depth=True, focal_is_guess=True)
