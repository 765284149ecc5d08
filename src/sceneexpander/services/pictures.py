"""Pictures as services are sent them."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sceneexpander.artifacts.store import sha256_of_bytes

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class SentPicture:
    """A PNG of pixels and nothing else. ``pixels_sha256`` does not change with the encoder."""

    png: bytes
    pixels_sha256: str


def encode_picture(pixels: np.ndarray, *, long_side_px: int) -> SentPicture:
    """``pixels``, (height, width, 3) of 8-bit RGB, made smaller until no side is longer than ``long_side_px``."""
    # Only now: settings of whoever is asked are read by stages that ask nobody.
    import numpy as np
    from PIL import Image

    picture = Image.fromarray(pixels)
    scale = min(1.0, long_side_px / max(picture.size))
    size = (max(1, round(picture.width * scale)), max(1, round(picture.height * scale)))
    shown = picture if size == picture.size else picture.resize(size, Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    shown.save(buffer, format="PNG")
    sent = np.asarray(shown)
    return SentPicture(png=buffer.getvalue(), pixels_sha256=sha256_of_bytes(f"{sent.shape}".encode() + sent.tobytes()))
