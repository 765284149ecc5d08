"""Keypoints and matches that were found before, for pictures that come back.

The photos of a scene are asked for their cameras again with every view that joins them. What a picture's keypoints are, and which of them
match those of another picture, does not depend on what else is there: it is remembered by the content that it was made from, so that a
changed picture, mask or setting finds nothing, and what is found is the same to the last bit.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from sceneexpander.frontend import learned
from sceneexpander.frontend.features import Features, detect_features
from sceneexpander.frontend.learned import LearnedKeypoints
from sceneexpander.frontend.matching import Matches
from sceneexpander.frontend.sfm_types import SfmConfig
from sceneexpander.frontend.twoview import match_descriptors


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchMemory:
    """Each table by a hash of settings and content; filled by asking.

    Attributes:
        features: SIFT's keypoints of whole pictures.
        described: matches of SIFT's descriptors.
        keypoints: learned keypoints of whole pictures.
        learned: matches of those.
    """

    features: dict[str, Features] = field(default_factory=dict)
    described: dict[str, Matches] = field(default_factory=dict)
    keypoints: dict[str, LearnedKeypoints] = field(default_factory=dict)
    learned: dict[str, Matches] = field(default_factory=dict)

    def detect_features(self, grey: UInt8[np.ndarray, "height width"], config: SfmConfig) -> Features:
        """As `features.detect_features`."""
        key = _key(config, grey)
        if key not in self.features:
            self.features[key] = detect_features(grey, config)
        return self.features[key]

    def match_descriptors(self, a: Features, b: Features, config: SfmConfig) -> Matches:
        """As `twoview.match_descriptors`."""
        key = _key(config, a.pixel_xy, a.descriptors, b.pixel_xy, b.descriptors)
        if key not in self.described:
            self.described[key] = match_descriptors(a, b, config)
        return self.described[key]

    def detect_learned(self, image: Float[Tensor, "3 height width"], config: SfmConfig) -> LearnedKeypoints:
        """As `learned.detect_learned`."""
        key = _key(config, image.numpy())
        if key not in self.keypoints:
            self.keypoints[key] = learned.detect_learned(image, config)
        return self.keypoints[key]

    def match_learned(self, a: LearnedKeypoints, b: LearnedKeypoints, config: SfmConfig) -> Matches:
        """As `learned.match_learned`."""
        parts = [tensor.numpy() for own in (a, b) for tensor in (own.keypoints, own.descriptors)]
        key = _key(config, *parts, np.array([a.size_wh, b.size_wh]))
        if key not in self.learned:
            self.learned[key] = learned.match_learned(a, b, config)
        return self.learned[key]


def _key(config: SfmConfig, *content: np.ndarray) -> str:
    digest = hashlib.sha256(repr(config).encode())
    for array in content:
        digest.update(f"{array.shape} {array.dtype}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
