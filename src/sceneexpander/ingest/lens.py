"""What a picture file says of the lens that took it: camera, lens, and the focal length in pixels.

Everything here is a hint. Files are cropped, resized, edited and forwarded, and keep what the camera wrote; some cameras write nonsense.
So each value is checked for plausibility on its own, what does not hold is left out, and a note says where a picture is not what the
camera took.

Two ways lead to a focal length in pixels, in this order of trust:

1. *35 mm equivalent* (tag A405): by CIPA DCG-001 it is defined by the diagonal of the frame, so it is a share of the diagonal of
   36 x 24 mm, whatever the aspect ratio. 0 means unknown. Some cameras leave digital zoom out of it; where the second way is open
   too, comparing both tells.
2. *Focal length and focal-plane resolution* (920A, A20E, A210): pixels per millimetre of the sensor, at the size that the camera wrote
   down (A002, A003). Digital zoom (A404; 0 means unused) comes on top.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from PIL import Image, TiffImagePlugin

from sceneexpander.artifacts.views import LensFacts
from sceneexpander.ingest.formats import DECODE_ERRORS

_MAKE, _MODEL, _IMAGE_WIDTH, _IMAGE_LENGTH = 0x010F, 0x0110, 0x0100, 0x0101
_EXIF_IFD = 0x8769
_F_NUMBER, _FOCAL_MM, _FOCAL_35MM, _ZOOM = 0x829D, 0x920A, 0xA405, 0xA404
_WIDTH, _HEIGHT = 0xA002, 0xA003
_PLANE_X, _PLANE_Y, _PLANE_UNIT = 0xA20E, 0xA20F, 0xA210
_LENS_SPECIFICATION, _LENS_MODEL = 0xA432, 0xA434
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_SENSOR_MM = (2.0, 70.0)  # widths: the smallest of a phone, and medium format
PLAUSIBLE_FOCAL = (0.2, 8.0)  # of the long side
_SAME_ASPECT = 0.01
_SAME_FOCAL = 0.1
_LONGEST_NAME = 80


@dataclass(frozen=True, slots=True, kw_only=True)
class _Tags:
    """The values that matter, checked one by one; None where absent or senseless."""

    camera: str
    lens_model: str
    lens_range: str
    focal_mm: float | None
    f_number: float | None
    focal_35mm: float | None
    zoom: float
    exif_size: tuple[int, int] | None  # (height, width), as the camera wrote it: before it was turned
    plane_per_mm: float | None


def read_lens(
    exif: Image.Exif | None, xmp: str, *, height: int, width: int, turned: bool
) -> tuple[LensFacts, list[str]]:
    """What the tags of a picture say, and notes about what does not fit.

    Args:
        exif: tags of the file; None without.
        xmp: its XMP packet as text; empty without. Used for what the EXIF tags do not say.
        height: rows of the upright picture.
        width: columns of the upright picture.
        turned: whether the file's orientation swapped the axes, so that sizes in the tags are the other way round.
    """
    tags = _tags(exif, xmp)
    notes: list[str] = []
    frame, cropped = _frame(tags.exif_size, height, width, turned=turned)
    if cropped and frame is not None:
        notes.append(f"was cropped after it was taken ({frame[1]} x {frame[0]} -> {width} x {height})")
    # The frame that the focal length belongs to, in pixels of this file.
    whole = frame if frame is not None and cropped else (height, width)
    scale = None
    if frame is not None:
        scale = 1.0 if cropped else (height / frame[0] + width / frame[1]) / 2
    focal_px, rule = _focal_px(tags, whole, scale)
    if focal_px is not None and not PLAUSIBLE_FOCAL[0] <= focal_px / max(whole) <= PLAUSIBLE_FOCAL[1]:
        notes.append(f"its focal length ({rule}) would be {focal_px / max(whole):.3g} of the long side: not believed")
        focal_px, rule = None, ""
    lens = tags.lens_model or tags.lens_range or _lens_by_numbers(tags)
    facts = LensFacts(
        camera=tags.camera, lens=lens, focal_mm=tags.focal_mm, focal_px=focal_px, focal_rule=rule, exif_size=frame
    )
    return facts, notes


def _focal_px(tags: _Tags, frame: tuple[float, float], scale: float | None) -> tuple[float | None, str]:
    """Focal length in pixels of the file and how it was found; ``scale`` is pixels of the file per pixel of the camera, if known."""
    plane = None
    if tags.focal_mm is not None and tags.plane_per_mm is not None and scale is not None:
        plane = tags.focal_mm * tags.plane_per_mm * scale
    if tags.focal_35mm is not None:
        focal = tags.focal_35mm / _DIAGONAL_35MM * math.hypot(*frame)
        # The plane's resolution knows no zoom: if both agree without it, the equivalent does not know it either.
        if plane is not None and tags.zoom > 1 + _SAME_FOCAL and abs(math.log(focal / plane)) < _SAME_FOCAL:
            return focal * tags.zoom, f"35 mm equivalent, digital zoom {tags.zoom:g}"
        return focal, "35 mm equivalent"
    if plane is not None:
        zoomed = f", digital zoom {tags.zoom:g}" if tags.zoom != 1 else ""
        return plane * tags.zoom, f"focal length and resolution of the sensor{zoomed}"
    return None, ""


def _frame(
    written: tuple[int, int] | None, height: int, width: int, *, turned: bool
) -> tuple[tuple[int, int] | None, bool]:
    """The camera's (height, width), upright, and whether the file shows only a part of it."""
    if written is None:
        return None, False
    frame = (written[1], written[0]) if turned else written
    if _same_aspect(frame, (height, width)):
        return frame, False
    other = (frame[1], frame[0])
    # Software that turns the pixels often leaves the written size as it was. A side kept to the pixel says that this was a crop.
    if _same_aspect(other, (height, width)) and not (frame[0] == height or frame[1] == width):
        return other, False
    # No part of a picture is larger than the whole: then what is written is not the size of this one.
    inside = height <= frame[0] * (1 + _SAME_ASPECT) and width <= frame[1] * (1 + _SAME_ASPECT)
    return (frame, True) if inside else (None, False)


