"""Every kind of picture file that loaders meet, made on the fly."""

from __future__ import annotations

import contextlib
import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
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


@pytest.mark.parametrize(
    ("mode", "fmt"), [("LA", "PNG"), ("RGBA", "PNG"), ("RGBA", "TIFF"), ("RGBA", "WEBP"), ("LA", "TIFF")]
)
def test_transparent_pixels_are_not_valid(mode: str, fmt: str) -> None:
    rgba = np.full((20, 30, 4), 200, np.uint8)
    rgba[:, :10, 3], rgba[:, 10:20, 3], rgba[:, 20:, 3] = 0, 128, 255
    options = {"lossless": True, "exact": True} if fmt == "WEBP" else {}
    picture = decode_picture(encoded(Image.fromarray(rgba).convert(mode), fmt, **options), name="x", where="x")
    assert picture.valid is not None
    assert not picture.valid[:, :10].any()
    assert picture.valid[:, 10:].all()
    # Colours are what was painted: no ground shines through, whatever the opacity.
    assert (picture.pixels[:, 10:] == 200).all()
    assert "33% of it is transparent" in picture.notes[0]


@pytest.mark.parametrize("alpha", [255, 128, 3])
def test_even_opacity_hides_nothing(alpha: int) -> None:
    rgba = np.dstack([quadrants(), np.full((40, 60), alpha, np.uint8)])
    picture = decode_picture(encoded(Image.fromarray(rgba), "PNG"), name="x", where="x")
    assert picture.valid is None
    assert np.array_equal(picture.pixels, quadrants())
    assert len(picture.notes) == (alpha < 255)


def test_nothing_but_transparency_is_refused() -> None:
    assert "transparent nearly everywhere" in error_line(
        encoded(Image.fromarray(np.zeros((20, 30, 4), np.uint8)), "PNG")
    )


def test_masks_turn_with_their_pictures() -> None:
    rgba = np.dstack([quadrants(), np.where(np.arange(60) < 20, 0, 255).astype(np.uint8)[None].repeat(40, 0)])
    exif = Image.Exif()
    exif[0x0112] = 6
    picture = decode_picture(encoded(Image.fromarray(rgba), "PNG", exif=exif.tobytes()), name="x", where="x")
    assert picture.valid is not None
    assert picture.valid.shape == picture.shape == (60, 40)
    assert not picture.valid[:20].any()
    assert picture.valid[20:].all()


def test_palette_with_a_transparent_entry() -> None:
    palette = Image.fromarray(quadrants()).quantize(4)
    index = palette.getpixel((0, 0))
    picture = decode_picture(encoded(palette, "PNG", transparency=index), name="x", where="x")
    assert corners(picture.pixels) == [(0, 0, 0), GREEN, BLUE, WHITE]
    assert picture.valid is not None
    assert not picture.valid[:20, :30].any()
    assert picture.valid[20:].all()


def test_cmyk_jpeg_has_the_right_colours() -> None:
    found = corners(decode(encoded(Image.fromarray(quadrants()).convert("CMYK"), "JPEG", quality=98)))
    for colour, expected in zip(found, (RED, GREEN, BLUE, WHITE), strict=True):
        assert np.abs(np.subtract(colour, expected)).max() <= 8  # lossy; an inverted picture would be off by > 100


@pytest.mark.parametrize("fmt", ["PNG", "TIFF"])
def test_16_bit_grey_is_scaled_not_clipped(fmt: str) -> None:
    ramp = np.tile(np.linspace(0, 65535, 256).round().astype(np.uint16), (4, 1))
    found = decode(encoded(Image.fromarray(ramp), fmt))
    assert np.array_equal(found[0, :, 0], np.arange(256))  # 65535 / 255 = 257 exactly


