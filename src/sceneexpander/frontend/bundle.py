"""Robust bundle adjustment: Levenberg-Marquardt on the Schur complement, in numpy.

Parameters: per free camera a rotation (left perturbation ``exp([w]x) R``) and a translation of ``cam_from_world``, the points,
and what the cameras of one lens share: a factor on their focal lengths (as its logarithm), a shift of the principal point, and radial
distortion ``x_d = x (1 + k1 r^2 + k2 r^4)`` of normalised image coordinates. Cost: sum of Cauchy losses
``c^2 log(1 + e^2 / c^2)`` of reprojection errors e in pixels, plus Gaussian priors on the lens parameters.
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
_LEAST_PIVOT = 1e-15  # of a point's block, relative to its diagonal
_GAUGE_DAMPING = 1e-7  # keeps the scale, which nothing observes, from drowning everything else

# Columns of a lens's parameters.
LENS_PARAMETERS = 5
LOG_FOCAL = 0
SHIFT_X, SHIFT_Y = 1, 2  # of the principal point, in units of the cameras' ``shift_unit_px``
K1, K2 = 3, 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Lenses:
    """Parameters that cameras of one lens share, their bounds and Gaussian priors; columns as named above.

    The focal of a lens can follow another's, ``offset`` apart: ``focal_of`` names the lens whose value counts (mostly its own).
    """

    values: Float[np.ndarray, "lens 5"]
    free: Bool[np.ndarray, "lens 5"]
    low: Float[np.ndarray, "lens 5"]
    high: Float[np.ndarray, "lens 5"]
    prior: Float[np.ndarray, "lens 5"]
    weight: Float[np.ndarray, "lens 5"]  # cost added: weight * (value - prior)^2, in pixels^2
    focal_of: Int[np.ndarray, " lens"]
    offset: Float[np.ndarray, " lens"]

    @property
    def resolved(self) -> Float[np.ndarray, "lens 5"]:
        """The values with focals that follow others' filled in."""
        values = self.values.copy()
        values[:, LOG_FOCAL] = self.values[self.focal_of, LOG_FOCAL] + self.offset
        return values

    @classmethod
    def nominal(cls, count: int) -> Lenses:
        """Lenses as the given focals and centres say, without distortion, fixed, without bounds or priors."""
        shape = (count, LENS_PARAMETERS)
        return cls(
            values=np.zeros(shape),
            free=np.zeros(shape, bool),
            low=np.full(shape, -np.inf),
            high=np.full(shape, np.inf),
            prior=np.zeros(shape),
            weight=np.zeros(shape),
            focal_of=np.arange(count),
            offset=np.zeros(count),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleProblem:
    """Cameras, points and observations. Each point is observed at most once per camera."""

    rotations: Float[np.ndarray, "camera 3 3"]  # cam_from_world
    translations: Float[np.ndarray, "camera 3"]
    focals_px: Float[np.ndarray, "camera 2"]  # fx, fy before the lens's factor
    centres_px: Float[np.ndarray, "camera 2"]  # principal points before the lens's shift
    points: Float[np.ndarray, "point 3"]
    camera_index: Int[np.ndarray, " observation"]
    point_index: Int[np.ndarray, " observation"]
    pixel_xy: Float[np.ndarray, "observation 2"]
    camera_free: Bool[np.ndarray, " camera"]
    lens_index: Int[np.ndarray, " camera"]
    lenses: Lenses
    shift_unit_px: Float[np.ndarray, "camera 2"]  # pixels per unit of the lens's shift
    points_free: bool = True
    robust_px: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleResult:
    """The adjusted problem and what is known about its quality."""

    problem: BundleProblem
    cost: float
    errors_px: Float[np.ndarray, " observation"]
    iterations: int
    lens_sigma: Float[
        np.ndarray, "lens 5"
    ]  # from the inverse of the reduced system, per pixel of noise; inf where fixed


@dataclass(frozen=True, slots=True, kw_only=True)
class Linearisation:
    """Residuals and their derivatives. Observations come last: what is done to all of them then runs along memory."""

    residual: Float[np.ndarray, "2 observation"]
    camera: Float[np.ndarray, "2 6 observation"]  # d residual / d (w, t)
    point: Float[np.ndarray, "2 3 observation"]
    lens: Float[np.ndarray, "2 5 observation"]  # d residual / d parameters of the camera's lens


@dataclass(frozen=True, slots=True, kw_only=True)
class _Projection:
    """Points in their cameras and where they fall, with what the derivatives need."""

    rotation: Float[np.ndarray, "3 3 observation"]  # of the camera
    rotated: Float[np.ndarray, "3 observation"]  # R X
    depth: Float[np.ndarray, " observation"]
    in_front: Bool[np.ndarray, " observation"]
    plane_xy: Float[np.ndarray, "2 observation"]  # x / z before distortion
    radius2: Float[np.ndarray, " observation"]
    k1: Float[np.ndarray, " observation"]
    k2: Float[np.ndarray, " observation"]
    gain: Float[np.ndarray, " observation"]  # 1 + k1 r^2 + k2 r^4
    focal_px: Float[np.ndarray, "2 observation"]
    residual: Float[np.ndarray, "2 observation"]


def _project(problem: BundleProblem) -> _Projection:
    camera = problem.camera_index
    rotation = _per_observation(problem.rotations, camera)
    x, y, z = _per_observation(problem.points, problem.point_index)
    rotated = rotation[:, 0] * x + rotation[:, 1] * y + rotation[:, 2] * z
    in_camera = rotated + _per_observation(problem.translations, camera)
    lens = problem.lenses.resolved[problem.lens_index]  # (camera, 5)
    focal = _per_observation(problem.focals_px * np.exp(lens[:, LOG_FOCAL, None]), camera)
    centre = _per_observation(problem.centres_px + problem.shift_unit_px * lens[:, SHIFT_X : SHIFT_Y + 1], camera)
    depth = np.maximum(in_camera[2], _MIN_DEPTH)
    plane_xy = in_camera[:2] / depth
    radius2 = plane_xy[0] ** 2 + plane_xy[1] ** 2
    k1, k2 = _per_observation(lens[:, K1 : K2 + 1], camera)
    gain = 1.0 + radius2 * (k1 + radius2 * k2)
    return _Projection(
        rotation=rotation,
        rotated=rotated,
        depth=depth,
        in_front=in_camera[2] > _MIN_DEPTH,
        plane_xy=plane_xy,
        radius2=radius2,
        k1=k1,
        k2=k2,
        gain=gain,
        focal_px=focal,
        residual=focal * plane_xy * gain + centre - problem.pixel_xy.T,
    )


def _per_observation(values: np.ndarray, index: Int[np.ndarray, " observation"]) -> np.ndarray:
    """Rows of a table by number, the number last."""
    return np.ascontiguousarray(values.transpose(*range(1, values.ndim), 0)).take(index, axis=-1)


def residuals(problem: BundleProblem) -> Float[np.ndarray, "observation 2"]:
    """Reprojected minus observed pixel, per observation."""
    return _project(problem).residual.T


def linearise(problem: BundleProblem) -> Linearisation:
    """Residuals and analytic Jacobians at the current parameters."""
    at = _project(problem)
    count = len(problem.camera_index)
    # d distorted / d plane_xy = gain I + 2 (k1 + 2 k2 r^2) u u^T
    bend = 2.0 * (at.k1 + 2.0 * at.k2 * at.radius2)
    u, v = at.plane_xy
    bend_u, bend_v = bend * u, bend * v
    across = ((at.gain + bend_u * u, bend_u * v), (bend_u * v, at.gain + bend_v * v))
    x, y, z = at.rotated
    camera, point = np.empty((2, 6, count)), np.empty((2, 3, count))
    for image_axis, (by_u, by_v) in enumerate(across):
        scale = at.focal_px[image_axis] / at.depth
        # d pixel / d point-in-camera; behind the camera depth is held.
        by_x, by_y = scale * by_u, scale * by_v
        by_z = np.where(at.in_front, -(by_x * u + by_y * v), 0.0)
        # d (exp([w]x) R X) / dw = -[R X]x
        row = camera[image_axis]
        row[0], row[1], row[2] = by_z * y - by_y * z, by_x * z - by_z * x, by_y * x - by_x * y
        row[3], row[4], row[5] = by_x, by_y, by_z
        point[image_axis] = by_x * at.rotation[0] + by_y * at.rotation[1] + by_z * at.rotation[2]
    scaled = at.focal_px * at.plane_xy
    lens = np.zeros((2, LENS_PARAMETERS, count))
    lens[:, LOG_FOCAL] = scaled * at.gain
    lens[0, SHIFT_X], lens[1, SHIFT_Y] = _per_observation(problem.shift_unit_px, problem.camera_index)
    lens[:, K1] = scaled * at.radius2
    lens[:, K2] = lens[:, K1] * at.radius2
    return Linearisation(residual=at.residual, camera=camera, point=point, lens=lens)


def robust_cost(problem: BundleProblem, residual: Float[np.ndarray, "observation 2"]) -> float:
    """Sum of Cauchy losses plus the priors on the lenses."""
    scale = problem.robust_px**2
    lenses = problem.lenses
    prior = (lenses.weight * (lenses.values - lenses.prior) ** 2).sum()
    return float(scale * np.log1p((residual**2).sum(1) / scale).sum() + prior)


def adjust(problem: BundleProblem, *, max_iterations: int = 40) -> BundleResult:
    """Minimise the robust reprojection error. Never returns a higher cost than it was given."""
    if len(problem.camera_index) == 0:
        unknown = np.full(problem.lenses.values.shape, np.inf)
        return BundleResult(problem=problem, cost=0.0, errors_px=np.zeros(0), iterations=0, lens_sigma=unknown)
    damping = 1e-4
    cost = robust_cost(problem, residuals(problem))
    iteration = 0
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
    sigma = np.full(problem.lenses.values.shape, np.inf)
    if problem.lenses.free.any():
        sigma = _NormalEquations(problem).lens_sigma()
    return BundleResult(
        problem=problem,
        cost=cost,
        errors_px=np.linalg.norm(residuals(problem), axis=1),
        iterations=iteration,
        lens_sigma=sigma,
    )


def direction_sigma_deg(problem: BundleProblem) -> Float[np.ndarray, "camera camera"]:
    """Standard deviation, in degrees, of the direction from each camera to each other for one pixel of noise.

    Everything that is free counts: points, lenses, and the other cameras. NaN for cameras without observations and on the diagonal.
    """
    equations = _NormalEquations(problem)
    covariance = equations.camera_covariance()
    count = len(problem.camera_free)
    # d centre / d (w, t) = -R^T [[t]x, I]; cameras that are held do not move.
    moves = np.zeros((count, 3, covariance.shape[0]))
    for block, camera in enumerate(np.flatnonzero(problem.camera_free)):
        x, y, z = problem.translations[camera]
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        moves[camera][:, 6 * block : 6 * block + 6] = -problem.rotations[camera].T @ np.concatenate(
            [cross, np.eye(3)], 1
        )
    centres = -np.einsum("cji,cj->ci", problem.rotations, problem.translations)
    sigma = np.full((count, count), np.nan)
    seen = np.unique(problem.camera_index)
    for i, a in enumerate(seen):
        for b in seen[i + 1 :]:
            base = centres[b] - centres[a]
            length = float(np.linalg.norm(base))
            if length < 1e-12:
                sigma[a, b] = sigma[b, a] = 180.0
                continue
            across = np.eye(3) - np.outer(base, base) / length**2  # what is along the base line changes no direction
            by = across @ (moves[b] - moves[a])
            variance = float(np.linalg.eigvalsh(by @ covariance @ by.T)[-1])
            sigma[a, b] = sigma[b, a] = min(np.rad2deg(np.sqrt(max(variance, 0.0)) / length), 180.0)
    return sigma


class _NormalEquations:
    """Robustly weighted normal equations of one linearisation, solved for several dampings."""

    def __init__(self, problem: BundleProblem) -> None:
        self.problem = problem
        parts = linearise(problem)
        weight = np.sqrt(1.0 / (1.0 + (parts.residual**2).sum(0) / problem.robust_px**2))
        self._residual = parts.residual * weight
        self._jac_camera = parts.camera * weight
        self._jac_point = parts.point * weight
        self._jac_lens = parts.lens * weight
        self._free = np.flatnonzero(problem.camera_free)
        # A lens that no observation looks through has nothing to say.
        self._cameras = np.flatnonzero(np.bincount(problem.camera_index))  # those with observations
        looked_through = problem.lens_index[self._cameras]
        used = np.zeros(problem.lenses.values.shape, bool)
        used[looked_through, 1:] = True
        used[problem.lenses.focal_of[looked_through], LOG_FOCAL] = True
        self._free_lens = np.argwhere(problem.lenses.free & used)  # (column, (lens, parameter))
        self._size = 6 * len(self._free) + len(self._free_lens)
        self._accumulate()
        if problem.points_free:
            self._accumulate_points()

    def _accumulate(self) -> None:
        """Camera and lens blocks of J^T J and of the gradient; their coupling with the points."""
        problem, size = self.problem, self._size
        count = len(problem.points)
        self._hessian = np.zeros((size, size))
        self._gradient = np.zeros(size)
        self._coupling = np.zeros((size, 3, count)) if problem.points_free else None
        block_of = np.full(len(problem.camera_free), -1)
        block_of[self._free] = np.arange(len(self._free))
        free_rows, free_parameters = self._free_lens.T
        for camera in self._cameras:
            lens = int(problem.lens_index[camera])
            focal_row = problem.lenses.focal_of[lens]
            own = np.flatnonzero(free_rows == np.where(free_parameters == LOG_FOCAL, focal_row, lens))
            parameters = self._free_lens[own, 1]
            columns = 6 * len(self._free) + own
            rows = np.flatnonzero(problem.camera_index == camera)
            jacobian = self._jac_lens[:, parameters][:, :, rows]
            if block_of[camera] >= 0:
                columns = np.concatenate([6 * block_of[camera] + np.arange(6), columns])
                jacobian = np.concatenate([self._jac_camera.take(rows, axis=2), jacobian], 1)
            if len(columns) == 0:
                continue
            flat = np.concatenate(list(jacobian), 1)
            self._hessian[np.ix_(columns, columns)] += flat @ flat.T
            self._gradient[columns] += flat @ self._residual.take(rows, axis=1).reshape(-1)
            if self._coupling is not None:
                # Each point is seen at most once per camera: no index occurs twice here.
                by_point = self._jac_point.take(rows, axis=2)
                product = jacobian[0][:, None] * by_point[0] + jacobian[1][:, None] * by_point[1]
                seen = problem.point_index[rows]
                for place, part in zip(columns, product, strict=True):
                    self._coupling[place][:, seen] += part
        lenses = problem.lenses
        for column, (lens, parameter) in enumerate(self._free_lens, start=6 * len(self._free)):
            weight = lenses.weight[lens, parameter]
            self._hessian[column, column] += weight
            self._gradient[column] += weight * (lenses.values[lens, parameter] - lenses.prior[lens, parameter])

    def _accumulate_points(self) -> None:
        """3x3 point blocks of J^T J and of the gradient."""
        index, count = self.problem.point_index, len(self.problem.points)
        self._point_hessian = np.zeros((3, 3, count))
        self._point_gradient = np.zeros((3, count))
        by_point = self._jac_point
        for i in range(3):
            weights = by_point[0, i] * self._residual[0] + by_point[1, i] * self._residual[1]
            self._point_gradient[i] = np.bincount(index, weights=weights, minlength=count)
            for j in range(i + 1):
                weights = by_point[0, i] * by_point[0, j] + by_point[1, i] * by_point[1, j]
                self._point_hessian[i, j] = np.bincount(index, weights=weights, minlength=count)

    def _reduced(self, damping: float) -> tuple[np.ndarray, np.ndarray, _PointBlocks | None]:
        """Schur complement of the points: (matrix, right-hand side, the points' blocks)."""
        hessian = self._hessian + np.diag(damping * np.diag(self._hessian) + 1e-12)
        if self._coupling is None:
            return hessian, -self._gradient, None
        blocks = _PointBlocks.factor(self._point_hessian, damping)
        half = blocks.solve_half(self._coupling).reshape(self._size, self._point_gradient.size)
        matrix = hessian - half @ half.T
        return matrix, -self._gradient + half @ blocks.solve_half(self._point_gradient).reshape(-1), blocks

    def step(self, damping: float) -> BundleProblem:
        """The problem after one damped Gauss-Newton step."""
        problem = self.problem
        matrix, rhs, blocks = self._reduced(damping)
        delta = np.linalg.lstsq(matrix, rhs, rcond=None)[0] if self._size else np.zeros(0)
        rotations, translations = problem.rotations.copy(), problem.translations.copy()
        for block, camera in enumerate(self._free):
            move = delta[6 * block : 6 * block + 6]
            rotations[camera] = rotation_exp(move[:3]) @ rotations[camera]
            translations[camera] = translations[camera] + move[3:]
        points = problem.points
        if self._coupling is not None and blocks is not None:
            pull = -self._point_gradient - np.tensordot(delta, self._coupling, 1)
            points = points + blocks.solve(pull).T
        lenses = problem.lenses
        if len(self._free_lens):
            values = lenses.values.copy()
            at = tuple(self._free_lens.T)
            values[at] = np.clip(values[at] + delta[6 * len(self._free) :], lenses.low[at], lenses.high[at])
            lenses = replace(lenses, values=values)
        return replace(problem, rotations=rotations, translations=translations, points=points, lenses=lenses)

    def camera_covariance(self) -> Float[np.ndarray, "parameter parameter"]:
        """Covariance of (w, t) of the free cameras, in order, for one pixel of noise; all else marginalised."""
        matrix, _, _ = self._reduced(_GAUGE_DAMPING)
        count = 6 * len(self._free)
        return np.linalg.pinv(matrix, rcond=1e-14, hermitian=True)[:count, :count]

    def lens_sigma(self) -> Float[np.ndarray, "lens 5"]:
        """Standard deviations of the free lens parameters for one pixel of noise, all others marginalised; inf where fixed."""
        matrix, _, _ = self._reduced(1e-9)
        covariance = np.linalg.pinv(matrix, rcond=1e-14, hermitian=True)
        sigma = np.full(self.problem.lenses.values.shape, np.inf)
        variances = np.diag(covariance)[6 * len(self._free) :]
        sigma[tuple(self._free_lens.T)] = np.sqrt(np.maximum(variances, 0.0))
        return sigma


@dataclass(frozen=True, slots=True, kw_only=True)
class _PointBlocks:
    """Damped 3x3 blocks of all points as L D L^T, written out: LAPACK's calls cost more than the arithmetic of blocks this small."""

    inverse_root: Float[np.ndarray, "3 point"]  # D^-1/2
    m10: Float[np.ndarray, " point"]  # of L^-1, below its diagonal of ones
    m20: Float[np.ndarray, " point"]
    m21: Float[np.ndarray, " point"]

    @classmethod
    def factor(cls, hessian: Float[np.ndarray, "3 3 point"], damping: float) -> _PointBlocks:
        """Blocks of which only the lower triangle is read. Points without observations get a unit block: they do not move."""
        diagonal = hessian[[0, 1, 2], [0, 1, 2]]
        a00, a11, a22 = diagonal * (1.0 + damping) + np.where(diagonal > 0, 1e-12, 1.0)
        a10, a20, a21 = hessian[1, 0], hessian[2, 0], hessian[2, 1]
        l10, l20 = a10 / a00, a20 / a00
        d1 = a11 - l10 * a10
        l21 = (a21 - l20 * a10) / d1
        d2 = a22 - l20 * a20 - l21 * l21 * d1
        # A block that rounding has made indefinite moves its point nowhere instead of anywhere.
        pivots = np.stack([a00, d1, d2])
        root = np.sqrt(np.where(pivots > _LEAST_PIVOT * np.stack([a00, a11, a22]), pivots, np.inf))
        return cls(inverse_root=1.0 / root, m10=-l10, m20=l10 * l21 - l20, m21=-l21)

    def solve_half(self, values: Float[np.ndarray, "*columns 3 point"]) -> Float[np.ndarray, "*columns 3 point"]:
        """D^-1/2 L^-1 values: products of two such results are products with the blocks' inverses."""
        x, y, z = values[..., 0, :], values[..., 1, :], values[..., 2, :]
        half = np.empty_like(values)
        np.multiply(x, self.inverse_root[0], out=half[..., 0, :])
        np.multiply(y + self.m10 * x, self.inverse_root[1], out=half[..., 1, :])
        np.multiply(z + self.m20 * x + self.m21 * y, self.inverse_root[2], out=half[..., 2, :])
        return half

    def solve(self, values: Float[np.ndarray, "3 point"]) -> Float[np.ndarray, "3 point"]:
        """The blocks' inverses times values."""
        x, y, z = self.solve_half(values) * self.inverse_root
        return np.stack([x + self.m10 * y + self.m20 * z, y + self.m21 * z, z])


def rotation_exp(vector: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Rotation matrix of a rotation vector (Rodrigues), accurate near zero."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-8:
        return np.eye(3) + cross
    return np.eye(3) + np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * cross @ cross
