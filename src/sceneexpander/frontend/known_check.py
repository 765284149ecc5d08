"""Whether given cameras agree with the pictures: with matches that were verified before any camera was known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.frontend.features import Features, detect_features, lie_in
from sceneexpander.frontend.sfm_setup import KnownCameras, Setup, known_cameras, prepare
from sceneexpander.frontend.sfm_types import SfmConfig
from sceneexpander.frontend.twoview import PairMatches, fundamental_from_poses, match_and_verify

_AGREE_PX = 3.0  # at 768 px, from the epipolar line
_LEAST_MATCHES = 40  # of a view with all others, for a number that says something
_NO_BASELINE = 1e-6  # of the largest distance between cameras: nothing to be seen of an epipolar line
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, slots=True, kw_only=True)
class Contradictions:
    """What the pictures do not bear out.

    Attributes:
        poses: views whose given pose is not to be used.
        intrinsics: whether the given intrinsics are not to be used.
        notes: for people, with the numbers.
    """

    poses: Bool[Tensor, " view"]
    intrinsics: bool
    notes: tuple[str, ...]


def find_contradictions(
    images: Float[Tensor, "view 3 height width"],
    config: SfmConfig,
    *,
    generator: torch.Generator,
    feature_images: Float[Tensor, "view 3 feature_height feature_width"] | None = None,
    intrinsics_px: Float[Tensor, "view 3 3"] | None = None,
    world_from_cam: Float[Tensor, "view 4 4"] | None = None,
    names: Sequence[str] | None = None,
    valid: Bool[Tensor, "view height width"] | None = None,
) -> Contradictions:
    """`compare_with_matches` for models that do without the front-end; arguments as in `sfm.estimate_cameras`."""
    setup = prepare(images, feature_images, config, generator, names, valid)
    known = known_cameras(setup, intrinsics_px, world_from_cam)
    features = [detect_features(grey, config) for grey in setup.greys]
    features = [own.select(lie_in(mask, own.pixel_xy)) for own, mask in zip(features, setup.shown, strict=True)]
    pairs = [
        match_and_verify(a, b, features, config, unit_px=setup.unit_px, seed=setup.seed)
        for a in range(len(features))
        for b in range(a + 1, len(features))
    ]
    return compare_with_matches(features, pairs, known, config, setup)


def compare_with_matches(
    features: Sequence[Features],
    pairs: Sequence[PairMatches],
    known: KnownCameras,
    config: SfmConfig,
    setup: Setup,
) -> Contradictions:
    """Which of the given cameras fewer than `SfmConfig.min_agreeing` of a view's matches agree with.

    Intrinsics first: the share of verified matches that some motion explains at the given focal lengths. Then poses: the share that lies on
    the epipolar lines of the given motion; the view that agrees least is taken out, and the rest is asked again. Poses without intrinsics
    draw no epipolar line and are believed.

    Args:
        features: of all views, in feature pixels.
        pairs: verified without any camera.
        known: what was given, in feature pixels.
        config: of the front-end.
        setup: names and scale.
    """
    views = len(features)
    dropped, notes = np.zeros(views, bool), list[str]()
    if known.intrinsics is not None:
        share, count = _explained_share(features, pairs, known.intrinsics, setup)
        if count >= _LEAST_MATCHES and share < config.min_agreeing:
            notes.append(
                f"the given intrinsics contradict the pictures: they explain {share:.0%} of {count} matches,"
                f" less than {config.min_agreeing:.0%}; not used"
            )
            return Contradictions(poses=torch.from_numpy(dropped), intrinsics=True, notes=tuple(notes))
    posed = known.posed.copy()
    if known.intrinsics is None or posed.sum() < 2:
        return Contradictions(poses=torch.from_numpy(dropped), intrinsics=False, notes=())
    near, total = _agreeing(features, pairs, known, known.cam_from_world, setup)
    first_share = near[posed][:, posed].sum() / max(1, total[posed][:, posed].sum())
    while posed.sum() >= 2:
        agreeing, asked = (table[:, posed].sum(1) for table in (near, total))
        shares = np.where(posed & (asked >= _LEAST_MATCHES), agreeing / np.maximum(1, asked), 1.0)
        worst = int(shares.argmin())
        if shares[worst] >= config.min_agreeing:
            break
        posed[worst] = False
        notes.append(
            f"{setup.names[worst]}: its given pose contradicts the pictures: {shares[worst]:.0%} of {int(asked[worst])} matches agree"
            f" with it, less than {config.min_agreeing:.0%}; not used"
        )
    if posed.sum() < 2:
        posed[:] = False
        notes = [
            f"the given poses contradict the pictures: {first_share:.0%} of {int(total.sum() / 2)} matches agree with them,"
            f" less than {config.min_agreeing:.0%}; none is used{_other_axes(features, pairs, known, config, setup)}"
        ]
    return Contradictions(poses=torch.from_numpy(known.posed & ~posed), intrinsics=False, notes=tuple(notes))


def _agreeing(
    features: Sequence[Features],
    pairs: Sequence[PairMatches],
    known: KnownCameras,
    cam_from_world: Float[np.ndarray, "view 4 4"],
    setup: Setup,
) -> tuple[Float[np.ndarray, "view view"], Float[np.ndarray, "view view"]]:
    """(matches near the epipolar lines of the given motion, all matches) per pair of posed views."""
    views = len(features)
    near, total = np.zeros((views, views)), np.zeros((views, views))
    centres = -np.einsum("vji,vj->vi", cam_from_world[:, :3, :3], cam_from_world[:, :3, 3])
    extent = float(np.ptp(centres[known.posed], axis=0).max())
    for pair in pairs:
        a, b = pair.view_a, pair.view_b
        apart = float(np.linalg.norm(centres[a] - centres[b]))
        if not (known.posed[a] and known.posed[b]) or pair.verified.count == 0 or apart <= _NO_BASELINE * extent:
            continue
        relative = cam_from_world[b] @ np.linalg.inv(cam_from_world[a])
        intrinsics = known.intrinsics
        assert intrinsics is not None  # noqa: S101 - asked by the caller
        fundamental = fundamental_from_poses(relative[:3, :3], relative[:3, 3], intrinsics[a], intrinsics[b])
        xy_a, xy_b = features[a].pixel_xy[pair.verified.index_a], features[b].pixel_xy[pair.verified.index_b]
        agreeing = (_distances_px(fundamental, xy_a, xy_b) < _AGREE_PX * setup.unit_px).sum()
        near[a, b] = near[b, a] = agreeing
        total[a, b] = total[b, a] = pair.verified.count
    return near, total


def _distances_px(
    fundamental: Float[np.ndarray, "3 3"], xy_a: Float[np.ndarray, "match 2"], xy_b: Float[np.ndarray, "match 2"]
) -> Float[np.ndarray, " match"]:
    """The larger of the two distances from the epipolar lines."""
    a, b = (np.concatenate([xy, np.ones((len(xy), 1))], 1) for xy in (xy_a, xy_b))
    line_b, line_a = a @ fundamental.T, b @ fundamental
    residual = np.abs((b * line_b).sum(1))
    lengths = [np.maximum(np.linalg.norm(line[:, :2], axis=1), 1e-12) for line in (line_a, line_b)]
    return residual / np.minimum(*lengths)


def _explained_share(
    features: Sequence[Features], pairs: Sequence[PairMatches], intrinsics: Float[np.ndarray, "view 3 3"], setup: Setup
) -> tuple[float, int]:
    """(share of verified matches that an essential matrix explains at these intrinsics, how many there are)."""
    explained = count = 0
    for pair in pairs:
        if pair.verified.count < _LEAST_MATCHES:
            continue
        a, b = pair.view_a, pair.view_b
        rays = [
            cv2.undistortPoints(
                features[view].pixel_xy[index].reshape(-1, 1, 2).astype(np.float64), intrinsics[view], None
            )
            for view, index in ((a, pair.verified.index_a), (b, pair.verified.index_b))
        ]
        noise = _AGREE_PX * setup.unit_px / float(np.sqrt(intrinsics[a, 0, 0] * intrinsics[b, 0, 0]))
        cv2.setRNGSeed(setup.seed)
        essential, inliers = cv2.findEssentialMat(rays[0], rays[1], np.eye(3), cv2.RANSAC, 0.999, noise)
        if essential is not None and essential.shape == (3, 3):
            explained += int(inliers.sum())
        count += pair.verified.count
    return explained / max(1, count), count


def _other_axes(
    features: Sequence[Features], pairs: Sequence[PairMatches], known: KnownCameras, config: SfmConfig, setup: Setup
) -> str:
    """A word about the commonest mistake, if it is the one: camera axes of another habit."""
    near, total = _agreeing(features, pairs, known, _OPENCV_FROM_OPENGL @ known.cam_from_world, setup)
    share = near.sum() / max(1.0, total.sum())
    if share < config.min_agreeing:
        return ""
    return f" (with the other habit of camera axes {share:.0%} would: see scene.camera_axes)"
