"""The common frame and the exact map into it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneexpander.artifacts.views import ViewRecord
from sceneexpander.ingest.fit import PAD_GREY, FrameSize, common_frame, fit_picture

FRAME = FrameSize(height=56, width=84, detail_height=112, detail_width=168)


def blob(height: int, width: int, x: float, y: float, sigma: float) -> np.ndarray:
    """A Gaussian blob at corner-origin coordinates (x, y)."""
    yy, xx = np.mgrid[:height, :width] + 0.5
    value = 255 * np.exp(-((xx - x) ** 2 + (yy - y) ** 2) / (2 * sigma**2))
    return np.repeat(np.rint(value)[:, :, None], 3, 2).astype(np.uint8)


def centroid(pixels: np.ndarray, background: float = 0) -> tuple[float, float]:
    weight = pixels[:, :, 0].astype(np.float64)
    weight[np.abs(weight - background) < 3] = 0
    yy, xx = np.mgrid[: weight.shape[0], : weight.shape[1]] + 0.5
    return float((weight * xx).sum() / weight.sum()), float((weight * yy).sum() / weight.sum())


@pytest.mark.parametrize("shape", [(300, 400), (400, 300), (303, 401), (40, 60), (768, 705)])
def test_crop_affine_says_where_pixels_went(shape: tuple[int, int]) -> None:
    height, width = shape
    x, y = 0.55 * width, 0.47 * height
    fitted = fit_picture(blob(height, width, x, y, min(shape) * 0.05), FRAME, "crop")
    assert fitted.image.shape == (56, 84, 3)
    assert fitted.detail.shape == (112, 168, 3)
    affine = np.asarray(fitted.stored_from_original)
    expected = affine @ [x, y, 1]
    # Half a grey level of rounding over a blob of a few pixels moves its centroid by far less than 0.05 px.
    assert np.allclose(centroid(fitted.image), expected, atol=0.05)
    assert np.allclose(np.divide(centroid(fitted.detail), 2), expected, atol=0.05)


def test_pad_shows_everything_on_grey() -> None:
    fitted = fit_picture(np.full((300, 200, 3), 250, np.uint8), FRAME, "pad")
    assert fitted.kept == pytest.approx(1.0)
    assert (fitted.image[:, :20] == PAD_GREY).all()
    assert (fitted.image[:, -20:] == PAD_GREY).all()
    assert (fitted.image[:, 30:-30] >= 248).all()
    scale = fitted.stored_from_original[0][0]
    assert scale == pytest.approx(56 / 300)
    # The picture's centre line is the frame's centre line.
    assert np.asarray(fitted.stored_from_original) @ [100, 150, 1] == pytest.approx([42, 28])


def test_pad_affine_says_where_pixels_went() -> None:
    x, y = 110.0, 140.0
    fitted = fit_picture(blob(300, 200, x, y, 20), FRAME, "pad")
    content = fitted.image.copy()
    content[:, :24] = content[:, -24:] = 0  # the grey border and its edge
    expected = np.asarray(fitted.stored_from_original) @ [x, y, 1]
    assert np.allclose(centroid(content), expected, atol=0.1)  # the cut tail of the blob moves it a little


@settings(max_examples=60, deadline=None)
@given(
    height=st.integers(10, 5000),
    width=st.integers(10, 5000),
    fit=st.sampled_from(["crop", "pad"]),
    x=st.floats(0, 1),
    y=st.floats(0, 1),
)
def test_affine_inverse(height: int, width: int, fit: str, x: float, y: float) -> None:
    scale = (max if fit == "crop" else min)(56 / height, 84 / width)
    small = np.zeros((height, width, 3), np.uint8) if height * width < 40_000 else None
    affine = ((scale, 0.0, 42 - width * scale / 2), (0.0, scale, 28 - height * scale / 2))
    if small is not None:
        assert np.allclose(fit_picture(small, FRAME, fit).stored_from_original, affine, atol=1e-9)  # type: ignore[arg-type]
    record = ViewRecord(
        view_id="0", name="0", original_height=height, original_width=width, sha256="", stored_from_original=affine
    )
    point = np.array([x * width, y * height])
    stored = np.asarray(affine) @ [*point, 1]
    back = np.asarray(record.original_from_stored()) @ [*stored, 1]
    assert np.abs(back - point).max() < 0.01


@pytest.mark.parametrize(
    ("first", "expected"),
    [((706, 768), (308, 336)), ((436, 768), (196, 336)), ((1008, 1512), (224, 336)), ((768, 436), (336, 196))],
)
def test_common_frame_follows_the_first_view(first: tuple[int, int], expected: tuple[int, int]) -> None:
    frame = common_frame([first, (100, 100)], long_side_px=336, multiple=14, detail_scale=2)
    assert (frame.height, frame.width) == expected
    assert (frame.detail_height, frame.detail_width) == (expected[0] * 2, expected[1] * 2)


def test_detail_is_not_larger_than_the_originals() -> None:
    frame = common_frame([(400, 500), (400, 500)], long_side_px=336, multiple=14, detail_scale=2)
    assert frame.height / frame.width == frame.detail_height / frame.detail_width
    assert 336 <= frame.detail_width <= 500
    tiny = common_frame([(30, 40)], long_side_px=336, multiple=14, detail_scale=4)
    assert (tiny.detail_height, tiny.detail_width) == (tiny.height, tiny.width)


def test_extreme_aspect_keeps_one_patch() -> None:
    frame = common_frame([(10, 3000)], long_side_px=336, multiple=14, detail_scale=2)
    assert (frame.height, frame.width) == (14, 336)


def test_downscaling_is_antialiased() -> None:
    checker = ((np.indices((560, 840)).sum(0) % 2) * 255).astype(np.uint8)
    fitted = fit_picture(np.repeat(checker[:, :, None], 3, 2), FRAME)
    # A one-pixel checkerboard shrunk ten times is flat grey; picking pixels would leave black and white.
    assert np.abs(fitted.image.astype(int) - 127).max() <= 6


def test_frame_refuses_another_framing() -> None:
    with pytest.raises(ValueError, match="framing"):
        FrameSize(height=56, width=84, detail_height=112, detail_width=169)
