"""What files say of their lens: right where it is right, nothing where it is senseless."""

from __future__ import annotations

import io
import math
import struct

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from sceneexpander.artifacts.views import LensFacts
from sceneexpander.ingest.decode import decode_picture
from sceneexpander.ingest.lens import number, read_lens

DIAGONAL_35MM = math.hypot(36, 24)
MAKE, MODEL, ORIENTATION = 0x010F, 0x0110, 0x0112
FOCAL, FOCAL_35, ZOOM, WIDTH, HEIGHT = 0x920A, 0xA405, 0xA404, 0xA002, 0xA003
PLANE_X, PLANE_Y, UNIT, LENS, SPECIFICATION, F_NUMBER = 0xA20E, 0xA20F, 0xA210, 0xA434, 0xA432, 0x829D


class Tags(dict[int, object]):
    """Stands in for the tags of a file, with values that no library would write."""

    def __init__(self, main: dict[int, object] | None = None, **details: object) -> None:
        super().__init__(main or {})
        self.details: dict[int, object] = {}

    def get_ifd(self, _: int) -> dict[int, object]:
        return self.details


def facts(
    details: dict[int, object],
    *,
    size: tuple[int, int] = (3024, 4032),
    turned: bool = False,
    xmp: str = "",
    main: dict[int, object] | None = None,
) -> tuple[LensFacts, list[str]]:
    tags = Tags(main)
    tags.details = details
    return read_lens(tags, xmp, height=size[0], width=size[1], turned=turned)  # type: ignore[arg-type]


def jpeg(details: dict[int, object], size: tuple[int, int], main: dict[int, object] | None = None) -> bytes:
    exif = Image.Exif()
    for tag, value in (main or {}).items():
        exif[tag] = value
    for tag, value in details.items():
        exif.get_ifd(0x8769)[tag] = value
    buffer = io.BytesIO()
    Image.fromarray(np.zeros((*size, 3), np.uint8)).save(buffer, format="JPEG", exif=exif.tobytes())
    return buffer.getvalue()


def test_a_phone_from_its_file() -> None:
    data = jpeg(
        {FOCAL: 4.25, FOCAL_35: 26, LENS: "back camera 4.25mm f/1.8", WIDTH: 403, HEIGHT: 302},
        (302, 403),
        {MAKE: "Apple", MODEL: "iPhone 11"},
    )
    lens = decode_picture(data, name="x", where="x").lens
    assert lens == LensFacts(
        camera="Apple iPhone 11",
        lens="back camera 4.25mm f/1.8",
        focal_mm=4.25,
        focal_px=pytest.approx(26 / DIAGONAL_35MM * math.hypot(302, 403)),
        focal_rule="35 mm equivalent",
        exif_size=(302, 403),
    )


@pytest.mark.parametrize("size", [(240, 360), (300, 400), (400, 300), (225, 400), (360, 360)])
def test_the_equivalent_is_a_share_of_the_diagonal(size: tuple[int, int]) -> None:
    found, notes = facts({FOCAL_35: 36}, size=size)
    assert found.focal_px == pytest.approx(36 / DIAGONAL_35MM * math.hypot(*size))
    assert not notes


@pytest.mark.parametrize(("unit", "per_mm"), [(2, 1 / 25.4), (3, 1 / 10), (4, 1), (None, 1 / 25.4)])
def test_resolution_of_the_sensor_and_its_units(unit: int | None, per_mm: float) -> None:
    # 4032 pixels on 5.6 mm, and a focal length of 4.2 mm: three quarters of the width.
    details: dict[int, object] = {FOCAL: 4.2, PLANE_X: 720 / per_mm, PLANE_Y: 720 / per_mm, WIDTH: 4032, HEIGHT: 3024}
    if unit is not None:
        details[UNIT] = unit
    found, _ = facts(details)
    assert found.focal_px == pytest.approx(0.75 * 4032)
    assert "sensor" in found.focal_rule
    # The resolution is that of the camera's picture: a resized file has fewer pixels per millimetre.
    for factor in (0.5, 0.25, 2.0):
        size = (round(3024 * factor), round(4032 * factor))
        assert facts(details, size=size)[0].focal_px == pytest.approx(0.75 * 4032 * factor)


