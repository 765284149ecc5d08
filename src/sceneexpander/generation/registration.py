"""Where a picture was taken from: matched with the views so far, whose depth says where the matched points are."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float

from sceneexpander.frontend.features import Features, detect_features, grey_u8
from sceneexpander.frontend.matching import mutual_matches, similarity
from sceneexpander.frontend.resection import ResectedView, Sighting, point_errors, resect
from sceneexpander.frontend.sfm_types import SfmConfig
from sceneexpander.generation.protocol import SceneSoFar
from sceneexpander.geometry.camera import resize_intrinsics, unproject_to_world
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.rigid import rigid_from_parts, rigid_inverse
from sceneexpander.ingest.fit import FittedPicture
from sceneexpander.ingest.load import image_tensor

FEWEST_INLIERS = 12  # fewer agree by chance
_THRESHOLD_PX, _NOISE_PX = 8.0, 3.0  # at 768 px: generated pictures are off by several pixels
_UNIT_SIDE_PX = 768
_FOCAL_FACTORS = (0.7, 0.85, 1.0, 1.2, 1.45)
_MAX_RATIO = 0.85


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoPoints:
    """The views that pictures are matched with: features in detail pixels, and the world points under them."""

    features: tuple[Features, ...]
    points: tuple[np.ndarray, ...]  # (feature, 3) each
    intrinsics: np.ndarray  # (3, 3), typical, detail pixels
    unit_px: float  # detail pixels per pixel at 768
    sharpness: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Registration:
    """What one picture sees of the scene. ``found``: its camera; None: too few matches agree with any (``inliers`` of them).

    ``stored_per_detail``: stored pixels per detail pixel.
    """

    sighting: Sighting
    found: ResectedView | None
    inliers: int
    stored_per_detail: float

    @property
    def matched(self) -> int:
        """How many points of the scene it shows, or seems to."""
        return len(self.sighting.points)

    def camera(self, found: ResectedView, height: int, width: int) -> Cameras:
        """One camera, for pictures of the stored size."""
        cam_from_world = rigid_from_parts(torch.from_numpy(found.rotation), torch.from_numpy(found.translation)).float()
        intrinsics = torch.from_numpy(self.sighting.through(found.lens)).float()
        scale = self.stored_per_detail
        pose = rigid_inverse(cam_from_world)
        return Cameras(pose[None], resize_intrinsics(intrinsics, scale, scale)[None], height, width)

    def errors_px(self, found: ResectedView) -> Float[np.ndarray, " point"]:
        """Distance of each matched point from where its camera puts it, in stored pixels."""
        sighting, lens = self.sighting, self.sighting.through(found.lens)
        errors = point_errors(sighting.points, sighting.pixel_xy, lens, found.rotation, found.translation)
        return errors * self.stored_per_detail


def register(picture: FittedPicture, photos: PhotoPoints, so_far: SceneSoFar, *, seed: int) -> Registration:
    """Find a picture's camera: the pose and focal that explain most of its SIFT matches (`sceneexpander.frontend.resection`)."""
    grey = grey_u8(image_tensor(picture.detail).numpy())
    sighting = _sighted(detect_features(grey, SfmConfig()), photos, seed=seed)
    found = resect(sighting, np.log(_FOCAL_FACTORS).tolist())
    inliers = 0 if found is None else int(found.inlier.sum())
    return Registration(
        sighting=sighting,
        found=found if inliers >= FEWEST_INLIERS else None,
        inliers=inliers,
        stored_per_detail=so_far.views.width / picture.detail.shape[1],
    )


def photo_points(so_far: SceneSoFar) -> PhotoPoints:
    """Features of the views so far that have a camera, with their places."""
    views, scene = so_far.views, so_far.reconstruction
    height, width = views.detail_images.shape[-2:]
    used = scene.posed.nonzero()[:, 0].tolist()
    world = unproject_to_world(scene.depth, scene.intrinsics_px, scene.world_from_cam).numpy()
    features, points, sharp = [], [], []
    for view in used:
        grey = grey_u8(views.detail_images[view].numpy())
        found = detect_features(grey, SfmConfig())
        column = np.clip(np.floor(found.pixel_xy[:, 0] * views.width / width).astype(int), 0, views.width - 1)
        row = np.clip(np.floor(found.pixel_xy[:, 1] * views.height / height).astype(int), 0, views.height - 1)
        features.append(found)
        points.append(world[view, row, column].astype(np.float64))
        sharp.append(detail_of(grey))
    typical = scene.intrinsics_px[used].median(dim=0).values
    return PhotoPoints(
        features=tuple(features),
        points=tuple(points),
        intrinsics=resize_intrinsics(typical, width / views.width, height / views.height).double().numpy(),
        unit_px=max(height, width) / _UNIT_SIDE_PX,
        sharpness=float(np.median(sharp)) if sharp else 1.0,
    )


def _sighted(features: Features, photos: PhotoPoints, *, seed: int) -> Sighting:
    """The world points that a candidate's features match, each feature once: with the view where the match is surest."""
    best = np.full(features.count, np.inf)
    points = np.zeros((features.count, 3))
    for theirs, world in zip(photos.features, photos.points, strict=True):
        matches = mutual_matches(similarity(features, theirs), _MAX_RATIO)
        surer = matches.ratio < best[matches.index_a]
        mine, other = matches.index_a[surer], matches.index_b[surer]
        best[mine] = matches.ratio[surer]
        points[mine] = world[other]
    used = np.isfinite(best)
    low, high = np.log(_FOCAL_FACTORS[0]), np.log(_FOCAL_FACTORS[-1])
    return Sighting(
        points=points[used],
        pixel_xy=features.pixel_xy[used],
        start=photos.intrinsics,
        shift_unit_px=np.ones(2),
        log_focal_low=float(low),
        log_focal_high=float(high),
        threshold_px=_THRESHOLD_PX * photos.unit_px,
        noise_px=_NOISE_PX * photos.unit_px,
        seed=seed,
    )


def detail_of(grey: np.ndarray) -> float:
    """Mean magnitude of the Laplacian: how much detail a picture has."""
    return float(np.abs(cv2.Laplacian(grey, cv2.CV_32F)).mean())