def _same_aspect(a: tuple[int, int], b: tuple[int, int]) -> bool:
    ratio = (a[0] / a[1]) / (b[0] / b[1])
    # Resizing rounds both sides to whole pixels.
    return abs(math.log(ratio)) <= _SAME_ASPECT + 1.0 / min(*a, *b)


def _tags(exif: Image.Exif | None, xmp: str) -> _Tags:
    main: Mapping[int, object] = {} if exif is None else exif
    details = _sub_directory(exif)

    def either(tag: int, xmp_name: str) -> float | None:
        found = number(details.get(tag, main.get(tag)))
        return number(_xmp_value(xmp, xmp_name)) if found is None else found

    make = _words(main.get(_MAKE)) or _words(_xmp_value(xmp, "tiff:Make"))
    model = _words(main.get(_MODEL)) or _words(_xmp_value(xmp, "tiff:Model"))
    # Many makers repeat their name in the model's.
    camera = model if make and model.casefold().startswith(make.split()[0].casefold()) else f"{make} {model}".strip()
    size = tuple(number(details.get(tag)) for tag in (_HEIGHT, _WIDTH))
    if None in size:
        size = tuple(number(main.get(tag)) for tag in (_IMAGE_LENGTH, _IMAGE_WIDTH))
    exif_size = None
    if size[0] is not None and size[1] is not None and min(size) >= 1 and max(size) <= 1e6:  # type: ignore[type-var, operator]
        exif_size = (int(size[0]), int(size[1]))
    zoom = either(_ZOOM, "exif:DigitalZoomRatio")
    return _Tags(
        camera=camera,
        lens_model=_words(details.get(_LENS_MODEL)) or _words(_xmp_value(xmp, "aux:Lens")),
        lens_range=_lens_range(details.get(_LENS_SPECIFICATION)),
        focal_mm=_within(either(_FOCAL_MM, "exif:FocalLength"), 0.5, 3000),
        f_number=_within(either(_F_NUMBER, "exif:FNumber"), 0.5, 100),
        focal_35mm=_within(either(_FOCAL_35MM, "exif:FocalLengthIn35mmFilm"), 1, 10_000),
        zoom=_within(zoom, 1, 200) or 1.0,
        exif_size=exif_size,
        plane_per_mm=_plane_per_mm(details, exif_size),
    )


