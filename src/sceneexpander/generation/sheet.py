"""The contact sheet: the views so far and all candidates on one picture, to choose by eye."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from sceneexpander.artifacts.views import ViewSet, to_uint8
from sceneexpander.errors import printable
from sceneexpander.ingest.load import image_tensor
from sceneexpander.ingest.samples import Pixels

_TILE_WIDTH = 256
_MARGIN = 8
_CAPTION = 20
_COLUMNS = 4
_BACKGROUND, _INK, _CHOSEN = (24, 24, 26), (225, 225, 225), (90, 200, 120)


def contact_sheet(
    references: ViewSet, candidates: Sequence[tuple[str, Pixels | None]], *, chosen: int
) -> Float[Tensor, "3 height width"]:
    """Reference views first, then (caption, picture in the stored frame or None) of each candidate; the chosen one has a border."""
    height = round(_TILE_WIDTH * references.height / references.width)
    tiles = [
        _tile(to_uint8(image), height, f"view {record.name}", border=None)
        for record, image in zip(references.records, references.images, strict=True)
    ]
    tiles += _blank(len(tiles), height)
    for index, (caption, pixels) in enumerate(candidates):
        mark = _CHOSEN if index == chosen else None
        tiles.append(_tile(pixels, height, f"candidate {index}: {caption}", border=mark))
    tiles += _blank(len(tiles), height)
    rows = [np.concatenate(tiles[i : i + _COLUMNS], axis=1) for i in range(0, len(tiles), _COLUMNS)]
    return image_tensor(np.concatenate(rows, axis=0))


def _blank(filled: int, height: int) -> list[Pixels]:
    return [_tile(None, height, "", border=None)] * (-filled % _COLUMNS)


def _tile(pixels: Pixels | None, height: int, caption: str, *, border: tuple[int, int, int] | None) -> Pixels:
    canvas = Image.new("RGB", (_TILE_WIDTH + 2 * _MARGIN, height + 2 * _MARGIN + _CAPTION), _BACKGROUND)
    draw = ImageDraw.Draw(canvas)
    if border is not None:
        draw.rectangle((_MARGIN - 4, _MARGIN - 4, _MARGIN + _TILE_WIDTH + 3, _MARGIN + height + 3), fill=border)
    if pixels is not None:
        picture = Image.fromarray(pixels).resize((_TILE_WIDTH, height), Image.Resampling.LANCZOS)
        canvas.paste(picture, (_MARGIN, _MARGIN))
    caption = printable(caption)  # a name may hold a line break, which a caption has no room for
    font = ImageFont.load_default(size=13)
    while caption and draw.textlength(caption, font=font) > _TILE_WIDTH:
        caption = caption[:-2].rstrip("…") + "…" if len(caption) > 2 else ""
    draw.text((_MARGIN, _MARGIN + height + 5), caption, fill=_INK, font=font)
    return np.array(canvas, dtype=np.uint8)
