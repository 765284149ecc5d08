"""Local features: SIFT on locally equalised, if need be enlarged images, described by RootSIFT.

RootSIFT: Arandjelovic & Zisserman, "Three things everyone should know to improve object retrieval", CVPR 2012 (the Euclidean
distance of square-rooted, L1-normalised SIFT is the Hellinger distance of the histograms).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from sceneexpander.frontend.sfm_types import SfmConfig

_CLAHE_CLIP = 2.0
_CLAHE_TILES = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Features:
    """Keypoints of one view: those with descriptors first, strongest first; then those of a matcher of its own (`learned`)."""

    pixel_xy: Float[np.ndarray, "feature 2"]  # float64, first pixel centre at 0.5
    descriptors: Float[np.ndarray, "described 128"]  # float32, L2 norm 1; of the leading keypoints

    @property
    def count(self) -> int:
        """Number of keypoints."""
        return int(self.pixel_xy.shape[0])

    @property
    def described(self) -> int:
        """Number of keypoints with a descriptor."""
        return int(self.descriptors.shape[0])

    def select(self, keep: Bool[np.ndarray, " feature"]) -> Features:
        """The keypoints that are kept."""
        return Features(pixel_xy=self.pixel_xy[keep], descriptors=self.descriptors[keep[: self.described]])

    def joined(self, further_xy: Float[np.ndarray, "further 2"]) -> Features:
        """The same keypoints followed by others that have no descriptor."""
        return Features(pixel_xy=np.concatenate([self.pixel_xy, further_xy]), descriptors=self.descriptors)


def lie_in(
    shown: Bool[np.ndarray, "height width"] | None, xy: Float[np.ndarray, "point 2"]
) -> Bool[np.ndarray, " point"]:
    """Which places lie in a mask (None: all do)."""
    if shown is None:
        return np.ones(len(xy), bool)
    height, width = shown.shape
    column, row = np.floor(xy).astype(np.int64).T
    return shown[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]


def grey_u8(image: Float[np.ndarray, "3 height width"]) -> UInt8[np.ndarray, "height width"]:
    """Luma (Rec. 601) of an RGB image in [0, 1], rounded to 8 bits (what SIFT takes)."""
    luma = 0.299 * image[0] + 0.587 * image[1] + 0.114 * image[2]
    return np.clip(np.rint(luma * 255.0), 0, 255).astype(np.uint8)


def detect_features(grey: UInt8[np.ndarray, "height width"], config: SfmConfig) -> Features:
    """SIFT keypoints with RootSIFT descriptors. An image without structure gives an empty set."""
    height, width = grey.shape
    enlarge = 2.0 if max(height, width) < config.upsample_below_px else 1.0
    if enlarge != 1.0:
        grey = cv2.resize(grey, None, fx=enlarge, fy=enlarge, interpolation=cv2.INTER_CUBIC)
    if config.equalise:
        grey = cv2.createCLAHE(clipLimit=_CLAHE_CLIP, tileGridSize=(_CLAHE_TILES, _CLAHE_TILES)).apply(grey)
    # Precise upscale: without it OpenCV's doubled first octave shifts every keypoint by a quarter of a pixel.
    sift = cv2.SIFT.create(
        nfeatures=config.max_features, contrastThreshold=config.contrast_threshold, enable_precise_upscale=True
    )
    keypoints, raw = sift.detectAndCompute(grey, None)
    if not keypoints:
        return Features(pixel_xy=np.zeros((0, 2)), descriptors=np.zeros((0, 128), np.float32))
    # OpenCV puts the first pixel centre at 0, this project at 0.5.
    xy = (np.array([point.pt for point in keypoints], np.float64) + 0.5) / enlarge
    strength = np.array([point.response for point in keypoints])
    order = np.argsort(-strength, kind="stable")[: config.max_features]
    histogram = np.maximum(raw[order].astype(np.float32), 0.0)
    root = np.sqrt(histogram / np.maximum(histogram.sum(1, keepdims=True), 1e-12))
    return Features(pixel_xy=xy[order], descriptors=root)
