"""What speaks for a camera, and what does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sfm_worlds as worlds
from test_epipolar import model_of, noisy, seen_through

from sceneexpander.frontend.bundle import rotation_exp
from sceneexpander.frontend.evidence import ViewEvidence, weigh_evidence
from sceneexpander.frontend.lens_tests import find_apart_group, pair_costs
from sceneexpander.frontend.sfm_types import SfmConfig

CONFIG = SfmConfig()
FINE = ViewEvidence(agreeing=0.95, rotation_gap_deg=0.3, direction_sigma_deg=0.4, lens_sigma_deg=0.0)


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
    for change in ({"agreeing": 0.6}, {"direction_sigma_deg": 20.0}):
        found = replace(FINE, **change)
        assert found.doubt(CONFIG)
        assert not found.refusal(CONFIG)
    nothing = replace(FINE, agreeing=float("nan"), rotation_gap_deg=float("nan"), direction_sigma_deg=float("nan"))
    assert not nothing.refusal(CONFIG)
    assert not nothing.doubt(CONFIG)


def test_two_lenses_taken_for_one_fall_apart_and_one_lens_does_not() -> None:
    world = worlds.point_world(53, points=250)
    mapping, features, pairs = model_of(noisy(world))
    assert find_apart_group(mapping, pair_costs(mapping, features, pairs)) == []
    two = seen_through(seen_through(world, 1, zoom=0.5), 3, zoom=0.5)
    mapping, features, pairs = model_of(noisy(two))
    assert sorted(find_apart_group(mapping, pair_costs(mapping, features, pairs))) == [1, 3]
