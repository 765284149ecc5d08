"""One view against other cameras, by its matches alone: pose and lens at which they lie on each other's epipolar lines.

Points triangulated from distant cameras are uncertain in depth by more than a wrong focal moves them; matches between pictures are not.
So this is the sharper test of a lens, and it does not depend on points that a wrong camera may have helped to make.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from sceneexpander.frontend.bundle import LENS_PARAMETERS, rotation_exp
from sceneexpander.frontend.resection import intrinsics_through

_LIMIT = 6.0  # times the noise: errors are counted up to here
_MOST_MATCHES = 250  # used per other view
_PARALLEL = 0.01  # sine of the angle between two rays below which they may as well meet in front as behind
_ITERATIONS = 25
_STEP = 1e-6  # of the numerical derivatives
_PRIOR_INFLATION = 8.0  # as in mapping: that many correlated errors count as one


@dataclass(frozen=True, slots=True, kw_only=True)
class OtherView:
    """A camera that is believed (cam_from_world), and its matches with the view in question."""

    view: int
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, " 3"]
    intrinsics: Float[np.ndarray, "3 3"]
    own_xy: Float[np.ndarray, "match 2"]
    view_xy: Float[np.ndarray, "match 2"]


@dataclass(frozen=True, slots=True, kw_only=True)
class LensFreedom:
    """Which parameters of a lens may move, within bounds, around a prior (sigma inf: none)."""

    free: Bool[np.ndarray, " 5"]
    low: Float[np.ndarray, " 5"]
    high: Float[np.ndarray, " 5"]
    prior: Float[np.ndarray, " 5"]
    sigma: Float[np.ndarray, " 5"]


@dataclass(frozen=True, slots=True, kw_only=True)
class EpipolarView:
    """Pose and lens of a view; ``cost`` is 0 if all matches lie on their lines and 1 if none comes near."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, " 3"]
    lens: Float[np.ndarray, " 5"]
    cost: float


