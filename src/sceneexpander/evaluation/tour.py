"""Whether the frames of the camera path show one rigid place, seen by just these cameras. Needs neither truth nor a judge.

- Registration: the sparse front-end is given the frames and their lenses, not their poses. A frame is registered if it sees enough
  triangulated points, unless it repeats its neighbour although the camera moved.
- Cameras: area under the curve of pairs whose relative pose is right, up to 10 degrees (the larger of rotation and translation-direction
  error, Jin et al., IJCV 2021); a pair with an unregistered frame is 180 degrees off.
- TSED (thresholded symmetric epipolar distance; Yu et al., ICCV 2023): share of consecutive pairs with at least 10 matches whose median
  symmetric distance from the epipolar lines of the path's own cameras is below 2 pixels. In addition to the paper, matches must move as
  the rendered depth says they do, by half at least: a frame that is shown again lies on its own epipolar lines whenever a camera only
  translates.
- Steadiness: mean local correlation of consecutive frames after the next one is warped into the first by rendered depth and cameras; 0
  where nothing has structure.

Being one rigid place is not being a plausible one: a frozen cloud of specks is rigid, too. Ghosting and the fidelity of the views say
the other half.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean, median

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.catalogue.metrics import metrics_named
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.measure import Measure, Subject, Values
from sceneexpander.frontend.features import detect_features, grey_u8
from sceneexpander.frontend.sfm import estimate_cameras
from sceneexpander.frontend.sfm_types import LearnedUse, SfmConfig
from sceneexpander.frontend.twoview import match_descriptors
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.randomness import child_generator
from sceneexpander.geometry.rigid import rigid_inverse, rotation_angle_deg
from sceneexpander.splatting import render

_FRONTEND = SfmConfig(learned=LearnedUse.NEVER, guided=False, max_features=1500, distortion_rounds=0)
_FEWEST_OBSERVATIONS = 15  # of triangulated points, for a frame to be registered
_WITHIN_DEG = 10
_TSED_MATCHES, _TSED_PX, _TSED_RATIO = 10, 2.0, 0.8
_STILL_PX = 0.5
_LEAST_MOTION_PX = 2.0  # expected by depth, below which two frames say nothing about parallax
_WINDOW = 9  # of the local correlation
_TEXTURED = 0.02
_SAME_DEPTH = 0.05
_FEWEST_WINDOWS = 64
_STANDING = 1e-3  # frames whose cameras are nearer, over the path's extent, and turned by less than a degree, are one


@dataclass(frozen=True, slots=True, kw_only=True)
class Frames:
    """What cameras of a path see: RGB on black, z-depth and alpha of the scene they are in."""

    rgb: Float[Tensor, "frame 3 height width"]
    depth: Float[Tensor, "frame height width"]
    alpha: Float[Tensor, "frame height width"]
    world_from_cam: Float[Tensor, "frame 4 4"]
    intrinsics_px: Float[Tensor, "frame 3 3"]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pair:
    """Two consecutive frames.

    Attributes:
        a: index of the first.
        b: index of the second.
        parallax_px: by how much the drawn part of the first moves in the second beyond what turning does, by its depth: median.
        repeats: its matches stand still although the camera moves or turns.
        consistent: the verdict of TSED.
    """

    a: int
    b: int
    parallax_px: float
    repeats: bool
    consistent: bool

    @classmethod
    def of(cls, frames: Frames, a: int, b: int) -> _Pair:
        """Match the frames and ask the path's cameras."""
        b_from_a = rigid_inverse(frames.world_from_cam[b].double()) @ frames.world_from_cam[a].double()
        parallax = _parallax_px(frames, a, b_from_a, focal := float(frames.intrinsics_px[b, 0, 0]))
        turned = focal * math.radians(float(rotation_angle_deg(b_from_a[:3, :3], torch.eye(3).double())))
        first, second = (detect_features(grey_u8(frames.rgb[i].cpu().numpy()), _FRONTEND) for i in (a, b))
        matches = match_descriptors(first, second, _FRONTEND)
        matches = matches.select(matches.ratio <= _TSED_RATIO)
        if matches.count < _TSED_MATCHES:
            return cls(a=a, b=b, parallax_px=parallax, repeats=False, consistent=False)
        xy_a, xy_b = first.pixel_xy[matches.index_a], second.pixel_xy[matches.index_b]
        lenses = [frames.intrinsics_px[i].double().cpu().numpy() for i in (a, b)]
        distance, moved = _epipolar_px(xy_a, xy_b, b_from_a.cpu().numpy(), *lenses)
        still = float(np.median(np.hypot(*(xy_b - xy_a).T))) < _STILL_PX
        return cls(
            a=a,
            b=b,
            parallax_px=parallax,
            repeats=still and parallax + turned >= _LEAST_MOTION_PX,
            consistent=bool(distance < _TSED_PX and moved > 0.5 * parallax),
        )


