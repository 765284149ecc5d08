"""Bundle adjustment against finite differences and exact worlds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sfm_worlds as worlds

from sceneexpander.frontend.bundle import (
    K1,
    K2,
    LENS_PARAMETERS,
    LOG_FOCAL,
    SHIFT_X,
    SHIFT_Y,
    Lenses,
    adjust,
    direction_sigma_deg,
    linearise,
    residuals,
    robust_cost,
    rotation_exp,
)


def test_jacobians_equal_finite_differences() -> None:
    world = worlds.point_world(0, views=3, points=12)
    bent = {LOG_FOCAL: 0.1, SHIFT_X: 0.03, SHIFT_Y: -0.02, K1: -0.2, K2: 0.05}
    start = worlds.with_lens(worlds.bundle_problem(world), values=bent)
    problem = worlds.perturbed(start, 1, angle=0.05, shift=0.1, spread=0.1)
    parts = linearise(problem)
    np.testing.assert_allclose(parts.residual.T, residuals(problem), atol=1e-10)
    step = 1e-6

    def central(change) -> np.ndarray:  # type: ignore[no-untyped-def]
        return (residuals(change(step)) - residuals(change(-step))) / (2 * step)

    for camera in range(3):
        mine = problem.camera_index == camera
        for axis in range(3):
            unit = np.eye(3)[axis]

            def turned(h: float, camera: int = camera, unit: np.ndarray = unit):  # type: ignore[no-untyped-def]
                rotations = problem.rotations.copy()
                rotations[camera] = rotation_exp(h * unit) @ rotations[camera]
                return replace(problem, rotations=rotations)

            def moved(h: float, camera: int = camera, unit: np.ndarray = unit):  # type: ignore[no-untyped-def]
                translations = problem.translations.copy()
                translations[camera] = translations[camera] + h * unit
                return replace(problem, translations=translations)

            # Derivatives are of the order of the focal (650); central differences are good to about 1e-5 of that.
            np.testing.assert_allclose(central(turned)[mine], parts.camera[:, axis, mine].T, atol=1e-3)
            np.testing.assert_allclose(central(turned)[~mine], 0, atol=1e-12)
            np.testing.assert_allclose(central(moved)[mine], parts.camera[:, 3 + axis, mine].T, atol=1e-3)
    for axis in range(3):

        def shifted(h: float, axis: int = axis):  # type: ignore[no-untyped-def]
            return replace(problem, points=problem.points + h * np.eye(3)[axis])

        np.testing.assert_allclose(central(shifted), parts.point[:, axis].T, atol=1e-3)
    for parameter in range(LENS_PARAMETERS):
        other = central(lambda h, p=parameter: worlds.with_lens(problem, values={p: bent[p] + h}))
        np.testing.assert_allclose(other, parts.lens[:, parameter].T, atol=1e-3)


@pytest.mark.parametrize("focal_free", [False, True])
def test_exact_observations_bring_cameras_and_focal_back(focal_free: bool) -> None:
    world = worlds.point_world(3)
    start = worlds.perturbed(worlds.bundle_problem(world), 4, angle=0.02, shift=0.05, spread=0.1)
    # Wrong by 15 %; the factor that undoes it is log(1 / 1.15).
    if focal_free:
        start = replace(start, focals_px=start.focals_px * 1.15)
        start = worlds.with_lens(start, free={LOG_FOCAL: True})
    result = adjust(start, max_iterations=200)
    turn, direction = worlds.pose_errors_deg(result.problem.rotations, result.problem.translations, world)
    # No noise: what is left is where iteration stops, far below anything visible in an image.
    assert result.errors_px.max() < 0.02
    assert turn.max() < 0.01
    assert direction.max() < 0.05
    if focal_free:
        assert np.exp(result.problem.lenses.values[0, LOG_FOCAL]) * 1.15 == pytest.approx(1.0, abs=2e-3)


def bent_world(seed: int, *, k1: float, k2: float, shift: tuple[float, float]) -> worlds.PointWorld:
    """A point world seen through a lens that is not centred and bends."""
    world = worlds.point_world(seed)
    lens = {K1: k1, K2: k2, SHIFT_X: shift[0], SHIFT_Y: shift[1]}
    problem = worlds.with_lens(worlds.bundle_problem(world), values=lens)
    seen = (residuals(problem) + problem.pixel_xy).reshape(world.pixel_xy.shape)
    return replace(world, pixel_xy=seen)


@pytest.mark.parametrize(
    ("k1", "k2", "shift"), [(-0.22, 0.05, (0.0, 0.0)), (0.12, 0.0, (0.0, 0.0)), (0.0, 0.0, (0.2, -0.15))]
)
def test_distortion_and_principal_point_come_back(k1: float, k2: float, shift: tuple[float, float]) -> None:
    world = bent_world(30, k1=k1, k2=k2, shift=shift)
    free = dict.fromkeys((LOG_FOCAL, K1, K2, SHIFT_X, SHIFT_Y), True)
    start = worlds.perturbed(worlds.bundle_problem(world), 31, angle=0.01, shift=0.02, spread=0.05)
    result = adjust(worlds.with_lens(start, free=free), max_iterations=300)
    # No noise, but focal, centre and bending trade against each other: what is left is where iteration stops.
    found = result.problem.lenses.values[0]
    assert result.errors_px.max() < 0.1
    assert found[[SHIFT_X, SHIFT_Y]] == pytest.approx(shift, abs=5e-3)
    assert found[K1] == pytest.approx(k1, abs=1e-2)
    turn, direction = worlds.pose_errors_deg(result.problem.rotations, result.problem.translations, world)
    assert turn.max() < 0.1
    assert direction.max() < 0.5


def test_lenses_are_found_apart_and_one_can_follow_another() -> None:
    world = worlds.point_world(32)
    problem = worlds.bundle_problem(world)
    zoom = 1.7
    pixel_xy = problem.pixel_xy.copy()
    own = problem.camera_index == 4
    pixel_xy[own] = (pixel_xy[own] - problem.centres_px[4]) * zoom + problem.centres_px[4]
    lens_index = np.array([0, 0, 0, 0, 1])
    two = replace(problem, pixel_xy=pixel_xy, lens_index=lens_index, lenses=Lenses.nominal(2))
    two = replace(two, focals_px=two.focals_px * 1.1)
    free = worlds.with_lens(worlds.with_lens(two, free={LOG_FOCAL: True}), lens=1, free={LOG_FOCAL: True})
    found = np.exp(adjust(free, max_iterations=300).problem.lenses.resolved[:, LOG_FOCAL]) * 1.1
    assert found == pytest.approx([1.0, zoom], rel=5e-3)
    lenses = replace(free.lenses, focal_of=np.array([0, 0]), offset=np.array([0.0, np.log(zoom)]))
    followed = adjust(replace(free, lenses=lenses), max_iterations=300)
    assert np.exp(followed.problem.lenses.resolved[:, LOG_FOCAL]) * 1.1 == pytest.approx([1.0, zoom], rel=2e-3)
    assert np.isinf(followed.lens_sigma[1, LOG_FOCAL]), "it has no focal of its own"


def centres(rotations: np.ndarray, translations: np.ndarray) -> np.ndarray:
    return -np.einsum("vji,vj->vi", rotations, translations)


def test_predicted_direction_errors_are_the_spread_over_noise() -> None:
    world = worlds.point_world(33, points=80)
    clean = worlds.with_lens(worlds.bundle_problem(world, robust_px=50.0), free={LOG_FOCAL: True})
    noise = 0.5
    errors = []
    for seed in range(25):
        rng = np.random.default_rng(200 + seed)
        noisy = replace(clean, pixel_xy=clean.pixel_xy + rng.normal(0, noise, clean.pixel_xy.shape))
        found = adjust(noisy, max_iterations=100).problem
        bases = [
            centres(rotations, translations)
            for rotations, translations in (
                (found.rotations, found.translations),
                (world.rotations, world.translations),
            )
        ]
        a, b = (base[1:] - base[:1] for base in bases)
        errors.append(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(1))))
    predicted = direction_sigma_deg(clean)[0, 1:] * noise
    # The prediction is the larger axis of two; a spread from 25 samples is itself known to about 14 %.
    spread = np.sqrt((np.stack(errors) ** 2).mean(0))
    assert (spread < 1.7 * predicted).all()
    assert (spread > 0.6 * predicted).all()


def test_outliers_hardly_move_the_cameras() -> None:
    world = worlds.point_world(5)
    clean = worlds.bundle_problem(world)
    rng = np.random.default_rng(6)
    pixel_xy = clean.pixel_xy + rng.normal(0, 0.5, clean.pixel_xy.shape)
    wrong = rng.random(len(pixel_xy)) < 0.08
    pixel_xy[wrong] += rng.uniform(-60, 60, (int(wrong.sum()), 2))
    start = worlds.perturbed(replace(clean, pixel_xy=pixel_xy), 7, angle=0.01, shift=0.03, spread=0.05)
    result = adjust(start, max_iterations=100)
    kept = ~wrong
    oracle = adjust(
        replace(
            start,
            camera_index=start.camera_index[kept],
            point_index=start.point_index[kept],
            pixel_xy=start.pixel_xy[kept],
        ),
        max_iterations=100,
    )
    turn, direction = worlds.pose_errors_deg(result.problem.rotations, result.problem.translations, world)
    best_turn, best_direction = worlds.pose_errors_deg(oracle.problem.rotations, oracle.problem.translations, world)
    # A Cauchy loss still feels 8 % of outliers a little: not more than the noise itself does.
    assert turn.max() < 2 * best_turn.max()
    assert direction.max() < 2 * best_direction.max()
    assert np.median(result.errors_px[~wrong]) < 0.7
    assert np.median(result.errors_px[wrong]) > 10


def test_reported_focal_uncertainty_is_the_spread_over_noise() -> None:
    world = worlds.point_world(8, points=60)
    clean = worlds.with_lens(worlds.bundle_problem(world, robust_px=50.0), free={LOG_FOCAL: True})  # least squares
    noise = 0.5
    found, predicted = [], []
    for seed in range(25):
        rng = np.random.default_rng(100 + seed)
        noisy = replace(clean, pixel_xy=clean.pixel_xy + rng.normal(0, noise, clean.pixel_xy.shape))
        result = adjust(noisy, max_iterations=100)
        found.append(result.problem.lenses.values[0, LOG_FOCAL])
        predicted.append(result.lens_sigma[0, LOG_FOCAL] * noise)
    # A spread from 25 samples is itself known to about 14 %; three of those.
    assert np.std(found) == pytest.approx(np.mean(predicted), rel=0.45)


def test_cost_never_rises_and_fixed_things_stay() -> None:
    world = worlds.point_world(9)
    start = worlds.perturbed(worlds.bundle_problem(world), 10, angle=0.3, shift=1.0, spread=1.0)
    before = robust_cost(start, residuals(start))
    result = adjust(start, max_iterations=15)
    assert result.cost <= before
    np.testing.assert_array_equal(result.problem.rotations[0], start.rotations[0])
    np.testing.assert_array_equal(result.problem.translations[0], start.translations[0])
    np.testing.assert_array_equal(result.problem.lenses.values, start.lenses.values)


def test_focal_stays_in_its_bounds_and_near_its_prior() -> None:
    world = worlds.point_world(11)
    start = worlds.with_lens(worlds.bundle_problem(world), free={LOG_FOCAL: True})
    wrong = replace(start, focals_px=start.focals_px * 2.0)
    tight = worlds.with_lens(wrong, low={LOG_FOCAL: -0.2}, high={LOG_FOCAL: 0.2})
    assert adjust(tight, max_iterations=60).problem.lenses.values[0, LOG_FOCAL] == pytest.approx(-0.2)
    held = adjust(worlds.with_lens(wrong, weight={LOG_FOCAL: 1e9}), max_iterations=60).problem
    assert abs(held.lenses.values[0, LOG_FOCAL]) < 1e-3


def test_nothing_to_adjust_is_fine() -> None:
    world = worlds.point_world(12, points=4)
    none = np.zeros(0, np.int64)
    empty = worlds.bundle_problem(world, camera_index=none, point_index=none, pixel_xy=np.zeros((0, 2)))
    assert adjust(empty).cost == 0.0


def test_rotation_exp_is_a_rotation_and_accurate_near_zero() -> None:
    for vector in (np.array([0.3, -1.2, 2.0]), np.array([1e-10, 0, 0]), np.zeros(3)):
        rotation = rotation_exp(vector)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
    half_turn = rotation_exp(np.array([0.0, 0.0, np.pi / 2]))
    np.testing.assert_allclose(half_turn @ np.array([1.0, 0, 0]), [0, 1, 0], atol=1e-12)


def test_points_move_to_their_rays_where_all_cameras_are_held() -> None:
    world = worlds.point_world(2)
    problem = worlds.bundle_problem(world, camera_free=np.zeros(len(world.rotations), bool))
    start = replace(problem, points=problem.points + 0.05)
    result = adjust(start)
    np.testing.assert_allclose(result.problem.points, world.points, atol=1e-6)
    np.testing.assert_array_equal(result.problem.rotations, world.rotations)
