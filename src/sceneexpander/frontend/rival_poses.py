"""Another place from which a view's matches would look the same.

The matches of two pictures of one flat surface have two explanations: the motion, and another one with another slope of the surface
(Longuet-Higgins, "The reconstruction of a plane surface from two perspective projections", 1986). A little relief decides, if there is
enough of it to be seen over the errors of keypoints. Whether there is, is what this module asks.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from jaxtyping import Float

from sceneexpander.frontend.epipolar import EpipolarFit, EpipolarView, OtherView, held_lens
from sceneexpander.frontend.twoview import usac_parameters

_FLAT_SHARE = 0.6  # of the matches with another view lie on one plane
_MOST_BEHIND = 0.2  # share of the matches that meet behind a camera


def largest_rival_angle_deg(
    fit: EpipolarFit,
    best: EpipolarView,
    other: OtherView,
    intrinsics: Float[np.ndarray, "3 3"],
    *,
    threshold_px: float,
    still_fits: float,
    seed: int,
) -> float:
    """How far (degrees) the direction to the other view moves to the farthest pose that fits about as well; 0 without one.

    Args:
        fit: of the view's matches with ``other``.
        best: pose and lens of the view, refined over ``fit``.
        other: a camera that is believed.
        intrinsics: of the view.
        threshold_px: error of a match that lies on a plane.
        still_fits: times what ``best`` leaves unexplained: a pose that leaves less than this fits as well.
        seed: of the robust fit.
    """
    worst = 0.0
    for start in _poses_of_plane(best, other, intrinsics, threshold_px=threshold_px, seed=seed):
        rival = fit.refine(start.rotation, start.translation, best.lens, held_lens())
        behind = fit.behind(rival.rotation, rival.translation, rival.lens).mean()
        if rival.cost < still_fits * best.cost and behind < _MOST_BEHIND:
            worst = max(worst, float(direction_changes_deg(best, rival, [other])[0]))
    return worst


def direction_changes_deg(
    one: EpipolarView, other: EpipolarView, neighbours: Sequence[OtherView]
) -> Float[np.ndarray, " view"]:
    """Angle between the directions to each neighbour from two poses of a view."""
    angles = []
    for neighbour in neighbours:
        centre = -neighbour.rotation.T @ neighbour.translation
        a, b = (centre + pose.rotation.T @ pose.translation for pose in (one, other))
        angles.append(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
    return np.array(angles)


def _poses_of_plane(
    best: EpipolarView, other: OtherView, intrinsics: Float[np.ndarray, "3 3"], *, threshold_px: float, seed: int
) -> Iterator[EpipolarView]:
    """Poses that the plane most matches lie on leaves open, as far from the other view as the pose found is; none without such a plane."""
    matrix, mask = cv2.findHomography(other.own_xy, other.view_xy, usac_parameters(threshold_px, seed))
    if matrix is None or mask.mean() < _FLAT_SHARE:
        return
    plane = np.linalg.inv(intrinsics) @ matrix @ other.intrinsics
    count, rotations, translations, _ = cv2.decomposeHomographyMat(plane, np.eye(3))
    apart = float(np.linalg.norm(best.rotation.T @ best.translation - other.rotation.T @ other.translation))
    for turn, step in zip(rotations[:count], translations[:count], strict=True):
        length = float(np.linalg.norm(step))
        if length > 0:
            yield EpipolarView(
                rotation=turn @ other.rotation,
                translation=turn @ other.translation + step.ravel() * (apart / length),
                lens=best.lens,
                cost=1.0,
            )
