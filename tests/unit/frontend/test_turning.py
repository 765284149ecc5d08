"""A camera that only turned, before things that look alike, and cameras that did more than turn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sfm_worlds as worlds
import torch

from sceneexpander.frontend.bundle import rotation_exp
from sceneexpander.frontend.features import Features
from sceneexpander.frontend.matching import Matches
from sceneexpander.frontend.memory import MatchMemory
from sceneexpander.frontend.sfm import estimate_cameras
from sceneexpander.frontend.sfm_types import FocalSource, LearnedUse, PairKind, SfmConfig, SparseReconstruction
from sceneexpander.frontend.turning import Turn, find_turn
from sceneexpander.frontend.twoview import PairMatches, scaled_focal

CONFIG = SfmConfig()
FREE = (0.4, 2.5)
GUESS = 0.8  # times the right focal
PERIOD = 0.6  # of the wall


def wall_world(*, step: float = 0.0, relief: float = 0.0, far: float = 0.0, turn: float = 0.12) -> worlds.PointWorld:
    """Four views of a wall and, in the second half of the points, its next period; a share of all points may lie far away instead."""
    rng = np.random.default_rng(5)
    wall = np.stack([rng.uniform(-2.5, 2.0, 400), rng.uniform(-1.5, 1.5, 400), np.full(400, 5.0)], 1)
    wall[:, 2] += relief * rng.uniform(-1, 1, 400)
    points = np.concatenate([wall, wall + [PERIOD, 0.0, 0.0]])
    points[rng.random(len(points)) < far] *= 300.0
    rotations = np.stack([rotation_exp(np.array([0.02 * (k % 2), turn * (k - 1.5), 0.0])) for k in range(4)])
    centres = step * np.array([[k, 0.3 * (k % 2), 0.1 * k] for k in range(4)])
    world = worlds.point_world(0, views=4)
    world = replace(
        world, rotations=rotations, translations=-np.einsum("vij,vj->vi", rotations, centres), points=points
    )
    xy = worlds.project(world)
    return replace(world, pixel_xy=xy + rng.normal(0, 0.3, xy.shape))


def matched(
    world: worlds.PointWorld, *, alike: float = 0.0, described: bool = True
) -> tuple[list[Features], list[PairMatches]]:
    """Right matches of all points; of a share of the first half those with what looks alike a period on, and as many with anything."""
    rng = np.random.default_rng(6)
    count = len(world.points)
    features = [
        Features(pixel_xy=world.pixel_xy[:, v], descriptors=np.zeros((count if described else 0, 128), np.float32))
        for v in range(len(world.rotations))
    ]
    pairs = []
    for a in range(len(features)):
        for b in range(a + 1, len(features)):
            wrong = np.flatnonzero(rng.random(count // 2) < alike)
            right = np.setdiff1d(np.arange(count // 2), wrong)
            index_a = np.concatenate([right, wrong, wrong])
            index_b = np.concatenate([right, wrong + count // 2, rng.permutation(wrong)])
            loose = Matches(index_a=index_a, index_b=index_b, ratio=np.full(len(index_a), 0.7))
            verified = loose.select(np.arange(len(right) + len(wrong)))
            pairs.append(PairMatches(view_a=a, view_b=b, loose=loose, tentative=loose.count, verified=verified))
    return features, pairs


def turn_of(
    world: worlds.PointWorld, features: list[Features], pairs: list[PairMatches], bounds: tuple[float, float] = FREE
) -> Turn | None:
    guess = np.stack([scaled_focal(matrix, GUESS) for matrix in world.intrinsics])
    return find_turn(features, pairs, guess, bounds, CONFIG, unit_px=1.0, seed=1)


@pytest.mark.parametrize("alike", [0.0, 0.3])
def test_a_turn_is_known_and_its_focal_found_whatever_looks_alike(alike: float) -> None:
    world = wall_world()
    features, pairs = matched(world, alike=alike)
    turn = turn_of(world, features, pairs)
    assert turn is not None
    assert turn.factor == pytest.approx(1 / GUESS, rel=0.02)
    assert sorted(turn.pairs) == list(range(len(pairs)))
    for place, pair in turn.pairs.items():
        right = pair.verified.index_a == pair.verified.index_b
        assert right.all(), "what looks alike is no longer matched"
        before = pairs[place].verified
        assert pair.verified.count > 0.97 * (before.index_a == before.index_b).sum()


@pytest.mark.parametrize(
    ("step", "relief", "far"),
    [
        (0.25, 1.0, 0.0),  # things at all depths
        (0.25, 0.0, 0.0),  # one flat wall: a homography, but no turn
        (0.15, 0.3, 0.75),  # a far background that most matches lie on, and something before it
    ],
)
def test_cameras_that_stand_elsewhere_did_not_only_turn(step: float, relief: float, far: float) -> None:
    world = wall_world(step=step, relief=relief, far=far)
    assert turn_of(world, *matched(world)) is None
    if far:
        background = world.points[:400, 2] > 100
        features, pairs = matched(world)
        behind = [replace(pair, loose=p, verified=p) for pair in pairs for p in [pair.verified.select(background)]]
        assert turn_of(world, features, behind) is not None, "it is only the foreground that tells"


def test_a_small_step_before_a_flat_wall_is_no_turn_although_what_is_left_is_wrong() -> None:
    """A turn explains nearly as much as the homography does, and the matches it leaves are those of things that look alike."""
    world = wall_world(step=0.06)
    assert turn_of(world, *matched(world, alike=0.3)) is None


@pytest.mark.parametrize(("factor", "turned"), [(1 / GUESS, True), (1.0, False)])
def test_a_known_focal_is_not_bent_to_make_a_turn(factor: float, turned: bool) -> None:
    world = wall_world()
    assert (turn_of(world, *matched(world), bounds=(factor, factor)) is not None) == turned


def test_what_stays_where_it_is_tells_of_no_turn() -> None:
    """Words over photos of different places."""
    world = wall_world(turn=0.0)
    world = replace(world, pixel_xy=world.pixel_xy[:, :1] + 0.3 * (world.pixel_xy - world.pixel_xy[:, :1] > 0))
    assert turn_of(world, *matched(world, alike=0.1)) is None


def test_learned_matches_are_not_asked_and_those_that_contradict_the_turn_go_too() -> None:
    world = wall_world()
    count = len(world.points)
    assert turn_of(world, *matched(world, described=False)) is None
    features, pairs = matched(world)
    learned = [replace(own, pixel_xy=np.concatenate([own.pixel_xy, own.pixel_xy])) for own in features]
    index = np.arange(count, count + 300)
    off = Matches(index_a=index, index_b=index + 7, ratio=np.zeros(300))
    turn = turn_of(world, learned, [replace(pair, verified=pair.verified.joined(off)) for pair in pairs])
    assert turn is not None
    assert all((pair.verified.index_a < count).all() for pair in turn.pairs.values())


def cameras_of(world: worlds.PointWorld, alike: float, monkeypatch: pytest.MonkeyPatch) -> SparseReconstruction:
    """What the whole front-end makes of keypoints and matches that are given instead of looked for."""
    features, pairs = matched(world, alike=alike)
    ways = np.random.default_rng(7).random((len(world.points), 128)).astype(np.float32)
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    keypoints, matches = iter([replace(own, descriptors=ways) for own in features]), iter([p.loose for p in pairs])
    monkeypatch.setattr(MatchMemory, "detect_features", lambda *_: next(keypoints))
    monkeypatch.setattr(MatchMemory, "match_descriptors", lambda *_: next(matches))
    config = SfmConfig(learned=LearnedUse.NEVER, focal_starts=(0.85,), choose_most_views=1)
    blank = torch.full((len(features), 3, 576, 768), 0.5)
    return estimate_cameras(blank, config, generator=torch.Generator().manual_seed(0))


def test_the_cameras_of_a_turn_before_a_repeated_wall_get_no_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    world = wall_world()
    found = cameras_of(world, 0.3, monkeypatch)
    assert {pair.kind for pair in found.report.pairs} == {PairKind.ROTATION}
    assert found.report.points == 0
    assert all(view.loose for view in found.report.views)
    assert found.report.focal_source is FocalSource.TURNED
    assert found.report.focal_ratio == pytest.approx(world.intrinsics[0, 0, 0] / 768, rel=0.02)
    relative = world.rotations @ world.rotations[0].T  # cam_from_cam 0
    mine = found.world_from_cam[:, :3, :3].numpy().transpose(0, 2, 1)
    np.testing.assert_allclose(mine, relative, atol=0.01)
