"""What pictures say of their matches."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sceneexpander.frontend.appearance import find_overlay, group_alike, looks_mirrored, patch_agreement
from sceneexpander.frontend.features import Features, detect_features
from sceneexpander.frontend.sfm_types import SfmConfig
from sceneexpander.frontend.twoview import PairMatches, match_and_verify
from sceneexpander.synthetic import make_views

CONFIG = SfmConfig(max_features=1200)


def photos(seed: int = 1, views: int = 3) -> list[np.ndarray]:
    """Grey pictures of one place from several sides."""
    images = make_views(seed, views=views, height=288, width=384, split="test").images
    grey = images.mul(255).round().byte().permute(0, 2, 3, 1).numpy()
    return [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in grey]


def matched(greys: list[np.ndarray]) -> tuple[list[Features], list[PairMatches]]:
    features = [detect_features(grey, CONFIG) for grey in greys]
    pairs = [
        match_and_verify(a, b, features, CONFIG, unit_px=0.5, seed=1)
        for a in range(len(greys))
        for b in range(a + 1, len(greys))
    ]
    return features, pairs


def shaken(grey: np.ndarray, pixels: float, seed: int) -> np.ndarray:
    """The same picture moved a little and saved again."""
    move = np.array([[1, 0, pixels], [0, 1, -pixels / 2]], np.float32)
    moved = cv2.warpAffine(grey, move, grey.shape[::-1], borderMode=cv2.BORDER_REFLECT)
    noise = np.random.default_rng(seed).normal(0, 2, grey.shape)
    return np.clip(moved + noise, 0, 255).astype(np.uint8)


def marked(grey: np.ndarray) -> np.ndarray:
    out = grey.copy()
    for row in range(3):
        cv2.putText(out, "SAMPLE 2026 No 7", (70, 110 + 40 * row), cv2.FONT_HERSHEY_SIMPLEX, 0.8, 255, 2)
    return out


def test_right_matches_look_alike_and_noise_does_not() -> None:
    greys = photos()
    features, pairs = matched(greys)
    pair = max(pairs, key=lambda p: p.verified.count)
    xy_a = features[pair.view_a].pixel_xy[pair.verified.index_a]
    xy_b = features[pair.view_b].pixel_xy[pair.verified.index_b]
    a, b = greys[pair.view_a], greys[pair.view_b]
    assert patch_agreement(a, b, xy_a, xy_b) > CONFIG.min_patch_agreement + 0.15
    rng = np.random.default_rng(0)
    assert abs(patch_agreement(a, b, xy_a, rng.permutation(xy_b))) < 0.2
    noise = rng.integers(0, 256, (2, 288, 384), dtype=np.uint8)
    assert abs(patch_agreement(noise[0], noise[1], xy_a, xy_b)) < 0.1
    assert patch_agreement(a, b, xy_a[:0], xy_b[:0]) == 0


def test_text_over_all_photos_is_an_overlay_and_the_place_is_not() -> None:
    plain = photos(4)
    features, pairs = matched(plain)
    assert find_overlay(features, pairs, 0.5) is None
    features, pairs = matched([marked(grey) for grey in plain])
    spots = find_overlay(features, pairs, 0.5)
    assert spots is not None
    assert spots[:, 0].min() > 60
    assert ((spots[:, 1] > 80) & (spots[:, 1] < 200)).mean() > 0.9
    one_marked = matched([marked(plain[0]), *plain[1:]])
    assert find_overlay(*one_marked, 0.5) is None, "what is on one photo is no overlay"


def test_a_camera_that_stood_still_has_no_overlay() -> None:
    grey = photos()[0]
    features, pairs = matched([shaken(grey, 0.0, seed) for seed in range(3)])
    assert find_overlay(features, pairs, 0.5) is None


def test_a_burst_counts_as_one_view() -> None:
    greys = photos(4)
    features, pairs = matched([greys[0], shaken(greys[0], 0.4, 1), greys[1], shaken(greys[0], -0.4, 2)])
    assert group_alike(features, pairs, 0.5) == [[0, 1, 3]]
    features, pairs = matched(greys)
    assert group_alike(features, pairs, 0.5) == []


@pytest.mark.parametrize("view", [0, 2])
def test_a_mirrored_photo_is_recognised_and_others_are_not(view: int) -> None:
    greys = photos(4)
    greys[view] = np.ascontiguousarray(greys[view][:, ::-1])
    features, pairs = matched(greys)
    right = [v for v in range(3) if v != view]
    arguments = (greys, features, pairs, CONFIG)
    assert looks_mirrored(view, right, *arguments, unit_px=0.5, seed=1)
    assert not looks_mirrored(right[0], right, *arguments, unit_px=0.5, seed=1)
