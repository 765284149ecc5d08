"""Which candidate goes best with the scene so far: its camera found among the photos, and what it then shows compared with them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.agreement import CandidateScore
from sceneexpander.frontend.features import grey_u8
from sceneexpander.generation.protocol import SceneSoFar
from sceneexpander.generation.registration import FEWEST_INLIERS, PhotoPoints, detail_of, photo_points, register
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.ingest.fit import FittedPicture
from sceneexpander.ingest.load import image_tensor
from sceneexpander.splatting.render import render

# What a total consists of. A picture whose camera cannot be found cannot be inserted well, however fine it looks.
_WEIGHTS = {"registration": 0.4, "appearance": 0.3, "novelty": 0.2, "sharpness": 0.1}
_SURE_INLIERS = 60  # as many agreeing points make a camera sure
_ENOUGH_NEW = 0.3  # of the picture: an expansion is not better for showing even less of the scene
_COARSE = 4  # pixels of a cell in which colours are compared: small displacements are no disagreement
_SEEN = 0.5  # of what covers a pixel


def rank_candidates(
    candidates: Sequence[FittedPicture | None], so_far: SceneSoFar, *, seed: int
) -> tuple[CandidateScore, ...]:
    """Scores of the usable candidates, the best first; None stands for one that is not.

    The camera of a candidate is found from its SIFT matches with the views so far: their world points are those of the reconstruction's
    depth, and pose and focal are what explains most of them (`sceneexpander.frontend.resection`). Rendered from there, the scene tells
    what of the picture it has seen (the rest is new) and how like it that is: the correlation of colours in cells of 4 x 4 stored pixels.
    """
    photos = photo_points(so_far)
    scores = [
        _score(index, picture, photos, so_far, seed=seed)
        for index, picture in enumerate(candidates)
        if picture is not None
    ]
    return tuple(sorted(scores, key=lambda score: (-score.total, score.candidate)))


def _score(index: int, picture: FittedPicture, photos: PhotoPoints, so_far: SceneSoFar, *, seed: int) -> CandidateScore:
    sharpness = min(1.0, detail_of(grey_u8(image_tensor(picture.detail).numpy())) / max(photos.sharpness, 1e-9))
    registered = register(picture, photos, so_far, seed=seed)
    found, inliers, matched = registered.found, registered.inliers, registered.matched
    if found is None:
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
    appearance, novelty = _compared(picture, registered.camera(found, so_far.views.height, so_far.views.width), so_far)
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
        reprojection_px=float(np.median(registered.errors_px(found)[found.inlier])),
        appearance=appearance,
        sharpness=sharpness,
        novelty=novelty,
        reason=f"{inliers} of {matched} matches agree with one camera, likeness {appearance:.2f} where the scene was seen, "
        f"{novelty:.0%} new, sharpness {sharpness:.2f}",
    )


@torch.no_grad()
def _compared(picture: FittedPicture, camera: Cameras, so_far: SceneSoFar) -> tuple[float, float]:
    """(likeness to the rendered scene where it has been seen, share of the picture that has not been)."""
    seen = render(so_far.reconstruction.gaussians, camera)
    cover = seen.alpha[0] >= _SEEN
    novelty = 1 - float(cover.float().mean())
    share = _cells(cover[None].float())[0]
    inside = share > 1 - 1e-6
    if int(inside.sum()) < FEWEST_INLIERS:
        return 0.0, novelty
    rendered = (seen.rgb[0] / seen.alpha[0].clamp(min=_SEEN)).clamp(0, 1)
    pair = [_cells(image)[:, inside] for image in (rendered, image_tensor(picture.image))]
    a, b = ((colours - colours.mean(1, keepdim=True)).flatten() for colours in pair)
    return max(0.0, float(a @ b / (a.norm() * b.norm()).clamp(min=1e-9))), novelty


def _cells(image: Float[Tensor, "channel height width"]) -> Float[Tensor, "channel row column"]:
    return torch.nn.functional.avg_pool2d(image, _COARSE)
