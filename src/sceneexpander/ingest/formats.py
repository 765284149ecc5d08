"""What a file is: by its first bytes where these tell, by its name where they do not."""

from __future__ import annotations

import importlib.util
import struct
import zlib
from pathlib import Path

from PIL import Image, features

# What Pillow raises for damaged files depends on the format and on where the damage is.
DECODE_ERRORS = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    LookupError,
    TypeError,
    RuntimeError,
    AttributeError,
    ArithmeticError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
)


def _words(*lines: str) -> list[str]:
    return " ".join(lines).split()


PICTURE_EXTENSIONS = frozenset(
    _words(
        "jpg jpeg jpe jfif jif mpo png webp bmp dib tif tiff gif avif jp2 j2k j2c jpc jpx jpf heic",
        "heif hif jxl ppm pgm pnm",
    )
)
_VIDEO = frozenset(_words("mov mp4 m4v avi mkv webm mts m2ts 3gp 3g2 mpg mpeg wmv flv insv lrv ogv"))
_RAW = frozenset(
    _words(
        "dng cr2 cr3 crw nef nrw arw srf sr2 orf raf rw2 rwl pef ptx srw raw 3fr fff iiq erf mef", "mos kdc dcr x3f gpr"
    )
)
_OTHER = {
    "psd": "a Photoshop file",
    "psb": "a Photoshop file",
    "xcf": "a GIMP file",
    "svg": "a vector graphic",
    "exr": "a high-dynamic-range picture",
    "hdr": "a high-dynamic-range picture",
    "insp": "a panorama of a 360° camera",
    "zip": "an archive",
    "rar": "an archive",
    "7z": "an archive",
    "tar": "an archive",
    "pdf": "a PDF document",
}
_HEIF_BRANDS = {b"heic", b"heix", b"hevc", b"heim", b"heis", b"hevm", b"hevs", b"mif1", b"msf1"}
_AVIF_BRANDS = {b"avif", b"avis"}
_VIDEO_BRANDS = {
    b"qt  ",
    b"isom",
    b"iso2",
    b"iso4",
    b"iso5",
    b"iso6",
    b"mp41",
    b"mp42",
    b"M4V ",
    b"avc1",
    b"3gp4",
    b"3gp5",
}
# What is missing where Pillow alone does not read a format, and the package that adds it.
_PLUGINS = {"HEIF": ("pillow_heif", "pillow-heif"), "JPEG XL": ("pillow_jxl", "pillow-jxl-plugin")}
_FEATURES = {"AVIF": "avif", "JPEG2000": "jpg_2000", "WEBP": "webp"}
# Pillow's names of what may come out where one of ours was found.
PILLOW_FORMATS = {"JPEG": ["JPEG", "MPO"], "JPEG XL": ["JXL"]}


_HEAD_BYTES = 64


def read_head(path: Path) -> bytes:
    """The first bytes of a file, which the functions here look at; none if it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(_HEAD_BYTES)
    except (OSError, ValueError):
        return b""


def kind_of_file(extension: str) -> str:
    """What to call a file that is left out because of its extension; empty where that says nothing."""
    if extension in _VIDEO:
        return "a video"
    return "a raw picture" if extension in _RAW else _OTHER.get(extension, "")


def sniff_format(head: bytes) -> str | None:
    """The picture format that the first bytes announce (Pillow's name; ``HEIF``, ``JPEG XL``), or None."""
    if head.startswith(b"\xff\xd8\xff"):
        return "JPEG"
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        return "PNG"
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return "WEBP"
    if head[:6] in (b"GIF87a", b"GIF89a"):
        return "GIF"
    # Raw pictures of Canon are TIFF files with a mark of their own.
    if head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+") and head[8:10] != b"CR":
        return "TIFF"
    if head[4:8] == b"ftyp":
        # The major brand comes first; "mif1" and "msf1" only say "some picture", the compatible brands say which.
        if head[8:12] in _AVIF_BRANDS or (head[8:12] in (b"mif1", b"msf1") and b"avif" in head[16:]):
            return "AVIF"
        return "HEIF" if head[8:12] in _HEIF_BRANDS else None
    if head.startswith((b"\0\0\0\x0cjP  \r\n\x87\n", b"\xff\x4f\xff\x51")):
        return "JPEG2000"
    if head.startswith((b"\0\0\0\x0cJXL \r\n\x87\n", b"\xff\x0a")):
        return "JPEG XL"
    # "BM" is two letters only: the reserved words and the header length must fit as well.
    if head[:2] == b"BM" and len(head) >= 18 and head[6:10] == bytes(4) and head[15:18] == bytes(3):
        return "BMP"
    if len(head) >= 3 and head[:1] == b"P" and head[1:2] in b"123456" and head[2:3].isspace():
        return "PPM"
    return None


def name_of_content(head: bytes) -> str | None:
    """What a file that is no picture seems to be, in words, or None."""
    text = head.lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    if head[4:8] == b"ftyp" and head[8:12] in _VIDEO_BRANDS:
        return "a video"
    if head[:4] == b"RIFF" and head[8:12] == b"AVI ":
        return "a video"
    if head.startswith(b"\x1a\x45\xdf\xa3"):
        return "a video"
    if head[8:10] == b"CR" and head[:2] == b"II":
        return "a raw picture of a camera"
    if head.startswith((b"FUJIFILMCCD-RAW", b"IIU\0", b"IIRO")) or head[4:12] == b"ftypcrx ":
        return "a raw picture of a camera"
    if text.startswith((b"<!doctype html", b"<html")):
        return "a web page"
    if text.startswith(b"<svg") or (text.startswith(b"<?xml") and b"svg" in text):
        return "a vector graphic (SVG)"
    if text.startswith((b"{", b"[")):
        return "text (JSON)"
    known = {
        b"8BPS": "a Photoshop file",
        b"%PDF": "a PDF document",
        b"PK\x03\x04": "a ZIP archive",
        b"v/1\x01": "an OpenEXR picture",
        b"#?RA": "a Radiance HDR picture",
        b"\0\0\x01\0": "a Windows icon",
        b"qoif": "a QOI picture",
        b"\xabKTX": "a KTX texture",
        b"DDS ": "a DDS texture",
        b"PK\x05\x06": "an empty ZIP archive",
        b"\x1f\x8b": "a gzip archive",
        b"7z\xbc\xaf\x27\x1c": "a 7z archive",
        b"Rar!\x1a\x07": "a RAR archive",
        b"\xfd7zXZ\0": "an xz archive",
        b"BZh": "a bzip2 archive",
    }
    return next((words for start, words in known.items() if head.startswith(start)), None)


def missing_decoder(file_format: str) -> str | None:
    """What to do about a format that cannot be decoded here; None if it can."""
    if file_format in _PLUGINS:
        module, package = _PLUGINS[file_format]
        if importlib.util.find_spec(module) is None:
            return f"install the Python package {package} (pip install {package}), or convert the picture to JPEG"
        if file_format == "HEIF":
            import pillow_heif

            pillow_heif.register_heif_opener()
        else:
            import pillow_jxl  # noqa: F401 - registers itself
        return None
    needed = _FEATURES.get(file_format)
    if needed is not None and not features.check(needed):
        return "install Pillow with support for it, or convert the picture to JPEG"
    return None
