"""What a camera does to a clean picture: exposure, white balance, tone curve, blur, noise, JPEG."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]  # float32


def encode_radiance(radiance: Array, exposure: float) -> Array:
    """Display values in [0,1] of linear radiance: exposure, soft shoulder above 0.8, gamma 2.2."""
    linear = np.maximum(radiance * np.float32(exposure), 0)
    knee = np.float32(0.8)
    over = np.maximum(linear - knee, 0)
    linear = np.where(linear > knee, knee + (1 - knee) * over / (over + (1 - knee)), linear)
    return np.clip(linear, 0, 1) ** np.float32(1 / 2.2)


def auto_exposure(radiance: Array) -> float:
    """One exposure for a set of views: brings the mean log radiance to middle grey without burning out the highlights."""
    luminance = radiance.mean(-1)
    middle = float(np.exp(np.log(luminance + 1e-3).mean()))
    bright = float(np.quantile(luminance, 0.97))
    return float(min(0.2 / max(middle, 1e-4), 1.1 / max(bright, 1e-4)))


def _curve(image: Array, contrast: float, gamma: float) -> Array:
    bent = image + np.float32(contrast) * image * (1 - image) * (2 * image - 1)
    return np.clip(bent, 0, 1) ** np.float32(gamma)


def degrade(images: Array, generator: np.random.Generator) -> Array:
    """Photograph-like versions of clean display images.

    Exposure and white balance are common to the set (60 %) or drawn per view (40 %); then tone curve, gamma 1.8-2.6 over the
    nominal 2.2, blur (sigma 0-0.8 px), noise (0-2.5 %) and JPEG (quality 70-98).

    Args:
        images: (S,3,H,W) float32 in [0,1].
        generator: every draw.

    Returns:
        (S,3,H,W) float32 in [0,1].
    """
    rng = generator
    count = len(images)
    per_view = rng.random() < 0.4
    draws = count if per_view else 1
    gains = np.exp2(rng.normal(0, 0.25, (draws, 1))) * np.exp(rng.normal(0, 0.05, (draws, 3)))
    gains = np.broadcast_to(gains, (count, 3)).astype(np.float32)
    contrast, gamma = float(rng.uniform(-0.2, 0.7)), float(rng.uniform(1.8, 2.6) / 2.2)
    sigma, noise = float(rng.uniform(0, 0.8)), float(rng.uniform(0, 0.025))
    quality = int(rng.integers(70, 99))
    out = np.empty_like(images)
    for view in range(count):
        linear = np.ascontiguousarray(images[view].transpose(1, 2, 0)) ** np.float32(2.2) * gains[view]
        picture = _curve(np.clip(linear, 0, 1) ** np.float32(1 / 2.2), contrast, gamma)
        if sigma > 0.2:
            picture = cv2.GaussianBlur(picture, (0, 0), sigma)
        strength = np.float32(noise) * (np.float32(0.4) + np.float32(0.6) * np.sqrt(picture))
        picture = picture + strength * rng.standard_normal(picture.shape, dtype=np.float32)
        coded = np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8)[..., ::-1]
        packed = cv2.imencode(".jpg", coded, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        decoded = np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR))[..., ::-1]
        out[view] = decoded.transpose(2, 0, 1).astype(np.float32) / np.float32(255)
    return out
