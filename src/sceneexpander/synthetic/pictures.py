"""Picture-like textures that are stretched once over a face: posters, books, windows, doors, rugs, facades (RGB weights)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Map = NDArray[Any]  # float32
SIZE = 256


def _colour(rng: np.random.Generator, low: float = 0.1, high: float = 0.95) -> tuple[float, float, float]:
    r, g, b = rng.uniform(low, high, 3)
    return float(r), float(g), float(b)


def _muted(rng: np.random.Generator, low: float = 0.1, high: float = 0.95) -> tuple[float, float, float]:
    """A colour of low saturation: paint, wood, stone."""
    grey = rng.uniform(low, high)
    r, g, b = np.clip(grey * (1 + rng.uniform(-0.22, 0.22, 3) + [0.06, 0.0, -0.08]), 0, 1)
    return float(r), float(g), float(b)


def _canvas(rng: np.random.Generator, colour: tuple[float, float, float]) -> Map:
    image = np.empty((SIZE, SIZE, 3), dtype=np.float32)
    image[:] = colour
    return image + 0.02 * (rng.random((SIZE, SIZE, 1), dtype=np.float32) - 0.5)


def _frame(image: Map, width: int, colour: tuple[float, float, float]) -> Map:
    cv2.rectangle(image, (0, 0), (SIZE - 1, SIZE - 1), colour, 2 * width)
    return image


def _gradient(rng: np.random.Generator) -> Map:
    ramp = np.linspace(0, 1, SIZE, dtype=np.float32)[:, None, None]
    first, second = np.array(_colour(rng), np.float32), np.array(_colour(rng), np.float32)
    return np.ascontiguousarray(np.broadcast_to(first * (1 - ramp) + second * ramp, (SIZE, SIZE, 3)))


def _picture(rng: np.random.Generator) -> Map:
    image = _gradient(rng)
    for _ in range(int(rng.integers(8, 24))):
        x, y = (int(v) for v in rng.integers(0, SIZE, 2))
        size = int(rng.integers(8, 80))
        colour = _colour(rng)
        if rng.random() < 0.5:
            axes = (size, max(4, int(size * rng.uniform(0.3, 1))))
            cv2.ellipse(image, (x, y), axes, float(rng.uniform(0, 180)), 0, 360, colour, -1, cv2.LINE_AA)
        else:
            points = rng.integers(-size, size, (int(rng.integers(3, 6)), 2)) + [x, y]
            cv2.fillPoly(image, [points.astype(np.int32)], colour, cv2.LINE_AA)
    return _frame(image, int(rng.integers(4, 16)), _colour(rng, 0.05, 0.5))


def _poster(rng: np.random.Generator) -> Map:
    image = _canvas(rng, _colour(rng, 0.6, 1.0))
    ink = _colour(rng, 0.0, 0.35)
    y = int(rng.integers(10, 30))
    while y < SIZE - 16:
        tall = int(rng.integers(4, 20))
        x = 14
        while x < SIZE - 24:
            wide = int(rng.integers(4, 10)) * max(tall // 8, 1)
            for _ in range(int(rng.integers(1, 4))):
                ends = rng.integers(0, [max(wide, 2), tall], (2, 2)) + [x, y]
                cv2.line(image, ends[0].tolist(), ends[1].tolist(), ink, max(1, tall // 6), cv2.LINE_AA)
            x += wide + 4 + 10 * int(rng.random() < 0.2)
        y += tall + 6
        if rng.random() < 0.15 and y < SIZE - 80:
            low = (int(rng.integers(14, 100)), y)
            cv2.rectangle(image, low, (int(rng.integers(150, 240)), y + 50), _colour(rng), -1)
            y += 58
    return image


def _books(rng: np.random.Generator) -> Map:
    image = _canvas(rng, (0.08, 0.06, 0.05))
    rows = int(rng.integers(1, 4))
    for row in range(rows):
        x, floor = 2, int((row + 1) * SIZE / rows) - 3
        while x < SIZE - 6:
            wide, tall = int(rng.integers(6, 20)), int(SIZE / rows * rng.uniform(0.6, 0.92))
            colour = _colour(rng, 0.05, 0.9)
            cv2.rectangle(image, (x, floor - tall), (x + wide - 2, floor), colour, -1)
            band = floor - int(tall * rng.uniform(0.2, 0.8))
            cv2.rectangle(image, (x, band), (x + wide - 2, band + int(rng.integers(2, 12))), _colour(rng), -1)
            x += wide + (int(rng.integers(4, 20)) if rng.random() < 0.08 else 0)
    return image


def _panes(image: Map, rng: np.random.Generator, frame: tuple[float, float, float], columns: int, rows: int) -> Map:
    for column in range(1, columns):
        x = round(column * SIZE / columns)
        cv2.line(image, (x, 0), (x, SIZE), frame, int(rng.integers(5, 10)))
    for row in range(1, rows):
        y = round(row * SIZE / rows)
        cv2.line(image, (0, y), (SIZE, y), frame, int(rng.integers(5, 10)))
    return _frame(image, int(rng.integers(8, 14)), frame)


def _window(rng: np.random.Generator) -> Map:
    ramp = np.linspace(0, 1, SIZE, dtype=np.float32)[:, None]
    base = np.array([0.16, 0.2, 0.25], np.float32) * float(rng.uniform(0.6, 1.6))
    image = np.broadcast_to(base * (1.5 - ramp)[..., None], (SIZE, SIZE, 3)).copy()
    if rng.random() < 0.6:  # curtains behind the glass
        side = int(rng.integers(30, 80))
        folds = 0.5 + 0.2 * np.sin(np.arange(SIZE) * rng.uniform(0.3, 0.6)).astype(np.float32)
        cloth = np.array(_muted(rng, 0.5, 0.9), np.float32) * folds[None, :, None]
        image[:, :side] = cloth[:, :side]
        image[:, -side:] = cloth[:, -side:]
    shine = np.array([[40, 256], [110, 256], [230, 0], [160, 0]], np.int32)
    bright = image.copy()
    cv2.fillPoly(bright, [shine], (0.55, 0.62, 0.7), cv2.LINE_AA)
    return _panes(
        0.8 * image + 0.2 * bright, rng, _muted(rng, 0.3, 0.95), int(rng.integers(1, 4)), int(rng.integers(1, 5))
    )


def _daylight(rng: np.random.Generator) -> Map:
    """A window seen from inside: sky, a horizon of trees and houses, a frame."""
    ramp = np.linspace(0, 1, SIZE, dtype=np.float32)[:, None, None]
    image = np.array([0.65, 0.8, 1.0], np.float32) * (1 - 0.3 * ramp) + 0.3 * ramp
    image = np.ascontiguousarray(np.broadcast_to(image, (SIZE, SIZE, 3)))
    line = int(rng.integers(110, 190))
    for _ in range(40):
        centre = (int(rng.integers(0, SIZE)), line + int(rng.integers(-15, 70)))
        green = float(rng.uniform(0.25, 0.55))
        cv2.circle(image, centre, int(rng.integers(10, 34)), (green * 0.7, green, green * 0.4), -1, cv2.LINE_AA)
    return _panes(image, rng, _muted(rng, 0.6, 0.95), int(rng.integers(1, 4)), int(rng.integers(1, 4)))


def _door(rng: np.random.Generator) -> Map:
    base = np.array(_muted(rng, 0.25, 0.9), np.float32)
    image = _canvas(rng, (float(base[0]), float(base[1]), float(base[2])))
    image *= 0.9 + 0.1 * np.repeat(rng.random((1, SIZE, 1), dtype=np.float32), SIZE, 0)
    columns, rows = int(rng.integers(1, 3)), int(rng.integers(1, 4))
    for column in range(columns):
        for row in range(rows):
            x0, y0 = int((column + 0.15) * SIZE / columns), int((row + 0.12) * SIZE / rows)
            x1, y1 = int((column + 0.85) * SIZE / columns), int((row + 0.88) * SIZE / rows)
            cv2.rectangle(image, (x0, y0), (x1, y1), (base * 0.55).tolist(), 5)
            cv2.rectangle(image, (x0 + 5, y0 + 5), (x1 - 5, y1 - 5), (np.minimum(base * 1.15, 1)).tolist(), -1)
    cv2.circle(image, (int(rng.choice([24, 232])), 135), 8, (0.85, 0.7, 0.3), -1, cv2.LINE_AA)
    return _frame(image, 5, (base * 0.5).tolist())


def _rug(rng: np.random.Generator) -> Map:
    image = _canvas(rng, _muted(rng, 0.2, 0.8))
    inset = 0
    for _ in range(int(rng.integers(3, 7))):
        colour, style = _muted(rng), rng.random()
        low, high = (inset, inset), (SIZE - 1 - inset, SIZE - 1 - inset)
        cv2.rectangle(image, low, high, colour, -1)
        if style < 0.5:
            for step in range(inset + 6, SIZE - inset - 6, 14):
                for point in ((step, inset + 6), (step, SIZE - inset - 7), (inset + 6, step), (SIZE - inset - 7, step)):
                    cv2.circle(image, point, 4, _colour(rng, 0.3, 0.7), -1, cv2.LINE_AA)
        inset += int(rng.integers(12, 26))
    cv2.ellipse(image, (128, 128), (40, 30), 0, 0, 360, _colour(rng), -1, cv2.LINE_AA)
    return image * (0.9 + 0.1 * rng.random((SIZE, SIZE, 1), dtype=np.float32))


def _crate(rng: np.random.Generator) -> Map:
    boards = int(rng.integers(4, 7))
    tone = 0.65 + 0.25 * rng.random(boards, dtype=np.float32)
    image = np.repeat(tone[(np.arange(SIZE) * boards) // SIZE][:, None], SIZE, 1)[..., None] * np.array(
        [1, 0.82, 0.6], np.float32
    )
    image = image * (0.88 + 0.12 * np.repeat(rng.random((SIZE, 16, 1), dtype=np.float32), 16, 1))
    for board in range(1, boards):
        y = board * SIZE // boards
        cv2.line(image, (0, y), (SIZE, y), (0.2, 0.14, 0.08), 3)
    if rng.random() < 0.6:
        cv2.line(image, (0, 0), (SIZE, SIZE), (0.6, 0.48, 0.33), 22, cv2.LINE_AA)
    return np.clip(_frame(np.ascontiguousarray(image), 14, (0.55, 0.44, 0.3)), 0, 1)


def _facade(rng: np.random.Generator) -> Map:
    wall = np.array(_muted(rng, 0.45, 0.9), np.float32)
    image = _canvas(rng, (float(wall[0]), float(wall[1]), float(wall[2])))
    columns, rows = int(rng.integers(2, 5)), int(rng.integers(2, 5))
    trim, glass = _muted(rng, 0.6, 1.0), _colour(rng, 0.1, 0.35)
    wide, tall = SIZE / columns * rng.uniform(0.35, 0.6), SIZE / rows * rng.uniform(0.45, 0.7)
    for column in range(columns):
        for row in range(rows):
            cx, cy = (column + 0.5) * SIZE / columns, (row + 0.5) * SIZE / rows
            low, high = (int(cx - wide / 2), int(cy - tall / 2)), (int(cx + wide / 2), int(cy + tall / 2))
            shade = float(rng.uniform(0.7, 1.3))
            cv2.rectangle(image, low, high, tuple(shade * g for g in glass), -1)
            cv2.rectangle(image, low, high, trim, 3)
            cv2.line(image, (int(cx), low[1]), (int(cx), high[1]), trim, 2)
            cv2.line(image, (low[0] - 3, high[1] + 3), (high[0] + 3, high[1] + 3), (wall * 0.6).tolist(), 3)
    for row in range(rows):
        y = int((row + 1) * SIZE / rows) - 2
        cv2.line(image, (0, y), (SIZE, y), (wall * 0.8).tolist(), 3)
    return image


PICTURE_FAMILIES: dict[str, Callable[[np.random.Generator], Map]] = {
    "picture": _picture,
    "poster": _poster,
    "books": _books,
    "window": _window,
    "daylight": _daylight,
    "door": _door,
    "rug": _rug,
    "crate": _crate,
    "facade": _facade,
}