@pytest.mark.parametrize("unit", [0, 1, 6, 99, "inch", float("nan"), 5])
def test_resolutions_that_no_sensor_has_are_left_out(unit: object) -> None:
    details = {FOCAL: 4.2, PLANE_X: 720.0, UNIT: unit, WIDTH: 4032, HEIGHT: 3024}
    assert facts(details)[0].focal_px is None


def test_digital_zoom() -> None:
    plane = {FOCAL: 4.2, PLANE_X: 720.0, UNIT: 4, WIDTH: 4032, HEIGHT: 3024}
    assert facts({**plane, ZOOM: 2.0})[0].focal_px == pytest.approx(2 * 0.75 * 4032)
    for unused in (0, 1, float("nan"), -3, "x"):
        assert facts({**plane, ZOOM: unused})[0].focal_px == pytest.approx(0.75 * 4032)
    # The equivalent holds the zoom, unless it agrees with the sensor without it.
    without = 0.75 * 4032 / math.hypot(3024, 4032) * DIAGONAL_35MM
    assert facts({**plane, FOCAL_35: 2 * without, ZOOM: 2.0})[0].focal_px == pytest.approx(2 * 0.75 * 4032)
    assert facts({**plane, FOCAL_35: without, ZOOM: 2.0})[0].focal_px == pytest.approx(2 * 0.75 * 4032)
    assert facts({FOCAL_35: 52, ZOOM: 2.0})[0].focal_px == pytest.approx(52 / DIAGONAL_35MM * 5040)


@pytest.mark.parametrize("size", [(3024, 3024), (1500, 4032), (3024, 2268), (2000, 3000)])
def test_cropped_files_keep_the_focal_length_of_the_whole(size: tuple[int, int]) -> None:
    found, notes = facts({FOCAL_35: 26, WIDTH: 4032, HEIGHT: 3024}, size=size)
    assert found.focal_px == pytest.approx(26 / DIAGONAL_35MM * 5040)
    assert notes == [f"was cropped after it was taken (4032 x 3024 -> {size[1]} x {size[0]})"]
    assert found.exif_size == (3024, 4032)


@pytest.mark.parametrize("size", [(3024, 4500), (4032, 4032), (10, 9000)])
def test_a_written_size_smaller_than_the_file_is_not_believed(size: tuple[int, int]) -> None:
    found, _ = facts({FOCAL_35: 26, FOCAL: 4.2, PLANE_X: 720.0, UNIT: 4, WIDTH: 4032, HEIGHT: 3024}, size=size)
    assert found.exif_size is None
    assert found.focal_rule == "35 mm equivalent"
    assert found.focal_px == pytest.approx(26 / DIAGONAL_35MM * math.hypot(*size))


@pytest.mark.parametrize("size", [(3024, 4032), (1512, 2016), (768, 1024), (480, 640), (600, 801)])
def test_resized_files_are_not_cropped(size: tuple[int, int]) -> None:
    found, notes = facts({FOCAL_35: 26, WIDTH: 4032, HEIGHT: 3024}, size=size)
    assert found.focal_px == pytest.approx(26 / DIAGONAL_35MM * math.hypot(*size))
    assert not notes


@pytest.mark.parametrize("turned", [True, False])
def test_turned_files_are_not_cropped(turned: bool) -> None:
    # Sizes are written before turning; software that turns the pixels leaves them.
    for size in ((4032, 3024), (1600, 1200)):
        found, notes = facts({FOCAL_35: 26, WIDTH: 4032, HEIGHT: 3024}, size=size, turned=turned)
        assert found.exif_size == (4032, 3024)
        assert found.focal_px == pytest.approx(26 / DIAGONAL_35MM * math.hypot(*size))
        assert not notes


def test_orientation_in_a_file() -> None:
    data = jpeg({FOCAL_35: 26, WIDTH: 403, HEIGHT: 302}, (302, 403), {ORIENTATION: 6})
    picture = decode_picture(data, name="x", where="x")
    assert picture.shape == (403, 302)
    assert picture.lens.exif_size == (403, 302)
    assert not picture.notes


SENSELESS = [
    *(
        0,
        -26,
        float("nan"),
        float("inf"),
        1e12,
        "",
        "26",
        b"",
        (),
        (1, 2, 3),
        None,
        True,
        (26, 0),
        (0, 0),
        "many",
        [26],
        {},
    ),
    *(IFDRational(0, 0), IFDRational(26, 0), IFDRational(-26, 1), (IFDRational(0, 0),)),
]