def png_16(samples: np.ndarray, *chunks: tuple[bytes, bytes]) -> bytes:
    """A PNG of 16-bit colour samples (H, W, 3) or grey ones (H, W)."""
    height, width = samples.shape[:2]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in samples)
    header = struct.pack(">IIBBBBB", width, height, 16, 2 if samples.ndim == 3 else 0, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n"
    for kind, body in ((b"IHDR", header), *chunks, (b"IDAT", zlib.compress(rows)), (b"IEND", b"")):
        data += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    return data


def tiff(samples: np.ndarray, **options: object) -> bytes:
    buffer = io.BytesIO()
    kind = "rgb" if samples.ndim == 3 else "minisblack"
    tifffile.imwrite(buffer, samples, photometric=kind, **options)
    return buffer.getvalue()


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("kind", [png_16, tiff])
@pytest.mark.parametrize("channels", [1, 3])
def test_samples_are_scaled_by_the_depth_they_use(bits: int, kind: Callable[..., bytes], channels: int) -> None:
    top = 2**bits - 1
    ramp = np.rint(np.linspace(0, top, 256)).astype(np.uint16)[None].repeat(40, 0)
    samples = ramp if channels == 1 else np.stack([ramp, ramp // 2, ramp // 4], -1)
    picture = decode_picture(kind(samples), name="x", where="x")
    assert np.abs(picture.pixels[0, :, 0].astype(int) - np.arange(256)).max() <= 1
    if channels == 3:
        assert np.abs(picture.pixels[0, :, 2].astype(int) - np.arange(256) // 4).max() <= 1
    assert [f"{bits}-bit" in note for note in picture.notes] == ([True] if bits < 16 else [])


def test_what_a_file_says_of_its_depth_counts_more_than_its_brightest_sample() -> None:
    dark = np.linspace(0, 4000, 256).astype(np.uint16)[None, :, None].repeat(40, 0).repeat(3, 2)
    assert decode(png_16(dark, (b"sBIT", bytes([16, 16, 16])))).max() == round(4000 / 257)
    assert decode(tiff(dark, extratags=[(281, "H", 3, (65535,) * 3, True)])).max() == round(4000 / 257)
    assert decode(tiff(dark // 2, extratags=[(281, "H", 3, (4095,) * 3, True)])).max() == round(2000 * 255 / 4095)


@pytest.mark.timeout(20)
@pytest.mark.parametrize("length", [0xFFFFFFF0, 0x7FFFFFFF, 10**6])
def test_chunks_that_announce_more_than_there_is_cost_nothing(length: int, capfd: pytest.CaptureFixture[str]) -> None:
    data = bytearray(png_16(quadrants().astype(np.uint16) * 257, (b"tEXt", b"a\0b")))
    start = data.index(b"tEXt")
    data[start - 4 : start] = struct.pack(">I", length)
    assert "damaged" in error_line(bytes(data))
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("orientation", sorted(STORED))
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_tiff_is_turned_whatever_its_samples(orientation: int, dtype: type) -> None:
    top = {np.uint8: 1, np.uint16: 257, np.float32: 1 / 255}[dtype]
    stored = np.ascontiguousarray((STORED[orientation](quadrants()) * np.float64(top)).astype(dtype))
    data = tiff(stored, extratags=[(274, "H", 1, orientation, True)])
    assert np.array_equal(decode(data), quadrants())


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_floating_point_samples(channels: int, dtype: type) -> None:
    if channels == 1 and dtype == np.float64:
        pytest.skip("not a format that Pillow opens")
    ramp = np.linspace(0, 1, 256, dtype=dtype)[None].repeat(40, 0)
    samples = ramp if channels == 1 else np.stack([ramp] * 3, -1)
    assert np.array_equal(decode(tiff(samples))[0, :, 0], np.arange(256))
    assert np.array_equal(decode(tiff(samples * 255))[0, :, 0], np.arange(256))
    for factor, expected in ((40, "from 0 to 40"), (4000, "from 0 to 4000"), (np.nan, "finite"), (-1, "from -1")):
        assert expected in error_line(tiff((samples * factor).astype(dtype)))


@pytest.mark.parametrize(
    "samples",
    [np.full((40, 60, 3), 10**6, np.int32), np.zeros((40, 60, 3), np.float16), np.zeros((40, 60), np.complex64)],
)
def test_samples_that_cannot_be_read_are_one_line(samples: np.ndarray) -> None:
    error_line(tiff(samples))


def test_colours_in_planes_are_not_mixed_up() -> None:
    planes = np.moveaxis(quadrants(), -1, 0)
    assert np.array_equal(decode(tiff(planes, planarconfig="separate")), quadrants())
    assert "separate planes" in error_line(tiff(planes.astype(np.uint16) * 257, planarconfig="separate"))


def matrix_profile(primaries: list[tuple[float, float, float]], gamma: float, *, space: bytes = b"RGB ") -> bytes:
    """An ICC profile made of the XYZ (D50) of red, green and blue and one exponent."""

    def fixed(*values: float) -> bytes:
        return b"".join(struct.pack(">i", round(value * 65536)) for value in values)

    curve = b"curv" + bytes(4) + struct.pack(">IH", 1, round(gamma * 256)) + bytes(2)
    text = b"desc" + bytes(4) + struct.pack(">I", 5) + b"test\0" + bytes(78)
    bodies = {
        b"desc": text,
        b"cprt": b"text" + bytes(4) + b"none\0\0\0\0",
        b"wtpt": b"XYZ " + bytes(4) + fixed(0.9642, 1, 0.8249),
    }
    for name, colour in zip((b"rXYZ", b"gXYZ", b"bXYZ"), primaries, strict=True):
        bodies[name] = b"XYZ " + bytes(4) + fixed(*colour)
    bodies |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)
    table, content, start = b"", b"", 128 + 4 + 12 * len(bodies)
    for name, body in bodies.items():
        table += name + struct.pack(">II", start + len(content), len(body))
        content += body + bytes(-len(body) % 4)
    size = start + len(content)
    header = struct.pack(">I4sI4s4s4s", size, b"test", 0x02100000, b"mntr", space, b"XYZ ") + bytes(12) + b"acsp"
    header += bytes(28) + fixed(0.9642, 1, 0.8249) + bytes(48)
    return header + struct.pack(">I", len(bodies)) + table + content


ADOBE_RGB = [(0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457)]
SRGB = [(0.43607, 0.22249, 0.01392), (0.38515, 0.71687, 0.09708), (0.14307, 0.06061, 0.71410)]


@pytest.mark.parametrize(("fmt", "bits"), [("PNG", 8), ("JPEG", 8), ("TIFF", 8), ("WEBP", 8), ("PNG", 16)])
def test_colours_are_converted_to_srgb(fmt: str, bits: int) -> None:
    grey_green = np.full((40, 60, 3), (100, 160, 100), np.uint8)
    profile = matrix_profile(ADOBE_RGB, 2.2)
    if bits == 16:
        data = png_16(grey_green.astype(np.uint16) * 257, (b"iCCP", b"x\0\0" + zlib.compress(profile)))
    else:
        options = {"quality": 100} if fmt != "TIFF" else {}
        data = encoded(Image.fromarray(grey_green), fmt, icc_profile=profile, **options)
    found = decode(data)[20, 30].astype(int)
    # The same colour has a larger distance from grey in the smaller colour space.
    linear = np.array([[*column] for column in ADOBE_RGB]).T @ (np.array([100, 160, 100]) / 255) ** 2.2
    expected = np.clip(np.linalg.solve(np.array(SRGB).T, linear), 0, 1) ** (1 / 2.2) * 255
    assert np.abs(found - expected).max() <= 5  # the exponent of sRGB is only nearly 2.2
    assert found[1] - found[0] > 65


@pytest.mark.parametrize(
    "profile",
    [b"no profile", b"\0" * 200, matrix_profile(ADOBE_RGB, 2.2)[:150], matrix_profile(ADOBE_RGB, 2.2, space=b"GRAY")],
)
def test_profiles_that_cannot_be_used_are_noted(profile: bytes) -> None:
    picture = decode_picture(encoded(Image.fromarray(quadrants()), "PNG", icc_profile=profile), name="x", where="x")
    assert np.array_equal(picture.pixels, quadrants())
    assert len(picture.notes) == 1
    assert "ignored" in picture.notes[0]


def test_libtiff_is_not_heard(capfd: pytest.CaptureFixture[str]) -> None:
    data = bytearray(encoded(Image.fromarray(quadrants()), "TIFF", compression="tiff_lzw"))
    for start in (30, 200, 300):
        broken = bytearray(data)
        broken[start : start + 40] = bytes(range(200, 240))
        with contextlib.suppress(UserError):
            decode(bytes(broken))
    with pytest.raises(UserError):
        decode(bytes(data[: len(data) // 2]))
    assert capfd.readouterr().err == ""


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


@pytest.mark.parametrize("side", [4500, 8200, 14000])
def test_few_bytes_that_announce_many_pixels_are_refused(side: int) -> None:
    data = encoded(Image.new("L", (side, side)), "PNG")
    assert "no photo is like that" in error_line(data)
    assert f"{side} x {side}" in error_line(data)


@pytest.mark.parametrize("fmt", ["AVIF", "JPEG2000", "PPM", "GIF"])
def test_other_formats_are_read_by_content(fmt: str) -> None:
    found = corners(decode(encoded(Image.fromarray(quadrants()), fmt)))
    for colour, expected in zip(found, (RED, GREEN, BLUE, WHITE), strict=True):
        assert np.abs(np.subtract(colour, expected)).max() <= 25  # lossy


@pytest.mark.parametrize(
    ("head", "words"),
    [
        (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", "HEIC/HEIF"),
        (b"\0\0\0\x18ftypmif1\0\0\0\0mif1heic", "HEIC/HEIF"),
        (b"\0\0\0\x0cJXL \r\n\x87\n", "JPEG XL"),
        (b"\xff\x0a\xfa\x1f", "JPEG XL"),
        (b"\0\0\0\x14ftypqt  ", "a video"),
        (b"\0\0\0\x14ftypisom", "a video"),
        (b"\x1aE\xdf\xa3\x01", "a video"),
        (b"%PDF-1.7", "PDF"),
        (b"8BPS\0\x01", "Photoshop"),
        (b"II*\0\x10\0\0\0CR\x02\0", "raw picture"),
        (b"v/1\x01\x02\0", "OpenEXR"),
        (b"<!DOCTYPE html><html>", "web page"),
        (b"<?xml version='1.0'?><svg>", "SVG"),
        (b'{"error": {}}', "JSON"),
        (b"PK\x03\x04", "ZIP"),
    ],
)
def test_the_true_kind_is_named(head: bytes, words: str) -> None:
    assert words in error_line(head + bytes(range(1, 200)))


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="does not exist"):
        read_picture(tmp_path / "none.jpg")
