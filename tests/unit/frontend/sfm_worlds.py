"""Point worlds with exact truth for the sparse front-end's tests."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sceneexpander.frontend.bundle import BundleProblem, Lenses, rotation_exp
from sceneexpander.frontend.tracks import Tracks


@dataclass(frozen=True, kw_only=True)
class PointWorld:
    """Cameras (cam_from_world), points and their exact projections; every camera sees every point."""

    rotations: np.ndarray
    translations: np.ndarray
    intrinsics: np.ndarray
    points: np.ndarray
    pixel_xy: np.ndarray  # (point, view, 2)

    @property
    def tracks(self) -> Tracks:
        return Tracks(pixel_xy=self.pixel_xy, seen=np.ones(self.pixel_xy.shape[:2], bool))


def point_world(
    seed: int, *, views: int = 5, points: int = 200, focal: float = 650.0, size: tuple[int, int] = (768, 576)
) -> PointWorld:
    """Cameras on an arc around a cloud at depths 3 to 7; images of ``size`` (width, height)."""
    rng = np.random.default_rng(seed)
    width, height = size
    matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    cloud = np.stack([rng.uniform(-1.2, 1.2, points), rng.uniform(-0.9, 0.9, points), rng.uniform(3, 7, points)], 1)
    rotations, translations = [], []
    for k in range(views):
        angle = 0.12 * k
        rotation = rotation_exp(np.array([0.04 * (k % 3), angle, 0.02 * k]))
        # Turned about a point 5 units ahead, with some freedom, so that the cloud stays in view.
        pivot = np.array([0.0, 0.0, 5.0])
        translation = pivot - rotation @ pivot + (rng.uniform(-0.25, 0.25, 3) if k else 0.0)
        rotations.append(rotation)
        translations.append(translation)
    world = PointWorld(
        rotations=np.stack(rotations),
        translations=np.stack(translations),
        intrinsics=np.tile(matrix, (views, 1, 1)),
        points=cloud,
        pixel_xy=np.zeros((points, views, 2)),
    )
    return replace(world, pixel_xy=project(world))


def project(world: PointWorld) -> np.ndarray:
    """(point, view, 2) exact pixels."""
    in_camera = np.einsum("vij,pj->pvi", world.rotations, world.points) + world.translations
    homogeneous = np.einsum("vij,pvj->pvi", world.intrinsics, in_camera)
    return homogeneous[..., :2] / homogeneous[..., 2:]


def bundle_problem(world: PointWorld, **changes: object) -> BundleProblem:
    """All observations; camera 0 fixed."""
    points, views = world.pixel_xy.shape[:2]
    rows, columns = np.nonzero(np.ones((points, views), bool))
    free = np.ones(views, bool)
    free[0] = False
    views = len(world.rotations)
    problem = BundleProblem(
        lens_index=np.zeros(views, np.int64),
        lenses=Lenses.nominal(1),
        shift_unit_px=np.full((views, 2), 768.0),
        rotations=world.rotations,
        translations=world.translations,
        focals_px=world.intrinsics[:, [0, 1], [0, 1]],
        centres_px=world.intrinsics[:, :2, 2],
        points=world.points,
        camera_index=columns,
        point_index=rows,
        pixel_xy=world.pixel_xy[rows, columns],
        camera_free=free,
    )
    return replace(problem, **changes)


def with_lens(problem: BundleProblem, lens: int = 0, **tables: dict[int, float]) -> BundleProblem:
    """The problem with single entries of its lens tables changed: ``free={K1: True}``, ``values={LOG_FOCAL: 0.1}``, ..."""
    changed = {}
    for table, entries in tables.items():
        array = getattr(problem.lenses, table).copy()
        for column, value in entries.items():
            array[lens, column] = value
        changed[table] = array
    return replace(problem, lenses=replace(problem.lenses, **changed))


def perturbed(problem: BundleProblem, seed: int, *, angle: float, shift: float, spread: float) -> BundleProblem:
    """Free cameras and all points moved at random."""
    rng = np.random.default_rng(seed)
    rotations, translations = problem.rotations.copy(), problem.translations.copy()
    for camera in np.flatnonzero(problem.camera_free):
        rotations[camera] = rotation_exp(rng.normal(0, angle, 3)) @ rotations[camera]
        translations[camera] = translations[camera] + rng.normal(0, shift, 3)
    points = problem.points + rng.normal(0, spread, problem.points.shape)
    return replace(problem, rotations=rotations, translations=translations, points=points)


def pose_errors_deg(
    rotations: np.ndarray, translations: np.ndarray, world: PointWorld
) -> tuple[np.ndarray, np.ndarray]:
    """Errors (degrees) of the relative rotations and translation directions of views 1.. with respect to view 0."""
    turn, direction = [], []
    for k in range(1, len(rotations)):
        estimate = rotations[k] @ rotations[0].T
        truth = world.rotations[k] @ world.rotations[0].T
        turn.append(np.linalg.norm(estimate - truth) / np.sqrt(2))  # 2 sin(angle / 2) * sqrt 2 / sqrt 2: small-angle
        moved = translations[k] - estimate @ translations[0]
        true = world.translations[k] - truth @ world.translations[0]
        cosine_sine = np.linalg.norm(np.cross(moved, true)), moved @ true
        direction.append(np.arctan2(*cosine_sine))
    return np.rad2deg(turn), np.rad2deg(direction)
