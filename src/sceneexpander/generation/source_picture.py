"""Picture files that say how they came to be."""

from __future__ import annotations

import io

from PIL import Image
from PIL.PngImagePlugin import PngInfo

_XMP_CHUNK = "XML:com.adobe.xmp"  # where PNG keeps XMP


def png_bytes(picture: Image.Image, xmp: bytes | None = None) -> bytes:
    """An RGB picture as a PNG file, with an XMP packet."""
    facts = PngInfo()
    if xmp is not None:
        facts.add_itxt(_XMP_CHUNK, xmp.decode())
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", compress_level=3, pnginfo=facts)
    return buffer.getvalue()