def _sub_directory(exif: Image.Exif | None) -> Mapping[int, object]:
    if exif is None:
        return {}
    try:
        return exif.get_ifd(_EXIF_IFD)
    except DECODE_ERRORS:
        return {}  # damaged tags say nothing about the pixels


def _plane_per_mm(details: Mapping[int, object], exif_size: tuple[int, int] | None) -> float | None:
    unit = number(details.get(_PLANE_UNIT, 2))
    unit_mm = _UNIT_MM.get(int(unit)) if unit is not None else None
    resolution = number(details.get(_PLANE_X)) or number(details.get(_PLANE_Y))
    if unit_mm is None or resolution is None or resolution <= 0 or exif_size is None:
        return None
    per_mm = resolution / unit_mm
    return per_mm if _SENSOR_MM[0] <= max(exif_size) / per_mm <= _SENSOR_MM[1] else None


def number(value: object) -> float | None:
    """A tag as a finite number that is not negative; None for anything else. Takes what writers of tags make of numbers: one-element
    tuples, pairs of numerator and denominator, texts such as ``"26 mm"`` and ``"420/100"``."""
    if isinstance(value, bytes):
        value = value.decode("latin-1")
    if isinstance(value, str):
        found = re.match(r"\s*([0-9]{1,9}(?:[.,][0-9]{1,9})?)\s*(?:/\s*([0-9]{1,9}(?:\.[0-9]{1,9})?))?", value)
        if found is None:
            return None
        value = (float(found[1].replace(",", ".")), float(found[2] or 1))
    if isinstance(value, tuple):
        if len(value) == 1:
            return number(value[0])
        if len(value) != 2:
            return None
        top, bottom = number(value[0]), number(value[1])
        return top / bottom if top is not None and bottom else None
    if isinstance(value, bool) or not isinstance(value, (int, float, TiffImagePlugin.IFDRational)):
        return None
    try:
        result = float(value)
    except (ArithmeticError, ValueError):
        return None
    return result if math.isfinite(result) and result >= 0 else None


def _within(value: float | None, low: float, high: float) -> float | None:
    return value if value is not None and low <= value <= high else None


def _words(value: object) -> str:
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    if not isinstance(value, str):
        return ""
    plain = "".join(letter if letter.isprintable() else " " for letter in value.partition("\0")[0])
    return " ".join(plain.split())[:_LONGEST_NAME]


def _lens_range(value: object) -> str:
    """A lens specification (shortest and longest focal length, their smallest f-numbers) in words."""
    if not isinstance(value, tuple) or len(value) != 4:
        return ""
    shortest, longest, *apertures = (number(item) for item in value)
    if not shortest or not longest:
        return ""
    name = f"{shortest:g} mm" if shortest == longest else f"{shortest:g}-{longest:g} mm"
    known = sorted({f"{item:g}" for item in apertures if item}, key=float)
    return f"{name} f/{'-'.join(known)}" if known else name


def _lens_by_numbers(tags: _Tags) -> str:
    """A phone's lenses have one focal length and one aperture each: these tell them apart where no name does."""
    if tags.focal_mm is None:
        return ""
    return f"{tags.focal_mm:g} mm" + (f" f/{tags.f_number:g}" if tags.f_number is not None else "")


def _xmp_value(xmp: str, name: str) -> str | None:
    """The value of a simple property, written as an attribute or as an element."""
    if not xmp:
        return None
    found = re.search(rf"{name}\s*=\s*[\"']([^\"'<>]{{1,200}})[\"']|<{name}>([^<]{{1,200}})</{name}>", xmp)
    return None if found is None else found[1] or found[2]
