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
    """Residuals and their derivatives, per observation."""

    residual: Float[np.ndarray, "observation 2"]
    camera: Float[np.ndarray, "observation 2 6"]  # d residual / d (w, t)
    point: Float[np.ndarray, "observation 2 3"]
    lens: Float[np.ndarray, "observation 2 5"]  # d residual / d parameters of the camera's lens


@dataclass(frozen=True, slots=True, kw_only=True)
class _Projection:
    """Points in their cameras and where they fall, with what the derivatives need."""

    rotated: Float[np.ndarray, "observation 3"]  # R X
    depth: Float[np.ndarray, " observation"]
    in_front: Bool[np.ndarray, " observation"]
    plane_xy: Float[np.ndarray, "observation 2"]  # x / z before distortion
    radius2: Float[np.ndarray, " observation"]
    gain: Float[np.ndarray, " observation"]  # 1 + k1 r^2 + k2 r^4
    focal_px: Float[np.ndarray, "observation 2"]
    residual: Float[np.ndarray, "observation 2"]


def _project(problem: BundleProblem) -> _Projection:
    camera = problem.camera_index
    rotated = np.einsum("oij,oj->oi", problem.rotations[camera], problem.points[problem.point_index])
    in_camera = rotated + problem.translations[camera]
    lens = problem.lenses.resolved[problem.lens_index]  # (camera, 5)
    focal = (problem.focals_px * np.exp(lens[:, LOG_FOCAL, None]))[camera]
    centre = (problem.centres_px + problem.shift_unit_px * lens[:, SHIFT_X : SHIFT_Y + 1])[camera]
    depth = np.maximum(in_camera[:, 2], _MIN_DEPTH)
    plane_xy = in_camera[:, :2] / depth[:, None]
    radius2 = (plane_xy**2).sum(1)
    gain = 1.0 + radius2 * (lens[camera, K1] + radius2 * lens[camera, K2])
    return _Projection(
        rotated=rotated,
        depth=depth,
        in_front=in_camera[:, 2] > _MIN_DEPTH,
        plane_xy=plane_xy,
        radius2=radius2,
        gain=gain,
        focal_px=focal,
        residual=focal * plane_xy * gain[:, None] + centre - problem.pixel_xy,
    )


def residuals(problem: BundleProblem) -> Float[np.ndarray, "observation 2"]:
    """Reprojected minus observed pixel, per observation."""
    return _project(problem).residual


def linearise(problem: BundleProblem) -> Linearisation:
    """Residuals and analytic Jacobians at the current parameters."""
    camera = problem.camera_index
    at = _project(problem)
    rotation = problem.rotations[camera]
    k1, k2 = problem.lenses.values[problem.lens_index[camera]][:, [K1, K2]].T
    # d distorted / d plane_xy = gain I + 2 (k1 + 2 k2 r^2) u u^T
    bend = 2.0 * (k1 + 2.0 * k2 * at.radius2)
    u, v = at.plane_xy.T
    fx, fy = at.focal_px.T
    across = np.empty((len(camera), 2, 2))
    across[:, 0, 0] = fx * (at.gain + bend * u * u)
    across[:, 0, 1] = fx * bend * u * v
    across[:, 1, 0] = fy * bend * u * v
    across[:, 1, 1] = fy * (at.gain + bend * v * v)
    # d pixel / d point-in-camera.
    projection = np.zeros((len(camera), 2, 3))
    projection[:, :, :2] = across / at.depth[:, None, None]
    along = across[:, :, 0] * u[:, None] + across[:, :, 1] * v[:, None]
    projection[:, :, 2] = np.where(at.in_front[:, None], -along / at.depth[:, None], 0.0)
    # d (exp([w]x) R X) / dw = -[R X]x
    x, y, z = at.rotated.T
    zero = np.zeros_like(x)
    minus_cross = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], 1).reshape(-1, 3, 3)
    scaled = at.focal_px * at.plane_xy
    lens = np.zeros((len(camera), 2, LENS_PARAMETERS))
    lens[:, :, LOG_FOCAL] = scaled * at.gain[:, None]
    lens[:, 0, SHIFT_X], lens[:, 1, SHIFT_Y] = problem.shift_unit_px[camera].T
    lens[:, :, K1] = scaled * at.radius2[:, None]
    lens[:, :, K2] = scaled * (at.radius2**2)[:, None]
    return Linearisation(
        residual=at.residual,
        camera=np.concatenate([projection @ minus_cross, projection], 2),
        point=projection @ rotation,
        lens=lens,
    )


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
        weight = np.sqrt(1.0 / (1.0 + (parts.residual**2).sum(1) / problem.robust_px**2))
        self._residual = parts.residual * weight[:, None]
        self._jac_camera = parts.camera * weight[:, None, None]
        self._jac_point = parts.point * weight[:, None, None]
        self._jac_lens = parts.lens * weight[:, None, None]
        self._free = np.flatnonzero(problem.camera_free)
        # A lens that no observation looks through has nothing to say.
        looked_through = np.unique(problem.lens_index[problem.camera_index])
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
        self._coupling = np.zeros((size, count, 3)) if problem.points_free else None
        block_of = np.full(len(problem.camera_free), -1)
        block_of[self._free] = np.arange(len(self._free))
        rows, parameters = self._free_lens.T
        columns_of = [
            np.flatnonzero(np.where(parameters == LOG_FOCAL, rows == problem.lenses.focal_of[lens], rows == lens))
            for lens in range(len(problem.lenses.values))
        ]
        for camera in np.unique(problem.camera_index):
            lens = int(problem.lens_index[camera])
            own = columns_of[lens]
            parameters = self._free_lens[own, 1]
            columns = 6 * len(self._free) + own
            rows = np.flatnonzero(problem.camera_index == camera)
            jacobian = self._jac_lens[rows][:, :, parameters]
            if block_of[camera] >= 0:
                columns = np.concatenate([6 * block_of[camera] + np.arange(6), columns])
                jacobian = np.concatenate([self._jac_camera[rows], jacobian], 2)
            if len(columns) == 0:
                continue
            flat = jacobian.reshape(-1, len(columns))
            self._hessian[np.ix_(columns, columns)] += flat.T @ flat
            self._gradient[columns] += flat.T @ self._residual[rows].reshape(-1)
            if self._coupling is not None:
                # Each point is seen at most once per camera: no index occurs twice here.
                product = np.einsum("oic,oip->cop", jacobian, self._jac_point[rows])
                self._coupling[columns[:, None], problem.point_index[rows][None]] += product
        lenses = problem.lenses
        for column, (lens, parameter) in enumerate(self._free_lens, start=6 * len(self._free)):
            weight = lenses.weight[lens, parameter]
            self._hessian[column, column] += weight
            self._gradient[column] += weight * (lenses.values[lens, parameter] - lenses.prior[lens, parameter])

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


def rotation_exp(vector: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Rotation matrix of a rotation vector (Rodrigues), accurate near zero."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-8:
        return np.eye(3) + cross
    return np.eye(3) + np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * cross @ cross
