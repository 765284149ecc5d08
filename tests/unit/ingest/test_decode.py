"""Every kind of picture file that loaders meet, made on the fly."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sceneexpander.errors import UserError
from sceneexpander.ingest.decode import decode_picture, read_picture, read_picture_shape

RED, GREEN, BLUE, WHITE = (200, 30, 20), (20, 180, 40), (30, 40, 210), (240, 240, 240)


def quadrants(height: int = 40, width: int = 60) -> np.ndarray:
    """Upright truth: red, green above blue, white."""
    pixels = np.zeros((height, width, 3), np.uint8)
    pixels[: height // 2, : width // 2], pixels[: height // 2, width // 2 :] = RED, GREEN
    pixels[height // 2 :, : width // 2], pixels[height // 2 :, width // 2 :] = BLUE, WHITE
    return pixels


def corners(pixels: np.ndarray) -> list[tuple[int, ...]]:
    return [tuple(int(v) for v in pixels[y, x]) for y, x in ((4, 4), (4, -5), (-5, 4), (-5, -5))]


def encoded(image: Image.Image, fmt: str, **options: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, format=fmt, **options)
    return buffer.getvalue()


def decode(data: bytes) -> np.ndarray:
    return decode_picture(data, name="x", where="x.img").pixels


def error_line(data: bytes, **options: float) -> str:
    with pytest.raises(UserError) as caught:
        decode_picture(data, name="x", where="folder/x.jpg", **options)
    line = caught.value.line()
    assert line.startswith("folder/x.jpg: ")
    assert "\n" not in line
    assert "<_io" not in line
    return line


# How a camera that was turned stores the upright picture, by tag value.
STORED = {
    1: lambda p: p,
    2: lambda p: p[:, ::-1],
    3: lambda p: p[::-1, ::-1],
    4: lambda p: p[::-1],
    5: lambda p: p.swapaxes(0, 1),
    6: lambda p: np.rot90(p, 1),
    7: lambda p: np.rot90(p, 2).swapaxes(0, 1),
    8: lambda p: np.rot90(p, -1),
}


@pytest.mark.parametrize("orientation", sorted(STORED))
@pytest.mark.parametrize("fmt", ["JPEG", "PNG"])
def test_orientation_is_baked_in(tmp_path: Path, orientation: int, fmt: str) -> None:
    stored = np.ascontiguousarray(STORED[orientation](quadrants()))
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / "photo.jpg"
    path.write_bytes(encoded(Image.fromarray(stored), fmt, exif=exif.tobytes(), quality=95))
    picture = read_picture(path)
    assert (picture.height, picture.width) == (40, 60) == read_picture_shape(path)
    for found, expected in zip(corners(picture.pixels), (RED, GREEN, BLUE, WHITE), strict=True):
        assert np.abs(np.subtract(found, expected)).max() <= 4  # JPEG at quality 95


def test_a_senseless_orientation_means_upright() -> None:
    exif = Image.Exif()
    exif[0x0112] = 77
    assert corners(decode(encoded(Image.fromarray(quadrants()), "PNG", exif=exif.tobytes())))[0] == RED


@pytest.mark.parametrize("fmt", ["PNG", "BMP", "TIFF", "GIF"])
def test_lossless_formats_keep_every_pixel(fmt: str) -> None:
    assert np.array_equal(decode(encoded(Image.fromarray(quadrants()), fmt)), quadrants())


def test_bytes_decide_not_the_extension(tmp_path: Path) -> None:
    path = tmp_path / "really_a_png.JPG"
    path.write_bytes(encoded(Image.fromarray(quadrants()), "PNG"))
    assert read_picture(path).file_format == "PNG"
    path = tmp_path / "really_a_jpeg.png"
    path.write_bytes(encoded(Image.fromarray(quadrants()), "JPEG"))
    assert read_picture(path).file_format == "JPEG"


def test_palette_of_every_depth() -> None:
    palette = Image.fromarray(quadrants()).quantize(4)
    for bits in (2, 4, 8):
        found = corners(decode(encoded(palette, "PNG", bits=bits)))
        assert found == [RED, GREEN, BLUE, WHITE]


def test_grey_and_bilevel() -> None:
    grey = np.tile(np.arange(60, dtype=np.uint8) * 4, (40, 1))
    assert np.array_equal(decode(encoded(Image.fromarray(grey), "PNG")), np.repeat(grey[:, :, None], 3, 2))
    bilevel = Image.fromarray(grey > 100)
    assert set(np.unique(decode(encoded(bilevel, "PNG")))) == {0, 255}


@pytest.mark.parametrize("mode", ["LA", "RGBA"])
def test_transparency_goes_over_black(mode: str) -> None:
    rgba = np.full((20, 30, 4), 255, np.uint8)
    rgba[:, :10, 3], rgba[:, 10:20, 3] = 0, 128
    found = decode(encoded(Image.fromarray(rgba).convert(mode), "PNG"))
    assert (found[:, :10] == 0).all()
    assert np.abs(found[:, 10:20].astype(int) - 128).max() <= 1
    assert (found[:, 20:] == 255).all()


def test_palette_with_a_transparent_entry() -> None:
    palette = Image.fromarray(quadrants()).quantize(4)
    index = palette.getpixel((0, 0))
    found = corners(decode(encoded(palette, "PNG", transparency=index)))
    assert found == [(0, 0, 0), GREEN, BLUE, WHITE]


def test_cmyk_jpeg_has_the_right_colours() -> None:
    found = corners(decode(encoded(Image.fromarray(quadrants()).convert("CMYK"), "JPEG", quality=98)))
    for colour, expected in zip(found, (RED, GREEN, BLUE, WHITE), strict=True):
        assert np.abs(np.subtract(colour, expected)).max() <= 8  # lossy; an inverted picture would be off by > 100


@pytest.mark.parametrize("fmt", ["PNG", "TIFF"])
def test_16_bit_grey_is_scaled_not_clipped(fmt: str) -> None:
    ramp = np.tile(np.linspace(0, 65535, 256).round().astype(np.uint16), (4, 1))
    found = decode(encoded(Image.fromarray(ramp), fmt))
    assert np.array_equal(found[0, :, 0], np.arange(256))  # 65535 / 255 = 257 exactly


def test_16_bit_rgb_png_is_scaled() -> None:
    ramp = (np.arange(256, dtype=">u2") * 257)[None, :, None].repeat(3, 2).repeat(2, 0)
    rows = b"".join(b"\0" + row.tobytes() for row in ramp)
    header = struct.pack(">IIBBBBB", 256, 2, 16, 2, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n"
    for kind, body in ((b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")):
        data += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    assert np.array_equal(decode(data)[0, :, 1], np.arange(256))


def test_float_tiff() -> None:
    ramp = np.tile(np.linspace(0, 1, 256, dtype=np.float32), (4, 1))
    assert np.array_equal(decode(encoded(Image.fromarray(ramp), "TIFF"))[0, :, 0], np.arange(256))
    assert "from 0 to 40" in error_line(encoded(Image.fromarray(ramp * 40), "TIFF"))
    assert "nan" in error_line(encoded(Image.fromarray(ramp * np.float32(np.nan)), "TIFF"))


@pytest.mark.parametrize("fmt", ["GIF", "WEBP", "PNG"])
def test_animations_give_their_first_frame(fmt: str) -> None:
    frames = [Image.fromarray(np.full((16, 16, 3), value, np.uint8)) for value in (200, 90, 10)]
    data = encoded(frames[0], fmt, save_all=True, append_images=frames[1:])
    assert np.abs(decode(data).astype(int) - 200).max() <= 2


@pytest.mark.parametrize("fmt", ["JPEG", "PNG", "WEBP", "TIFF", "BMP", "GIF"])
def test_truncated_files_are_named(fmt: str) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    data = encoded(Image.fromarray(noise), fmt)
    assert "damaged or truncated" in error_line(data[: len(data) * 2 // 3])
    assert "damaged or truncated" in error_line(data[:40])


def test_files_that_are_no_pictures() -> None:
    assert "is empty" in error_line(b"")
    assert "not a picture" in error_line(b"hello, this is a letter")
    assert "pillow-heif" in error_line(b"\0\0\0\x18ftypheic" + bytes(50))
    assert "git lfs pull" in error_line(b"version https://git-lfs.github.com/spec/v1\noid sha256:00\n")
    assert "not a picture" in error_line(b"BM, dear reader, is how this text begins" * 40)


def test_depth_dump_named_jpg_is_recognised() -> None:
    depth = np.random.default_rng(0).uniform(1, 20, (40, 60)).astype("<f4")
    depth[:10] = np.inf
    assert "raw float32 depth map" in error_line(depth.tobytes())
    # Random bytes are not mistaken for one.
    noise = np.random.default_rng(1).integers(1, 255, 9600, dtype=np.uint8).tobytes()
    assert "not a picture" in error_line(noise)


def test_bombs_are_refused_before_decoding() -> None:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", 60000, 60000, 8, 2, 0, 0, 0)
    bomb = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(1000)))
    assert "60000 x 60000" in error_line(bomb + chunk(b"IEND", b""))
    assert "0.001 MP allowed" in error_line(encoded(Image.fromarray(quadrants()), "PNG"), max_megapixels=0.001)
    text = chunk(b"zTXt", b"note\0\0" + zlib.compress(bytes(200_000_000)))
    small = encoded(Image.fromarray(quadrants()), "PNG")
    assert "damaged" in error_line(small[:33] + text + small[33:])


def test_pillows_global_limit_is_left_alone() -> None:
    before = Image.MAX_IMAGE_PIXELS
    decode(encoded(Image.fromarray(quadrants()), "PNG"))
    assert before == Image.MAX_IMAGE_PIXELS


def test_exif_focal_length() -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 36
    data = encoded(Image.fromarray(np.zeros((240, 360, 3), np.uint8)), "JPEG", exif=exif.tobytes())
    # A 3:2 frame is the 36 mm wide one itself: 36 mm is then exactly the picture's width.
    assert decode_picture(data, name="x", where="x").exif_focal_px == pytest.approx(360, rel=1e-9)
    assert decode_picture(encoded(Image.fromarray(quadrants()), "JPEG"), name="x", where="x").exif_focal_px is None


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="does not exist"):
        read_picture(tmp_path / "none.jpg")