def _epipolar_px(
    xy_a: Float[np.ndarray, "match 2"],
    xy_b: Float[np.ndarray, "match 2"],
    b_from_a: Float[np.ndarray, "4 4"],
    lens_a: Float[np.ndarray, "3 3"],
    lens_b: Float[np.ndarray, "3 3"],
) -> tuple[float, float]:
    """Medians of the symmetric distance from epipolar lines, and of the motion beyond what turning does."""
    xy_a, xy_b = _homogeneous(xy_a), _homogeneous(xy_b)
    x, y, z = b_from_a[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    fundamental = np.linalg.inv(lens_b).T @ cross @ b_from_a[:3, :3] @ np.linalg.inv(lens_a)
    lines_b, lines_a = xy_a @ fundamental.T, xy_b @ fundamental
    algebraic = np.abs((xy_b * lines_b).sum(1))
    distance = 0.5 * sum(algebraic / np.maximum(np.hypot(*lines[:, :2].T), 1e-12) for lines in (lines_a, lines_b))
    far = xy_a @ (lens_b @ b_from_a[:3, :3] @ np.linalg.inv(lens_a)).T  # where points at infinity would be
    moved = np.hypot(*(xy_b[:, :2] - far[:, :2] / far[:, 2:]).T)
    return float(np.median(distance)), float(np.median(moved))


def _parallax_px(frames: Frames, a: int, b_from_a: Float[Tensor, "4 4"], focal_px: float) -> float:
    drawn = frames.alpha[a] > 0.5
    if not bool(drawn.any()):
        return math.inf  # whatever is asked of the frame, it does not show it
    return float(focal_px * b_from_a[:2, 3].norm() / frames.depth[a][drawn].double().median())


@torch.no_grad()
def see_frames(reconstruction: Reconstruction, path: Cameras, count: int) -> Frames:
    """Evenly spread frames of a path, those left out that stand where an earlier one does (paths return)."""
    chosen: list[int] = []
    extent = float((path.world_from_cam[:, :3, 3] - path.world_from_cam[:, :3, 3].mean(0)).norm(dim=-1).max())
    for index in np.linspace(0, len(path.world_from_cam) - 1, count).round().astype(int).tolist():
        pose = path.world_from_cam[index]
        if not any(_same_camera(pose, path.world_from_cam[other], extent) for other in chosen):
            chosen.append(index)
    seen = [render(reconstruction.gaussians, path[index]) for index in chosen]
    return Frames(
        rgb=torch.cat([one.rgb for one in seen]).clamp(0, 1),
        depth=torch.cat([one.depth for one in seen]),
        alpha=torch.cat([one.alpha for one in seen]),
        world_from_cam=path.world_from_cam[chosen],
        intrinsics_px=path.intrinsics_px[chosen],
    )


def _same_camera(a: Tensor, b: Tensor, extent: float) -> bool:
    turned = float(rotation_angle_deg(a[:3, :3], b[:3, :3]))
    return turned < 1 and float((a[:3, 3] - b[:3, 3]).norm()) <= _STANDING * extent


def measure_tour(frames: Frames, config: EvaluateConfig) -> dict[str, float | None]:
    """All numbers of the module by the catalogue's names; those of cameras that were not found are None.

    Raises:
        ValueError: a frame holds values that are not finite.
    """
    if not bool(torch.isfinite(frames.rgb).all()):
        raise ValueError("frames of the camera path hold non-finite values")
    pairs = [_Pair.of(frames, a, b) for a, b in itertools.pairwise(range(len(frames.rgb)))]
    return _registered(frames, pairs) | {"tour_tsed": tsed(pairs), "tour_steadiness": steadiness(frames, config)}


def _registered(frames: Frames, pairs: Sequence[_Pair]) -> dict[str, float | None]:
    """Registration and the fidelity of cameras."""
    repeats = {index for pair in pairs if pair.repeats for index in (pair.a, pair.b)}
    found = estimate_cameras(
        frames.rgb,
        _FRONTEND,
        generator=child_generator(0, "tour"),
        known_intrinsics_px=frames.intrinsics_px,
    )
    seen = [view.inliers if view.registered and view.view not in repeats else 0 for view in found.report.views]
    known = torch.tensor([count >= _FEWEST_OBSERVATIONS for count in seen])
    rotations, directions, worst = [], [], []
    for a, b in itertools.combinations(range(len(seen)), 2):
        if not (known[a] and known[b]):
            worst.append(180.0)
            continue
        estimated, true = (
            rigid_inverse(poses[a].double()) @ poses[b].double()
            for poses in (found.world_from_cam, frames.world_from_cam)
        )
        rotations.append(float(rotation_angle_deg(estimated[:3, :3], true[:3, :3])))
        directions.append(_angle_deg(estimated[:3, 3], true[:3, 3]))
        worst.append(max(rotations[-1], directions[-1]))
    thresholds = range(1, _WITHIN_DEG + 1)
    return {
        "tour_registered": float(known.double().mean()),
        "tour_observations": fmean(seen),
        "tour_camera_auc": fmean(sum(error < limit for error in worst) / len(worst) for limit in thresholds),
        "tour_rotation_deg": median(rotations) if rotations else None,
        "tour_direction_deg": median(directions) if directions else None,
    }


def _angle_deg(a: Float[Tensor, "3"], b: Float[Tensor, "3"]) -> float:
    return float(torch.rad2deg(torch.atan2(torch.linalg.cross(a, b).norm(), (a * b).sum())))


def tsed(pairs: Sequence[_Pair]) -> float | None:
    """Share of consecutive frames that are consistent; None if no two of them move enough to tell."""
    verdicts = [pair.consistent for pair in pairs if pair.parallax_px >= _LEAST_MOTION_PX]
    return fmean(verdicts) if verdicts else None


def _homogeneous(xy: np.ndarray) -> np.ndarray:
    return np.concatenate([xy, np.ones((len(xy), 1))], 1)


@torch.no_grad()
def steadiness(frames: Frames, config: EvaluateConfig) -> float:
    """Mean over consecutive frames of the local correlation of what both show; negative correlations are none."""
    return fmean(_steady(frames, a, b, config) for a, b in itertools.pairwise(range(len(frames.rgb))))


def _steady(frames: Frames, a: int, b: int, config: EvaluateConfig) -> float:
    height, width = frames.depth.shape[1:]
    first, second = (Cameras(frames.world_from_cam[[i]], frames.intrinsics_px[[i]], height, width) for i in (a, b))
    points = first.unproject(frames.depth[[a]]).reshape(-1, 3)
    content = torch.cat([frames.rgb[b], frames.depth[b][None], frames.alpha[b][None]])[None]
    sampled, found = second.look_up(points, content)
    there, z = sampled[0].reshape(5, height, width), found.depth[0].reshape(height, width)
    both = found.in_frame[0].reshape(height, width) & ((there[3] - z).abs() < _SAME_DEPTH * z)
    both &= (frames.alpha[a] > config.coverage_alpha) & (there[4] > config.coverage_alpha)
    similar, textured = _local_correlation(_luma(frames.rgb[a]), _luma(there[:3]), both)
    if int(textured.sum()) < _FEWEST_WINDOWS:
        return 0.0
    return float(similar[textured].clamp(min=0).mean())


def _luma(rgb: Float[Tensor, "3 height width"]) -> Float[Tensor, "height width"]:
    return (rgb.double() * rgb.new_tensor([0.299, 0.587, 0.114], dtype=torch.float64)[:, None, None]).sum(0)


def _local_correlation(
    a: Float[Tensor, "height width"], b: Float[Tensor, "height width"], both: Bool[Tensor, "height width"]
) -> tuple[Float[Tensor, "row column"], Bool[Tensor, "row column"]]:
    """Correlation in every window, and which windows lie in ``both`` and have structure in ``a``."""

    def mean(plane: Tensor) -> Tensor:
        return functional.avg_pool2d(plane[None, None], _WINDOW, stride=1)[0, 0]

    mean_a, mean_b = mean(a), mean(b)
    variance_a, variance_b = (mean(a * a) - mean_a**2).clamp(min=0), (mean(b * b) - mean_b**2).clamp(min=0)
    covariance = mean(a * b) - mean_a * mean_b
    correlation = covariance / (variance_a * variance_b).sqrt().clamp(min=1e-8)
    whole = mean(both.double()) > 1 - 1e-6
    return correlation, whole & (variance_a > _TEXTURED**2)


class TourConsistency(Measure):
    """What the module says, of evenly spread frames of the path."""

    metrics = metrics_named(
        "tour_registered",
        "tour_observations",
        "tour_camera_auc",
        "tour_rotation_deg",
        "tour_direction_deg",
        "tour_tsed",
        "tour_steadiness",
    )

    def of_scene(self, subject: Subject) -> Values:
        """Nothing without a path, where it is switched off, or where the path stands still."""
        path = subject.navigation
        if path is None or subject.config.consistency_frames == 0:
            return {}
        frames = see_frames(subject.reconstruction, path, subject.config.consistency_frames)
        return measure_tour(frames, subject.config) if len(frames.rgb) > 2 else {}