class EpipolarFit:
    """The matches of one view with cameras that are believed; ``noise_px`` is the scale of an ordinary error."""

    def __init__(
        self,
        others: Sequence[OtherView],
        start: Float[np.ndarray, "3 3"],
        shift_unit_px: Float[np.ndarray, " 2"],
        *,
        noise_px: float,
    ) -> None:
        self._start, self._shift_unit, self._noise = start, shift_unit_px, noise_px
        rays, centres, view_xy, to_pixels = [], [], [], []
        for other in others:
            step = max(1, len(other.own_xy) // _MOST_MATCHES)
            own = np.concatenate([other.own_xy[::step], np.ones((len(other.own_xy[::step]), 1))], 1)
            world_from_pixel = other.rotation.T @ np.linalg.inv(other.intrinsics)
            rays.append(world_from_pixel @ own.T)
            centres.append(np.broadcast_to((-other.rotation.T @ other.translation)[:, None], (3, len(own))))
            view_xy.append(other.view_xy[::step].T)
            to_pixels.append(np.broadcast_to(world_from_pixel[:, :2, None], (3, 2, len(own))))
        # Matches come last: what is done to all of them then runs along memory.
        self._rays, self._centres = np.concatenate(rays, 1), np.concatenate(centres, 1)
        self._view = np.concatenate([*np.concatenate(view_xy, 1), np.ones(self.count)]).reshape(3, -1)
        self._to_pixels = np.concatenate(to_pixels, 2)

    @property
    def count(self) -> int:
        """Number of matches looked at."""
        return self._rays.shape[1]

    def errors_px(
        self, rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, " 3"], lens: Float[np.ndarray, " 5"]
    ) -> Float[np.ndarray, " match"]:
        """Signed Sampson distance of each match."""
        world_from_pixel = rotation.T @ np.linalg.inv(intrinsics_through(self._start, self._shift_unit, lens))
        view_rays = world_from_pixel @ self._view
        base = self._centres + (rotation.T @ translation)[:, None]  # from this camera to the other
        normal = _cross(base, self._rays)  # of the epipolar plane through the other view's ray
        algebraic = (view_rays * normal).sum(0)
        by_view = world_from_pixel[:, :2].T @ normal
        by_other = (_cross(view_rays, base)[:, None] * self._to_pixels).sum(0)
        slope = np.sqrt((by_view**2).sum(0) + (by_other**2).sum(0))
        return algebraic / np.maximum(slope, 1e-12)

    def behind(
        self, rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, " 3"], lens: Float[np.ndarray, " 5"]
    ) -> Bool[np.ndarray, " match"]:
        """Which matches meet behind one of the cameras. Rays that are nearly parallel meet nowhere for certain, and are not counted."""
        world_from_pixel = rotation.T @ np.linalg.inv(intrinsics_through(self._start, self._shift_unit, lens))
        view_rays = world_from_pixel @ self._view
        base = self._centres + (rotation.T @ translation)[:, None]
        aa, bb, ab = (view_rays**2).sum(0), (self._rays**2).sum(0), (view_rays * self._rays).sum(0)
        a_base, b_base = (view_rays * base).sum(0), (self._rays * base).sum(0)
        across = aa * bb - ab**2
        depths = np.stack([bb * a_base - ab * b_base, ab * a_base - aa * b_base])  # times ``across``, which is positive
        return (depths < 0).any(0) & (across > _PARALLEL**2 * aa * bb)

    def judge(
        self, rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, " 3"], lens: Float[np.ndarray, " 5"]
    ) -> EpipolarView:
        """A pose and a lens with what they leave unexplained."""
        errors = np.minimum(np.abs(self.errors_px(rotation, translation, lens)) / self._noise, _LIMIT)
        cost = float((np.log1p(errors**2) / np.log1p(_LIMIT**2)).mean())
        return EpipolarView(rotation=rotation, translation=translation, lens=lens, cost=cost)

    def refine(
        self,
        rotation: Float[np.ndarray, "3 3"],
        translation: Float[np.ndarray, " 3"],
        lens: Float[np.ndarray, " 5"],
        freedom: LensFreedom,
    ) -> EpipolarView:
        """The nearest pose and lens that leave least unexplained: Levenberg-Marquardt on a Cauchy loss."""
        columns = np.flatnonzero(freedom.free)
        base = np.linalg.norm(self._centres + (rotation.T @ translation)[:, None], axis=0)
        length = max(float(np.median(base)), 1e-9)
        weight = np.zeros(6 + len(columns))
        weight[6:] = _PRIOR_INFLATION * (self._noise / freedom.sigma[columns]) ** 2

        def moved(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            turn, values = rotation_exp(x[:3]), np.array(lens, np.float64)
            values[columns] = np.clip(values[columns] + x[6:], freedom.low[columns], freedom.high[columns])
            return turn @ rotation, turn @ translation + length * x[3:6], values

        def pull(values: np.ndarray) -> np.ndarray:
            return np.concatenate([np.zeros(6), values[columns] - freedom.prior[columns]])

        def cost_of(x: np.ndarray) -> tuple[float, np.ndarray]:
            now = moved(x)
            errors = self.errors_px(*now)
            loss = self._noise**2 * np.log1p((errors / self._noise) ** 2).sum()
            return float(loss + (weight * pull(now[2]) ** 2).sum()), errors

        x, damping = np.zeros(6 + len(columns)), 1e-3
        cost, errors = cost_of(x)
        for _ in range(_ITERATIONS):
            jacobian = np.stack(
                [(self.errors_px(*moved(x + _STEP * axis)) - errors) / _STEP for axis in np.eye(len(x))], 1
            )
            robust = 1.0 / (1.0 + (errors / self._noise) ** 2)
            hessian = (jacobian * robust[:, None]).T @ jacobian + np.diag(weight)
            gradient = jacobian.T @ (robust * errors) + weight * pull(moved(x)[2])
            before = cost
            while damping < 1e8:
                step = np.linalg.lstsq(hessian + damping * np.diag(np.diag(hessian) + 1e-12), -gradient, rcond=None)[0]
                trial, trial_errors = cost_of(x + step)
                if trial < cost:
                    x, cost, errors = x + step, trial, trial_errors
                    damping = max(damping / 5.0, 1e-9)
                    break
                damping *= 5.0
            if before - cost < 1e-5 * before:
                break
        return self.judge(*moved(x))


def _cross(a: Float[np.ndarray, "3 match"], b: Float[np.ndarray, "3 match"]) -> Float[np.ndarray, "3 match"]:
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def held_lens() -> LensFreedom:
    """Nothing of the lens moves."""
    return freedom_of({}, np.zeros(LENS_PARAMETERS))


def freedom_of(parameters: dict[int, tuple[float, float, float]], prior: Float[np.ndarray, " 5"]) -> LensFreedom:
    """The named parameters free: (low, high, sigma) of each, the sigma around ``prior``."""
    free = np.zeros(LENS_PARAMETERS, bool)
    low, high = np.full(LENS_PARAMETERS, -np.inf), np.full(LENS_PARAMETERS, np.inf)
    sigma = np.full(LENS_PARAMETERS, np.inf)
    for parameter, (least, most, spread) in parameters.items():
        free[parameter], low[parameter], high[parameter], sigma[parameter] = True, least, most, spread
    return LensFreedom(free=free, low=low, high=high, prior=prior, sigma=sigma)
