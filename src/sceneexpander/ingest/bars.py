"""What at the border of a picture is not the place: bars of one colour, and strips that are the same in all photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sceneexpander.ingest.samples import Mask, Pixels

_SAME_COLOUR = 10  # grey levels: what compression does to a plain bar
_OTHER_COLOUR = 20
_SAMPLES = 1024  # pixels looked at along a line
_LEAST_BAR = 0.01  # of the side
_LARGEST_BAR = 0.45
_RINGING = 16  # lines of a bar that compression may have disturbed beside its end: a block of JPEG with halved colours
_DISTURBED_SHARE = 0.5  # of their pixels, but none as much as a letter on the bar would
_LETTER = 60
_SHARP_WITHIN = 4  # lines: the blur of resizing
_ONE_SIDED, _TWO_SIDED = 0.6, 0.2  # share of the pixels beside a bar that have another colour
_WHITE = 245  # a bar on one side only may be an overexposed sky
_MARGIN = 2
_SAME_STRIP = 0.9  # of the pixels of a line
_OTHER_STRIP = 0.5
_EDGE = 0.35  # of the pixels of a line that change where a strip ends
_LARGEST_STRIP = 0.4
_LEAST_STRIP = 0.015
_SIDES = ("top", "bottom", "left", "right")


@dataclass(frozen=True, slots=True)
class Bars:
    """Lines at each border that show nothing."""

    top: int = 0
    bottom: int = 0
    left: int = 0
    right: int = 0

    def __bool__(self) -> bool:
        return any((self.top, self.bottom, self.left, self.right))

    def mask(self, height: int, width: int) -> Mask:
        """True between the bars."""
        inside = np.zeros((height, width), dtype=np.bool_)
        inside[self.top : height - self.bottom, self.left : width - self.right] = True
        return inside

    def words(self, height: int, width: int) -> str:
        """Where they are, for people: "top 12 %, bottom 12 %"."""
        sizes = zip(_SIDES, (self.top, self.bottom, self.left, self.right), (height, height, width, width), strict=True)
        return ", ".join(f"{side} {lines / size:.0%}" for side, lines, size in sizes if lines)


def find_bars(pixels: Pixels) -> Bars:
    """Bars of one colour at the borders of a picture, as players and presentations add them to pictures of another shape.

    A bar ends at a straight line, behind which most of the picture has another colour: so a dark or overexposed part of the place is none.
    Bars on both sides of equal size may end less sharply; a picture that is dark altogether has none.
    """
    top, bottom = _pair(pixels)
    between = pixels[top : pixels.shape[0] - bottom]
    left, right = _pair(between.swapaxes(0, 1))
    return Bars(top, bottom, left, right)


def _pair(lines: npt.NDArray[np.uint8]) -> tuple[int, int]:
    """Bars at the first and at the last of the lines (line, pixel, 3)."""
    step = max(1, lines.shape[1] // _SAMPLES)
    forwards, backwards = lines[:, ::step], lines[::-1, ::step]
    first, first_edge, first_colour = _run(forwards)
    last, last_edge, last_colour = _run(backwards)
    unequal = abs(first - last) > _MARGIN + 0.02 * max(first, last)
    if first and last and not unequal and np.abs(first_colour - last_colour).max() <= _SAME_COLOUR:
        if min(first_edge, last_edge) >= _TWO_SIDED:
            return first + _MARGIN, last + _MARGIN
        return 0, 0
    sides = ((first, first_edge, first_colour), (last, last_edge, last_colour))
    kept = [
        run + _MARGIN if run and edge >= _ONE_SIDED and float(colour.min()) < _WHITE else 0
        for run, edge, colour in sides
    ]
    return kept[0], kept[1]


def _run(lines: npt.NDArray[np.uint8]) -> tuple[int, float, npt.NDArray[np.float32]]:
    """How many lines have the colour of the first one (0: no bar), the share of other colours behind them, and the colour."""
    colour = np.median(lines[0], axis=0).astype(np.float32)
    most = int(len(lines) * _LARGEST_BAR) + 1
    run = 0
    while run < most and _share_of_others(lines[run], colour, _SAME_COLOUR) <= 0.005:
        run += 1
    if run >= most or run < max(4, len(lines) * _LEAST_BAR):
        return 0, 0.0, colour
    for _ in range(_RINGING):
        disturbed, lettered = (_share_of_others(lines[run], colour, level) for level in (_SAME_COLOUR, _LETTER))
        if disturbed > _DISTURBED_SHARE or lettered > 0.005:
            break
        run += 1
    behind = lines[run : run + _SHARP_WITHIN]
    return run, max(_share_of_others(line, colour, _OTHER_COLOUR) for line in behind), colour


def _share_of_others(line: npt.NDArray[np.uint8], colour: npt.NDArray[np.float32], tolerance: int) -> float:
    return float((np.abs(line.astype(np.float32) - colour).max(axis=1) > tolerance).mean())


def find_overlay(images: Sequence[Pixels], valid: Mask) -> Bars:
    """Strips at the borders that are the same in all of several pictures of one size: bars of a screen, scales, data of a camera.

    Things of the place move from photo to photo. What lies still and ends at one straight line, behind which most of the pictures does
    differ, was laid over them.

    Args:
        images: (H, W, 3) each, as many as there are photos.
        valid: (H, W) what is known to show something in at least one of them.
    """
    if len(images) < 2:
        return Bars()
    stack = np.stack(list(images)).astype(np.int16)
    spread = (stack.max(axis=0) - stack.min(axis=0)).max(axis=2)
    same = np.asarray(spread <= 2 * _SAME_COLOUR)
    rows, columns = same.mean(axis=1), same.mean(axis=0)
    upright = stack.swapaxes(1, 2)
    sides = ((rows, stack), (rows[::-1], stack[:, ::-1]), (columns, upright), (columns[::-1], upright[:, ::-1]))
    lines = [_strip(shares, pictures) for shares, pictures in sides]
    height, width = same.shape
    # What is known to be a bar already needs no second name.
    empty_rows, empty_columns = np.asarray(~valid.any(axis=1)), np.asarray(~valid.any(axis=0))
    known = [empty_rows, empty_rows[::-1], empty_columns, empty_columns[::-1]]
    news = [
        count if count and not bool(names[: max(count - _MARGIN, 1)].all()) else 0
        for count, names in zip(lines, known, strict=True)
    ]
    if news[0] + news[1] >= height or news[2] + news[3] >= width:
        return Bars()
    return Bars(*news)


def _strip(shares: npt.NDArray[np.float64], pictures: npt.NDArray[np.int16]) -> int:
    """Lines from the start that are the same in all pictures (picture, line, pixel, 3), if an end follows that is sharp in each of them."""
    most = int(len(shares) * _LARGEST_STRIP) + 1
    run = 0
    while run < most and shares[run] >= _SAME_STRIP:
        run += 1
    if run >= most or run < max(2, len(shares) * _LEAST_STRIP):
        return 0
    if float(shares[run : run + 2].min()) > _OTHER_STRIP:
        return 0
    # A sky that is white in all photos also ends, but along another line in each.
    change = np.abs(pictures[:, run + 1] - pictures[:, run - 2]).max(axis=2) > _OTHER_COLOUR
    return run + 1 if float(np.median(change.mean(axis=1))) >= _EDGE else 0
