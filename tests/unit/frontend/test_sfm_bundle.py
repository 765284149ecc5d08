"""Bundle adjustment against finite differences and exact worlds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sfm_worlds as worlds

from sceneexpander.frontend.bundle import adjust, linearise, residuals, robust_cost, rotation_exp


def test_jacobians_equal_finite_differences() -> None:
    world = worlds.point_world(0, views=3, points=12)
    problem = replace(
        worlds.perturbed(worlds.bundle_problem(world), 1, angle=0.05, shift=0.1, spread=0.1), log_focal=0.1
    )
    parts = linearise(problem)
    np.testing.assert_allclose(parts.residual, residuals(problem), atol=1e-10)
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
            np.testing.assert_allclose(central(turned)[mine], parts.camera[mine, :, axis], atol=1e-3)
            np.testing.assert_allclose(central(turned)[~mine], 0, atol=1e-12)
            np.testing.assert_allclose(central(moved)[mine], parts.camera[mine, :, 3 + axis], atol=1e-3)
    for axis in range(3):

        def shifted(h: float, axis: int = axis):  # type: ignore[no-untyped-def]
            return replace(problem, points=problem.points + h * np.eye(3)[axis])

        np.testing.assert_allclose(central(shifted), parts.point[:, :, axis], atol=1e-3)
    zoomed = central(lambda h: replace(problem, log_focal=problem.log_focal + h))
    np.testing.assert_allclose(zoomed, parts.focal, atol=1e-3)


@pytest.mark.parametrize("focal_free", [False, True])
def test_exact_observations_bring_cameras_and_focal_back(focal_free: bool) -> None:
    world = worlds.point_world(3)
    start = worlds.perturbed(worlds.bundle_problem(world), 4, angle=0.02, shift=0.05, spread=0.1)
    # Wrong by 15 %; the factor that undoes it is log(1 / 1.15).
    if focal_free:
        start = replace(start, focals_px=start.focals_px * 1.15, focal_free=True)
    result = adjust(start, max_iterations=200)
    turn, direction = worlds.pose_errors_deg(result.problem.rotations, result.problem.translations, world)
    # No noise: what is left is where iteration stops, far below anything visible in an image.
    assert result.errors_px.max() < 0.02
    assert turn.max() < 0.01
    assert direction.max() < 0.05
    if focal_free:
        assert np.exp(result.problem.log_focal) * 1.15 == pytest.approx(1.0, abs=2e-3)


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
    clean = worlds.bundle_problem(world, focal_free=True, robust_px=50.0)  # so wide a loss is least squares
    noise = 0.5
    found, predicted = [], []
    for seed in range(25):
        rng = np.random.default_rng(100 + seed)
        noisy = replace(clean, pixel_xy=clean.pixel_xy + rng.normal(0, noise, clean.pixel_xy.shape))
        result = adjust(noisy, max_iterations=100)
        found.append(result.problem.log_focal)
        predicted.append(result.log_focal_sigma * noise)
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
    assert result.problem.log_focal == start.log_focal


def test_focal_stays_in_its_bounds_and_near_its_prior() -> None:
    world = worlds.point_world(11)
    start = worlds.bundle_problem(world, focal_free=True)
    wrong = replace(start, focals_px=start.focals_px * 2.0)
    bounded = adjust(replace(wrong, log_focal_bounds=(-0.2, 0.2)), max_iterations=60).problem
    assert bounded.log_focal == pytest.approx(-0.2)
    held = adjust(replace(wrong, log_focal_weight=1e9), max_iterations=60).problem
    assert abs(held.log_focal) < 1e-3


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
