"""Which candidate goes best with the scene so far: its camera found among the photos, and what it then shows compared with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.inserted import CandidateScore
from sceneexpander.frontend.features import Features, detect_features, grey_u8
from sceneexpander.frontend.matching import mutual_matches, similarity
from sceneexpander.frontend.resection import ResectedView, Sighting, point_errors, resect
from sceneexpander.frontend.sfm_types import SfmConfig
from sceneexpander.generation.protocol import SceneSoFar
from sceneexpander.geometry.camera import resize_intrinsics, unproject_to_world
from sceneexpander.geometry.rigid import rigid_from_parts, rigid_inverse
from sceneexpander.ingest.fit import FittedPicture
from sceneexpander.ingest.load import image_tensor
from sceneexpander.splatting.render import render

# What a total consists of. A picture whose camera cannot be found cannot be inserted well, however fine it looks.
_WEIGHTS = {"registration": 0.4, "appearance": 0.3, "novelty": 0.2, "sharpness": 0.1}
_SURE_INLIERS = 60  # as many agreeing points make a camera sure
_FEWEST_INLIERS = 12  # fewer agree by chance
_ENOUGH_NEW = 0.3  # of the picture: an expansion is not better for showing even less of the scene
_THRESHOLD_PX, _NOISE_PX = 8.0, 3.0  # at 768 px: generated pictures are off by several pixels
_UNIT_SIDE_PX = 768
_FOCAL_FACTORS = (0.7, 0.85, 1.0, 1.2, 1.45)
_MAX_RATIO = 0.85
_COARSE = 4  # pixels of a cell in which colours are compared: small displacements are no disagreement
_SEEN = 0.5  # of what covers a pixel


@dataclass(frozen=True, slots=True, kw_only=True)
class _Photos:
    """The views that a candidate is compared with: features in detail pixels, and the world points under them."""

    features: tuple[Features, ...]
    points: tuple[np.ndarray, ...]  # (feature, 3) each
    intrinsics: np.ndarray  # (3, 3), typical, detail pixels
    unit_px: float  # detail pixels per pixel at 768
    sharpness: float


def rank_candidates(
    candidates: Sequence[FittedPicture | None], so_far: SceneSoFar, *, seed: int
) -> tuple[CandidateScore, ...]:
    """Scores of the usable candidates, the best first; None stands for one that is not.

    The camera of a candidate is found from its SIFT matches with the views so far: their world points are those of the reconstruction's
    depth, and pose and focal are what explains most of them (`sceneexpander.frontend.resection`). Rendered from there, the scene tells
    what of the picture it has seen (the rest is new) and how like it that is: the correlation of colours in cells of 4 x 4 stored pixels.
    """
    photos = _photos(so_far)
    scores = [
        _score(index, picture, photos, so_far, seed=seed)
        for index, picture in enumerate(candidates)
        if picture is not None
    ]
    return tuple(sorted(scores, key=lambda score: (-score.total, score.candidate)))


def _photos(so_far: SceneSoFar) -> _Photos:
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
        sharp.append(_detail(grey))
    typical = scene.intrinsics_px[used].median(dim=0).values
    return _Photos(
        features=tuple(features),
        points=tuple(points),
        intrinsics=resize_intrinsics(typical, width / views.width, height / views.height).double().numpy(),
        unit_px=max(height, width) / _UNIT_SIDE_PX,
        sharpness=float(np.median(sharp)) if sharp else 1.0,
    )


def _score(index: int, picture: FittedPicture, photos: _Photos, so_far: SceneSoFar, *, seed: int) -> CandidateScore:
    grey = grey_u8(image_tensor(picture.detail).numpy())
    sharpness = min(1.0, _detail(grey) / max(photos.sharpness, 1e-9))
    sighting = _sighted(detect_features(grey, SfmConfig()), photos, seed=seed)
    matched = len(sighting.points)
    found = resect(sighting, np.log(_FOCAL_FACTORS).tolist())
    inliers = 0 if found is None else int(found.inlier.sum())
    if found is None or inliers < _FEWEST_INLIERS:
        return CandidateScore(
            candidate=index,
            total=_WEIGHTS["sharpness"] * sharpness,
            registration=0.0,
            inliers=inliers,
            reprojection_px=None,
            appearance=None,
            sharpness=sharpness,
            novelty=None,
            reason=f"its camera is not found ({inliers} of {matched} matches agree)",
        )
    registration = min(1.0, inliers / _SURE_INLIERS) * inliers / max(matched, 1)
    appearance, novelty = _compared(picture, sighting, found, so_far)
    values = {
        "registration": registration,
        "appearance": appearance,
        "novelty": min(1.0, novelty / _ENOUGH_NEW),
        "sharpness": sharpness,
    }
    return CandidateScore(
        candidate=index,
        total=sum(_WEIGHTS[name] * value for name, value in values.items()),
        registration=registration,
        inliers=inliers,
        reprojection_px=_reprojection_px(sighting, found, so_far.views.width / picture.detail.shape[1]),
        appearance=appearance,
        sharpness=sharpness,
        novelty=novelty,
        reason=f"{inliers} of {matched} matches agree with one camera, likeness {appearance:.2f} where the scene was seen, "
        f"{novelty:.0%} new, sharpness {sharpness:.2f}",
    )


def _sighted(features: Features, photos: _Photos, *, seed: int) -> Sighting:
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


def _reprojection_px(sighting: Sighting, found: ResectedView, stored_per_detail: float) -> float:
    errors = point_errors(
        sighting.points, sighting.pixel_xy, sighting.through(found.lens), found.rotation, found.translation
    )
    return float(np.median(errors[found.inlier])) * stored_per_detail


@torch.no_grad()
def _compared(
    picture: FittedPicture, sighting: Sighting, found: ResectedView, so_far: SceneSoFar
) -> tuple[float, float]:
    """(likeness to the rendered scene where it has been seen, share of the picture that has not been)."""
    views, scene = so_far.views, so_far.reconstruction
    cam_from_world = rigid_from_parts(torch.from_numpy(found.rotation), torch.from_numpy(found.translation)).float()
    scale = views.width / picture.detail.shape[1]
    intrinsics = resize_intrinsics(torch.from_numpy(sighting.through(found.lens)).float(), scale, scale)
    seen = render(scene.gaussians, rigid_inverse(cam_from_world)[None], intrinsics[None], views.height, views.width)
    cover = seen.alpha[0] >= _SEEN
    novelty = 1 - float(cover.float().mean())
    share = _cells(cover[None].float())[0]
    inside = share > 1 - 1e-6
    if int(inside.sum()) < _FEWEST_INLIERS:
        return 0.0, novelty
    rendered = (seen.rgb[0] / seen.alpha[0].clamp(min=_SEEN)).clamp(0, 1)
    pair = [_cells(image)[:, inside] for image in (rendered, image_tensor(picture.image))]
    a, b = ((colours - colours.mean(1, keepdim=True)).flatten() for colours in pair)
    return max(0.0, float(a @ b / (a.norm() * b.norm()).clamp(min=1e-9))), novelty


def _cells(image: Float[Tensor, "channel height width"]) -> Float[Tensor, "channel row column"]:
    return torch.nn.functional.avg_pool2d(image, _COARSE)


def _detail(grey: np.ndarray) -> float:
    """Mean magnitude of the Laplacian: how much detail a picture has."""
    return float(np.abs(cv2.Laplacian(grey, cv2.CV_32F)).mean())
