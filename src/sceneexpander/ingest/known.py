"""From what came with pictures to the cameras and depth of the stored views."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from sceneexpander.artifacts.scene import KnownCameras
from sceneexpander.ingest.depth_files import sampled_depth
from sceneexpander.ingest.fit import FittedPicture
from sceneexpander.ingest.lens_models import Lens
from sceneexpander.ingest.sources.capture import Shot


def make_known_cameras(
    kept: Sequence[tuple[Shot, FittedPicture, tuple[int, int]]], stored_size: tuple[int, int], *, metric: bool
) -> KnownCameras | None:
    """What is known of the views, or None if nothing is; rows of views without a pose or lens are NaN, depth there is 0.

    Args:
        kept: per view the shot (its lens at the picture's size), how the picture was fitted, and the picture's (height, width).
        stored_size: (height, width) of the views.
        metric: whether poses and depth are in metres.
    """
    posed = [shot.world_from_cam for shot, _, _ in kept if shot.world_from_cam is not None]
    poses = intrinsics = depth = None
    if posed:
        cam_from_world = np.linalg.inv(posed[0])
        missing = np.full((4, 4), np.nan)
        rows = [missing if s.world_from_cam is None else cam_from_world @ s.world_from_cam for s, _, _ in kept]
        poses = torch.from_numpy(np.stack(rows)).float()
    if any(shot.lens is not None for shot, _, _ in kept):
        rows = [np.full((3, 3), np.nan) if s.lens is None else _stored_intrinsics(s.lens, f) for s, f, _ in kept]
        intrinsics = torch.from_numpy(np.stack(rows)).float()
    if any(shot.depth is not None for shot, _, _ in kept):
        depth = torch.stack([_stored_depth(*item, stored_size) for item in kept])
    if poses is None and intrinsics is None and depth is None:
        return None
    return KnownCameras(
        world_from_cam=poses,
        intrinsics_px=intrinsics,
        depth=depth,
        metric=metric and (poses is not None or depth is not None),
        capture_from_world=None if not posed else tuple((row[0], row[1], row[2], row[3]) for row in posed[0].tolist()),
    )


def _stored_intrinsics(lens: Lens, fitted: FittedPicture) -> np.ndarray:
    affine = np.vstack([np.asarray(fitted.stored_from_original), [0.0, 0.0, 1.0]])
    return affine @ lens.intrinsics


def _stored_depth(
    shot: Shot, fitted: FittedPicture, picture_size: tuple[int, int], stored_size: tuple[int, int]
) -> Tensor:
    """Nearest samples: a mean over an edge is the depth of nothing."""
    height, width = stored_size
    if shot.depth is None:
        return torch.zeros(height, width)
    original_height, original_width = picture_size
    depth = shot.depth.read(picture_size)
    (scale_x, _, shift_x), (_, scale_y, shift_y) = fitted.stored_from_original
    columns, rows = np.meshgrid(
        (np.arange(width) + 0.5 - shift_x) / scale_x, (np.arange(height) + 0.5 - shift_y) / scale_y
    )
    if shot.lens is not None and shot.lens.bends and not shot.depth.of_straightened:
        bent = shot.lens.distorted(np.stack([columns.ravel(), rows.ravel()], 1))
        columns, rows = bent[:, 0].reshape(height, width), bent[:, 1].reshape(height, width)
    return torch.from_numpy(sampled_depth(depth, columns / original_width, rows / original_height))