@pytest.mark.parametrize("value", SENSELESS, ids=repr)
@pytest.mark.parametrize("tag", [FOCAL_35, FOCAL, ZOOM, PLANE_X, UNIT, WIDTH, SPECIFICATION, LENS, F_NUMBER])
def test_senseless_values_are_never_an_error_and_never_a_focal_length(value: object, tag: int) -> None:
    details = {FOCAL: 4.2, PLANE_X: 720.0, UNIT: 4, WIDTH: 4032, HEIGHT: 3024} | {tag: value}
    found, _ = facts(details, main={MAKE: value, MODEL: value})
    if found.focal_px is not None:
        assert 0.2 <= found.focal_px / 4032 <= 8
    if tag == FOCAL_35 and value not in ("26",):
        assert "35 mm" not in found.focal_rule


@pytest.mark.parametrize("equivalent", [1, 5, 6, 300, 600, 2000])
def test_implausible_focal_lengths_are_not_believed(equivalent: int) -> None:
    found, notes = facts({FOCAL_35: equivalent})
    share = equivalent / DIAGONAL_35MM * 5040 / 4032
    assert (found.focal_px is not None) == (0.2 <= share <= 8)
    assert bool(notes) == (found.focal_px is None)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (26, 26),
        (26.5, 26.5),
        ((26,), 26),
        ((52, 2), 26),
        ("26 mm", 26),
        ("420/100", 4.2),
        ("4,2", 4.2),
        (b"26", 26),
        (IFDRational(17, 4), 4.25),
    ],
)
def test_forms_of_numbers(value: object, expected: float) -> None:
    assert number(value) == pytest.approx(expected)


def test_what_tells_the_lenses_of_a_device_apart() -> None:
    names = set()
    for focal, aperture in ((1.54, 2.4), (4.25, 1.8), (6.0, 2.0)):
        names.add(facts({FOCAL: focal, F_NUMBER: aperture})[0].lens)
        names.add(facts({FOCAL: focal, SPECIFICATION: (focal, focal, aperture, aperture)})[0].lens)
    assert len(names) == 3
    zoom = (IFDRational(24), IFDRational(105), IFDRational(4), IFDRational(4))
    assert (
        facts({SPECIFICATION: zoom, FOCAL: 24})[0].lens
        == facts({SPECIFICATION: zoom, FOCAL: 105})[0].lens
        == "24-105 mm f/4"
    )


@pytest.mark.parametrize(
    ("make", "model", "expected"),
    [
        ("Canon", "Canon EOS R5", "Canon EOS R5"),
        ("samsung\0\0", " SM-G991B ", "samsung SM-G991B"),
        ("NIKON CORPORATION", "NIKON Z 6", "NIKON Z 6"),
        ("", "X", "X"),
        (b"A", b"\x1b[31m", "A [31m"),
    ],
)
def test_cameras(make: object, model: object, expected: str) -> None:
    assert facts({}, main={MAKE: make, MODEL: model})[0].camera == expected


@pytest.mark.parametrize(
    "form", ['exif:FocalLengthIn35mmFilm="26"', "<exif:FocalLengthIn35mmFilm>26</exif:FocalLengthIn35mmFilm>"]
)
def test_xmp_where_exif_says_nothing(form: str) -> None:
    assert facts({}, xmp=f"<x {form}/>")[0].focal_px == pytest.approx(26 / DIAGONAL_35MM * 5040)
    assert facts({FOCAL_35: 52}, xmp=f"<x {form}/>")[0].focal_px == pytest.approx(52 / DIAGONAL_35MM * 5040)


def test_damaged_tags_say_nothing() -> None:
    data = bytearray(jpeg({FOCAL_35: 26, FOCAL: 4.2}, (40, 60), {MAKE: "A"}))
    start = data.index(b"Exif")
    length = struct.unpack(">H", data[start - 2 : start])[0]
    for shift in range(6, length - 6, 3):
        broken = bytearray(data)
        broken[start + shift : start + shift + 4] = struct.pack(">I", 0xFFFFFFF0)
        decode_picture(bytes(broken), name="x", where="x")
