"""Robust bundle adjustment: Levenberg-Marquardt on the Schur complement, in numpy.

Parameters: per free camera a rotation (left perturbation ``exp([w]x) R``) and a translation of ``cam_from_world``, the points,
and one shared ``log_focal``: every focal is multiplied by its exponential. Cost: sum of Cauchy losses
``c^2 log(1 + e^2 / c^2)`` of reprojection errors e in pixels, plus a Gaussian prior on ``log_focal``.
Derivation: Triggs et al., "Bundle Adjustment - A Modern Synthesis", sections 4 (robust weights) and 6.1 (Schur complement).
The camera system is dense: meant for tens of views, thousands of points. Gauge: hold at least one camera fixed; the scale is
held by the damping.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

_MIN_DEPTH = 1e-4  # points nearer than this (or behind) are projected at this depth: a huge error, never an overflow
_STOP_DECREASE = 1e-6  # relative decrease of the cost below which iteration ends
_MAX_DAMPING = 1e10


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleProblem:
    """Cameras, points and observations. Each point is observed at most once per camera."""

    rotations: Float[np.ndarray, "camera 3 3"]  # cam_from_world
    translations: Float[np.ndarray, "camera 3"]
    focals_px: Float[np.ndarray, "camera 2"]  # fx, fy before the shared factor
    centres_px: Float[np.ndarray, "camera 2"]
    points: Float[np.ndarray, "point 3"]
    camera_index: Int[np.ndarray, " observation"]
    point_index: Int[np.ndarray, " observation"]
    pixel_xy: Float[np.ndarray, "observation 2"]
    camera_free: Bool[np.ndarray, " camera"]
    points_free: bool = True
    focal_free: bool = False
    log_focal: float = 0.0
    log_focal_bounds: tuple[float, float] = (-np.inf, np.inf)
    log_focal_prior: float = 0.0
    log_focal_weight: float = 0.0  # cost added: weight * (log_focal - prior)^2, in pixels^2
    robust_px: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleResult:
    """The adjusted problem and what is known about its quality."""

    problem: BundleProblem
    cost: float
    errors_px: Float[np.ndarray, " observation"]
    iterations: int
    log_focal_sigma: float  # from the inverse of the reduced system, per pixel of noise; inf if the focal is fixed


@dataclass(frozen=True, slots=True, kw_only=True)
class Linearisation:
    """Residuals and their derivatives, per observation."""

    residual: Float[np.ndarray, "observation 2"]
    camera: Float[np.ndarray, "observation 2 6"]  # d residual / d (w, t)
    point: Float[np.ndarray, "observation 2 3"]
    focal: Float[np.ndarray, "observation 2"]  # d residual / d log_focal


def residuals(problem: BundleProblem) -> Float[np.ndarray, "observation 2"]:
    """Reprojected minus observed pixel, per observation."""
    camera = problem.camera_index
    in_camera = (
        np.einsum("oij,oj->oi", problem.rotations[camera], problem.points[problem.point_index])
        + problem.translations[camera]
    )
    focal = problem.focals_px[camera] * np.exp(problem.log_focal)
    depth = np.maximum(in_camera[:, 2:], _MIN_DEPTH)
    return focal * in_camera[:, :2] / depth + problem.centres_px[camera] - problem.pixel_xy


def linearise(problem: BundleProblem) -> Linearisation:
    """Residuals and analytic Jacobians at the current parameters."""
    camera = problem.camera_index
    rotation = problem.rotations[camera]
    rotated = np.einsum("oij,oj->oi", rotation, problem.points[problem.point_index])
    in_camera = rotated + problem.translations[camera]
    focal = problem.focals_px[camera] * np.exp(problem.log_focal)
    depth = np.maximum(in_camera[:, 2], _MIN_DEPTH)
    scaled = focal * in_camera[:, :2] / depth[:, None]
    # d pixel / d point-in-camera.
    projection = np.zeros((len(camera), 2, 3))
    projection[:, 0, 0] = focal[:, 0] / depth
    projection[:, 1, 1] = focal[:, 1] / depth
    projection[:, :, 2] = np.where(in_camera[:, 2:] > _MIN_DEPTH, -scaled / depth[:, None], 0.0)
    # d (exp([w]x) R X) / dw = -[R X]x
    x, y, z = rotated.T
    zero = np.zeros_like(x)
    minus_cross = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], 1).reshape(-1, 3, 3)
    return Linearisation(
        residual=scaled + problem.centres_px[camera] - problem.pixel_xy,
        camera=np.concatenate([projection @ minus_cross, projection], 2),
        point=projection @ rotation,
        focal=scaled,
    )


def robust_cost(problem: BundleProblem, residual: Float[np.ndarray, "observation 2"]) -> float:
    """Sum of Cauchy losses plus the focal prior."""
    scale = problem.robust_px**2
    prior = problem.log_focal_weight * (problem.log_focal - problem.log_focal_prior) ** 2
    return float(scale * np.log1p((residual**2).sum(1) / scale).sum() + prior)


def adjust(problem: BundleProblem, *, max_iterations: int = 40) -> BundleResult:
    """Minimise the robust reprojection error. Never returns a higher cost than it was given."""
    if len(problem.camera_index) == 0:
        return BundleResult(
            problem=problem, cost=0.0, errors_px=np.zeros(0), iterations=0, log_focal_sigma=float("inf")
        )
    damping = 1e-4
    cost = robust_cost(problem, residuals(problem))
    iteration = 0
    sigma = float("inf")
    for _ in range(max_iterations):
        iteration += 1
        system = _NormalEquations(problem)
        improved = False
        while damping < _MAX_DAMPING:
            candidate = system.step(damping)
            candidate_cost = robust_cost(candidate, residuals(candidate))
            if candidate_cost < cost:
                improved = True
                break
            damping *= 8.0
        if not improved:
            break
        decrease = (cost - candidate_cost) / max(cost, 1e-12)
        problem, cost = candidate, candidate_cost
        damping = max(damping / 6.0, 1e-9)
        if decrease < _STOP_DECREASE:
            break
    if problem.focal_free:
        sigma = _NormalEquations(problem).log_focal_sigma()
    return BundleResult(
        problem=problem,
        cost=cost,
        errors_px=np.linalg.norm(residuals(problem), axis=1),
        iterations=iteration,
        log_focal_sigma=sigma,
    )


class _NormalEquations:
    """Robustly weighted normal equations of one linearisation, solved for several dampings."""

    def __init__(self, problem: BundleProblem) -> None:
        self.problem = problem
        parts = linearise(problem)
        weight = np.sqrt(1.0 / (1.0 + (parts.residual**2).sum(1) / problem.robust_px**2))
        self._residual = parts.residual * weight[:, None]
        self._jac_camera = parts.camera * weight[:, None, None]
        self._jac_point = parts.point * weight[:, None, None]
        self._jac_focal = parts.focal * weight[:, None]
        self._free = np.flatnonzero(problem.camera_free)
        self._size = 6 * len(self._free) + int(problem.focal_free)
        self._accumulate_cameras()
        if problem.points_free:
            self._accumulate_points()

    def _accumulate_cameras(self) -> None:
        """Camera and focal blocks of J^T J and of the gradient; coupling blocks of cameras with points."""
        problem, size = self.problem, self._size
        count = len(problem.points)
        self._hessian = np.zeros((size, size))
        self._gradient = np.zeros(size)
        self._coupling = np.zeros((size, count, 3)) if problem.points_free else None
        if problem.focal_free:
            self._hessian[-1, -1] = (self._jac_focal**2).sum() + problem.log_focal_weight
            self._gradient[-1] = (self._jac_focal * self._residual).sum() + problem.log_focal_weight * (
                problem.log_focal - problem.log_focal_prior
            )
            if self._coupling is not None:
                product = np.einsum("oi,oij->oj", self._jac_focal, self._jac_point)
                for axis in range(3):
                    self._coupling[-1, :, axis] = np.bincount(
                        problem.point_index, weights=product[:, axis], minlength=count
                    )
        for block, camera in enumerate(self._free):
            rows = np.flatnonzero(problem.camera_index == camera)
            jacobian = self._jac_camera[rows].reshape(-1, 6)
            at = slice(6 * block, 6 * block + 6)
            self._hessian[at, at] = jacobian.T @ jacobian
            self._gradient[at] = jacobian.T @ self._residual[rows].reshape(-1)
            if problem.focal_free:
                mixed = jacobian.T @ self._jac_focal[rows].reshape(-1)
                self._hessian[at, -1] = mixed
                self._hessian[-1, at] = mixed
            if self._coupling is not None:
                product = np.einsum("oic,oip->cop", self._jac_camera[rows], self._jac_point[rows])
                self._coupling[at, problem.point_index[rows]] = product

    def _accumulate_points(self) -> None:
        """3x3 point blocks of J^T J and of the gradient."""
        index, count = self.problem.point_index, len(self.problem.points)
        self._point_hessian = np.zeros((count, 3, 3))
        self._point_gradient = np.zeros((count, 3))
        for i in range(3):
            self._point_gradient[:, i] = np.bincount(
                index, weights=(self._jac_point[:, :, i] * self._residual).sum(1), minlength=count
            )
            for j in range(i, 3):
                entry = np.bincount(
                    index, weights=(self._jac_point[:, :, i] * self._jac_point[:, :, j]).sum(1), minlength=count
                )
                self._point_hessian[:, i, j] = entry
                self._point_hessian[:, j, i] = entry

    def _reduced(self, damping: float) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Schur complement of the points: (matrix, right-hand side, inverse point blocks)."""
        hessian = self._hessian + np.diag(damping * np.diag(self._hessian) + 1e-12)
        if self._coupling is None:
            return hessian, -self._gradient, None
        diagonal = np.einsum("pii->pi", self._point_hessian)
        damped = self._point_hessian.copy()
        # Points without observations keep a unit block: they do not move.
        damped[:, [0, 1, 2], [0, 1, 2]] += damping * diagonal + np.where(diagonal > 0, 1e-12, 1.0)
        inverse = np.linalg.inv(damped)
        coupling = self._coupling
        # Written out: einsum and batched matmul are an order slower on blocks this small.
        product = sum(coupling[:, :, i, None] * inverse[None, :, i] for i in range(3))
        eliminated = np.asarray(product).reshape(self._size, 3 * len(inverse))
        matrix = hessian - eliminated @ coupling.reshape(self._size, 3 * len(inverse)).T
        return matrix, -self._gradient + eliminated @ self._point_gradient.reshape(-1), inverse

    def step(self, damping: float) -> BundleProblem:
        """The problem after one damped Gauss-Newton step."""
        problem = self.problem
        matrix, rhs, inverse = self._reduced(damping)
        delta = np.linalg.lstsq(matrix, rhs, rcond=None)[0] if self._size else np.zeros(0)
        rotations, translations = problem.rotations.copy(), problem.translations.copy()
        for block, camera in enumerate(self._free):
            move = delta[6 * block : 6 * block + 6]
            rotations[camera] = rotation_exp(move[:3]) @ rotations[camera]
            translations[camera] = translations[camera] + move[3:]
        points = problem.points
        if self._coupling is not None and inverse is not None:
            pull = -self._point_gradient - np.einsum("cpi,c->pi", self._coupling, delta)
            points = points + np.einsum("pij,pj->pi", inverse, pull)
        log_focal = problem.log_focal
        if problem.focal_free:
            log_focal = float(np.clip(log_focal + delta[-1], *problem.log_focal_bounds))
        return replace(problem, rotations=rotations, translations=translations, points=points, log_focal=log_focal)

    def log_focal_sigma(self) -> float:
        """Standard deviation of ``log_focal`` for one pixel of noise, all other parameters marginalised."""
        matrix, _, _ = self._reduced(1e-9)
        covariance = np.linalg.pinv(matrix, rcond=1e-14, hermitian=True)
        return float(np.sqrt(max(covariance[-1, -1], 0.0)))


def rotation_exp(vector: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Rotation matrix of a rotation vector (Rodrigues), accurate near zero."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-8:
        return np.eye(3) + cross
    return np.eye(3) + np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * cross @ cross
