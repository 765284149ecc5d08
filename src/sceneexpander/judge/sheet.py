"""One request as a picture, for people who want to see what the judge sees."""

from __future__ import annotations

import io
import textwrap

from PIL import Image, ImageDraw, ImageFont

from sceneexpander.services.chat import ChatQuestion

_TILE_WIDTH, _MARGIN, _LINE = 256, 8, 17
_COLUMNS = 4
_CHARACTERS = 150  # of a line of text over the whole width
_BACKGROUND, _INK = (24, 24, 26), (225, 225, 225)


def request_sheet(question: ChatQuestion) -> Image.Image:
    """The instructions as text, and below them every picture with the words that stand before it, in the order of the request."""
    lines = [line for part in question.instructions.splitlines() for line in textwrap.wrap(part, _CHARACTERS) or [""]]
    tiles: list[tuple[str, Image.Image]] = []
    words = ""
    for item in question.evidence:
        if isinstance(item, str):
            words = f"{words} {item}".strip()
        else:
            picture: Image.Image = Image.open(io.BytesIO(item.png))
            height = max(1, round(_TILE_WIDTH * picture.height / picture.width))
            tiles.append((words, picture.resize((_TILE_WIDTH, height), Image.Resampling.LANCZOS)))
            words = ""
    rows = [tiles[start : start + _COLUMNS] for start in range(0, len(tiles), _COLUMNS)]
    captions = [[textwrap.wrap(words, _CHARACTERS // _COLUMNS)[:6] or [""] for words, _ in row] for row in rows]
    heights = [
        max(picture.height for _, picture in row) + _LINE * max(map(len, said)) + 2 * _MARGIN
        for row, said in zip(rows, captions, strict=True)
    ]
    width = _COLUMNS * (_TILE_WIDTH + _MARGIN) + _MARGIN
    top = _LINE * len(lines) + 2 * _MARGIN
    sheet = Image.new("RGB", (width, top + sum(heights)), _BACKGROUND)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=13)
    for number, line in enumerate(lines):
        draw.text((_MARGIN, _MARGIN + _LINE * number), line, fill=_INK, font=font)
    for row, said, height in zip(rows, captions, heights, strict=True):
        for column, ((_, picture), caption) in enumerate(zip(row, said, strict=True)):
            left = _MARGIN + column * (_TILE_WIDTH + _MARGIN)
            for number, line in enumerate(caption):
                draw.text((left, top + _LINE * number), line, fill=_INK, font=font)
            sheet.paste(picture, (left, top + _LINE * max(map(len, said)) + 4))
        top += height
    return sheet
