"""Procedural textures: tileable 3-channel weight maps from seeded noise, with box-filtered mip pyramids.

A texture is a (256, 256, 3) map of weights in [0, 1]; a material turns weights into colour by a matrix (see `world.Material`).
Pattern families use the channels as "how much of colour 1, 2, 3"; picture-like families (posters, books, rugs) are RGB.
Nothing here comes from a photograph. Splits: training and test use disjoint variants of every family, and the families in
`TEST_FAMILIES` never occur in training.
"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneexpander.synthetic.pictures import PICTURE_FAMILIES

Map = NDArray[Any]  # float32
Split = Literal["train", "test"]

SIZE = 256
LEVELS = 9  # 256 ... 1
#: First texel of every level in a packed pyramid.
LEVEL_START = np.cumsum([0] + [(SIZE >> level) ** 2 for level in range(LEVELS)])[:LEVELS].astype(np.int64)

#: Variants of each family: training draws from the first range, tests from the second.
VARIANTS: dict[str, range] = {"train": range(20), "test": range(1000, 1006)}


class TextureKey(NamedTuple):
    """Family name and variant number; together they determine every texel."""

    family: str
    variant: int


def _noise(rng: np.random.Generator, cells: int, cells_y: int | None = None) -> Map:
    """Tileable smooth noise in [0, 1] with the given number of cells per repeat along x (and y)."""
    cells_y = cells if cells_y is None else cells_y
    grid = rng.random((cells_y, cells), dtype=np.float32)
    padded = np.pad(grid, 2, mode="wrap")
    # Sampling the padded grid at texel centres keeps the repeat seamless.
    x = ((np.arange(SIZE, dtype=np.float32) + 0.5) / SIZE * cells + 1.5)[None].repeat(SIZE, 0)
    y = ((np.arange(SIZE, dtype=np.float32) + 0.5) / SIZE * cells_y + 1.5)[:, None].repeat(SIZE, 1)
    return np.clip(cv2.remap(padded, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), 0, 1)


def _fractal(rng: np.random.Generator, cells: int, octaves: int, fall: float = 0.55) -> Map:
    """Sum of noise octaves, rescaled to [0, 1]."""
    total = np.zeros((SIZE, SIZE), dtype=np.float32)
    weight = 1.0
    for octave in range(octaves):
        total += weight * _noise(rng, min(cells << octave, SIZE))
        weight *= fall
    low, high = float(total.min()), float(total.max())
    return (total - low) / max(high - low, 1e-6)


def _grid_xy() -> tuple[Map, Map]:
    line = (np.arange(SIZE, dtype=np.float32) + 0.5) / SIZE
    x, y = np.meshgrid(line, line)
    return x, y


def _cells(rng: np.random.Generator, count: int, jitter: float = 0.8) -> tuple[Map, Map, NDArray[np.int64]]:
    """Tileable Voronoi cells of a jittered count x count grid: (nearest, second nearest distance in cells, cell id)."""
    x, y = (value * count for value in _grid_xy())
    column, row = x.astype(np.int64), y.astype(np.int64)
    shift = (rng.random((count, count, 2), dtype=np.float32) - 0.5) * jitter + 0.5
    nearest = np.full((SIZE, SIZE), 9, dtype=np.float32)
    second = nearest.copy()
    label = np.zeros((SIZE, SIZE), dtype=np.int64)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            c, r = (column + dx) % count, (row + dy) % count
            distance = np.hypot(x - (column + dx) - shift[r, c, 0], y - (row + dy) - shift[r, c, 1])
            closer = distance < nearest
            second = np.where(closer, nearest, np.minimum(second, distance))
            label = np.where(closer, r * count + c, label)
            nearest = np.where(closer, distance, nearest)
    return nearest, second, label


def _mix(shade: Map, second: Map | float = 0.0, third: Map | float = 0.0) -> Map:
    """Weights of colours 1, 2, 3: ``second`` and ``third`` are masks, ``shade`` darkens all."""
    second, third = np.broadcast_to(np.float32(second), shade.shape), np.broadcast_to(np.float32(third), shade.shape)
    first = (1 - second) * (1 - third)
    return np.stack([first * shade, second * (1 - third) * shade, third * shade], axis=-1)


def _smooth(low: float, high: float, value: Map) -> Map:
    t = np.clip((value - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def _plain(rng: np.random.Generator) -> Map:
    shade = 0.97 + 0.03 * _fractal(rng, 2, 3)
    return _mix(shade - 0.012 * rng.random((SIZE, SIZE), dtype=np.float32))


def _plaster(rng: np.random.Generator) -> Map:
    blotch, grain = _fractal(rng, 3, 4), _fractal(rng, 40, 3)
    amount = rng.uniform(0.05, 0.2)
    return _mix(1 - amount * (0.6 * blotch + 0.4 * grain), _smooth(0.55, 0.95, blotch) * rng.uniform(0.1, 0.6))


def _courses(rng: np.random.Generator, columns: int, rows: int, gap: float, offset: float) -> tuple[Map, Map, Map]:
    """Rows of blocks: (joint mask, per-block random shade, a second per-block random number)."""
    x, y = _grid_xy()
    warp = 0.006 * (_noise(rng, 12) - 0.5)
    y = (y + warp) * rows
    row = np.floor(y).astype(np.int64) % rows
    x = (x + warp) * columns + offset * row
    column = np.floor(x).astype(np.int64) % columns
    edge_x = np.minimum(x % 1, 1 - x % 1) / columns
    edge_y = np.minimum(y % 1, 1 - y % 1) / rows
    joint = 1 - _smooth(0.3 * gap, gap, np.minimum(edge_x, edge_y))
    table = rng.random((2, rows, columns), dtype=np.float32)
    return joint, table[0][row, column], table[1][row, column]


def _brick(rng: np.random.Generator) -> Map:
    joint, shade, pick = _courses(rng, int(rng.integers(3, 6)), 2 * int(rng.integers(4, 7)), 0.007, 0.5)
    grain = _fractal(rng, 24, 3)
    return _mix(0.55 + 0.3 * shade + 0.15 * grain, joint * 0.95, (pick > 0.8) * (1 - joint) * 0.8)


def _ashlar(rng: np.random.Generator) -> Map:
    joint, shade, pick = _courses(rng, int(rng.integers(2, 4)), 2 * int(rng.integers(2, 4)), 0.006, 0.5)
    grain = _fractal(rng, 10, 5)
    return _mix(0.6 + 0.2 * shade + 0.2 * grain, joint * 0.7, 0.5 * pick * _smooth(0.4, 0.9, _fractal(rng, 5, 3)))


def _tiles(rng: np.random.Generator) -> Map:
    count = int(rng.integers(3, 8))
    joint, shade, pick = _courses(rng, count, count, 0.006, 0.0)
    accent = (pick > rng.uniform(0.6, 1.0)) * (1 - joint)
    return _mix(0.82 + 0.13 * shade + 0.05 * _fractal(rng, 12, 3), joint * 0.8, accent)


def _checker(rng: np.random.Generator) -> Map:
    count = 2 * int(rng.integers(1, 4))
    x, y = _grid_xy()
    mask = ((x * count).astype(np.int64) + (y * count).astype(np.int64)) % 2
    return _mix(0.85 + 0.15 * _fractal(rng, 6, 5), mask.astype(np.float32))


def _planks(rng: np.random.Generator) -> Map:
    joint, shade, _ = _courses(rng, int(rng.integers(1, 3)), 2 * int(rng.integers(2, 5)), 0.004, 0.5)
    grain = 0.6 * _noise(rng, 6, 64) + 0.4 * _noise(rng, 12, 128)
    return _mix(0.6 + 0.25 * shade + 0.15 * grain, joint * 0.8, _smooth(0.55, 0.9, grain) * 0.5)


def _wood(rng: np.random.Generator) -> Map:
    _, y = _grid_xy()
    rings = np.sin(2 * np.pi * (int(rng.integers(5, 12)) * y + 1.5 * _noise(rng, 3, 2) + 0.3 * _noise(rng, 6, 40)))
    return _mix(0.8 + 0.1 * rings.astype(np.float32) + 0.1 * _noise(rng, 8, 100), _smooth(0.2, 1, rings) * 0.5)


def _fabric(rng: np.random.Generator) -> Map:
    x, y = _grid_xy()
    threads = int(rng.integers(32, 64))
    weave = 0.5 + 0.25 * np.sin(2 * np.pi * threads * x) * np.sin(2 * np.pi * threads * y)
    bands = (_noise(rng, int(rng.integers(4, 12)), 1) > 0.6).astype(np.float32) * (rng.random() < 0.5)
    return _mix((0.8 + 0.15 * weave + 0.05 * _fractal(rng, 30, 2)).astype(np.float32), bands)


def _stripes(rng: np.random.Generator) -> Map:
    x, _ = _grid_xy()
    count = int(rng.integers(3, 9))
    phase = (x * count) % 1
    return _mix(0.9 + 0.1 * _fractal(rng, 8, 4), _smooth(0.48, 0.5, phase), (np.abs(phase - 0.25) < 0.05) * 1.0)


def _marble(rng: np.random.Generator) -> Map:
    x, y = _grid_xy()
    turbulence = _fractal(rng, 3, 6)
    vein = np.abs(np.sin(np.pi * (int(rng.integers(1, 4)) * x + int(rng.integers(1, 4)) * y + 4 * turbulence)))
    return _mix(
        0.9 + 0.1 * turbulence, (1 - _smooth(0.0, 0.35, vein)) * 0.8, _smooth(0.5, 1, _fractal(rng, 4, 4)) * 0.5
    )


def _grass(rng: np.random.Generator) -> Map:
    blades = 0.5 * _noise(rng, 128, 48) + 0.5 * _noise(rng, 90, 128)
    patch = _fractal(rng, 4, 4)
    return _mix(0.35 + 0.65 * blades, _smooth(0.35, 0.8, patch) * 0.8, _smooth(0.75, 0.95, _fractal(rng, 20, 3)))


def _gravel(rng: np.random.Generator) -> Map:
    count = int(rng.integers(20, 40))
    nearest, second, label = _cells(rng, count)
    table = rng.random((2, count * count), dtype=np.float32)
    gap = _smooth(0.0, 0.35, second - nearest)
    return _mix((0.25 + 0.75 * gap) * (0.55 + 0.45 * table[0][label]), (table[1][label] > 0.6) * 0.8)


def _cobble(rng: np.random.Generator) -> Map:
    count = int(rng.integers(5, 10))
    nearest, second, label = _cells(rng, count, 0.6)
    table = rng.random((2, count * count), dtype=np.float32)
    joint = 1 - _smooth(0.05, 0.2, second - nearest)
    shade = (0.6 + 0.25 * table[0][label] + 0.15 * _fractal(rng, 16, 4)) * (1 - 0.25 * _smooth(0.3, 0.8, nearest))
    return _mix(shade, joint * 0.9, (table[1][label] > 0.65) * (1 - joint) * 0.7)


def _concrete(rng: np.random.Generator) -> Map:
    base = _fractal(rng, 3, 6, 0.65)
    stain = _smooth(0.6, 0.95, _fractal(rng, 2, 5))
    crack = 1 - _smooth(0.0, 0.03, np.abs(_fractal(rng, 3, 5) - 0.5))
    return _mix(0.72 + 0.28 * base, stain * 0.6, crack * 0.5 * (rng.random() < 0.5))


def _metal(rng: np.random.Generator) -> Map:
    return _mix(0.85 + 0.15 * _noise(rng, 4, 200), _smooth(0.6, 1, _fractal(rng, 3, 4)) * 0.4)


def _foliage(rng: np.random.Generator) -> Map:
    count = int(rng.integers(14, 26))
    nearest, second, label = _cells(rng, count, 1.0)
    table = rng.random((2, count * count), dtype=np.float32)
    depth = _smooth(0.1, 0.8, _fractal(rng, 7, 3))
    leaf = _smooth(0.0, 0.3, second - nearest)
    return _mix((0.2 + 0.8 * leaf) * (0.3 + 0.7 * depth), table[0][label] * 0.8, (table[1][label] > 0.85) * 0.6)


def _wallpaper(rng: np.random.Generator) -> Map:
    x, y = _grid_xy()
    count = 2 * int(rng.integers(2, 5))
    u, v = x * count, y * count
    u = u + 0.5 * (np.floor(v) % 2)
    angle = np.arctan2(v % 1 - 0.5, u % 1 - 0.5)
    radius = np.hypot(u % 1 - 0.5, v % 1 - 0.5) / (0.3 + 0.1 * np.cos(int(rng.integers(2, 7)) * angle))
    motif = 1 - _smooth(0.85, 1.0, radius)
    return _mix(0.93 + 0.07 * _fractal(rng, 6, 4), motif, (1 - _smooth(0.3, 0.4, radius)))


def _roof(rng: np.random.Generator) -> Map:
    joint, shade, pick = _courses(rng, int(rng.integers(6, 10)), 2 * int(rng.integers(3, 6)), 0.012, 0.5)
    _, y = _grid_xy()
    return _mix((0.45 + 0.4 * shade + 0.15 * _fractal(rng, 20, 3)) * (1 - 0.6 * joint), 0.0 * y, (pick > 0.7) * 0.7)


def _clouds(rng: np.random.Generator) -> Map:
    return _mix(np.ones((SIZE, SIZE), np.float32), _smooth(0.5, 0.85, _fractal(rng, 3, 6)))


def _basket(rng: np.random.Generator) -> Map:
    nearest, second, label = _cells(rng, 2 * int(rng.integers(3, 6)), 0.0)
    x, y = _grid_xy()
    count = 2 * int(rng.integers(3, 6))
    u, v = x * count, y * count
    shifted = (u + 0.5 * (np.floor(v) % 2)) % 1
    edge = np.minimum(np.abs(shifted - 0.5), np.abs(v % 1 - 0.5) + 0.1)
    return _mix(0.7 + 0.3 * _smooth(0, 0.3, second - nearest), 1 - _smooth(0.03, 0.08, edge), (label % 3 == 0) * 0.7)


def _herringbone(rng: np.random.Generator) -> Map:
    x, y = _grid_xy()
    count = int(rng.integers(4, 8))
    zigzag = np.abs(((x * count) % 1) - 0.5) * 2
    band = (y * 2 * count + zigzag) % 1
    lane = (x * 2 * count).astype(np.int64) + 31 * np.floor(y * 2 * count + zigzag).astype(np.int64)
    tone = rng.random(4096, dtype=np.float32)[lane % 4096]
    joint = np.maximum(1 - _smooth(0.03, 0.1, band), 1 - _smooth(0.02, 0.06, np.abs((x * 2 * count) % 1)))
    return _mix(0.65 + 0.35 * tone, joint * 0.8, _smooth(0.5, 0.9, _fractal(rng, 30, 2)) * 0.3)


def _terrazzo(rng: np.random.Generator) -> Map:
    count = int(rng.integers(14, 24))
    nearest, _, label = _cells(rng, count, 1.0)
    table = rng.random((2, count * count), dtype=np.float32)
    chip = 1 - _smooth(0.9, 1.0, nearest / (0.15 + 0.35 * table[0][label]))
    return _mix(0.92 + 0.08 * _fractal(rng, 20, 3), chip * (table[1][label] > 0.5), chip * (table[1][label] <= 0.5))


def _families() -> dict[str, Callable[[np.random.Generator], Map]]:
    patterns: dict[str, Callable[[np.random.Generator], Map]] = {
        "plain": _plain, "plaster": _plaster, "brick": _brick, "ashlar": _ashlar, "tiles": _tiles, "checker": _checker,
        "planks": _planks, "wood": _wood, "fabric": _fabric, "stripes": _stripes, "marble": _marble, "grass": _grass,
        "gravel": _gravel, "cobble": _cobble, "concrete": _concrete, "metal": _metal, "foliage": _foliage,
        "wallpaper": _wallpaper, "roof": _roof, "clouds": _clouds, "basket": _basket, "herringbone": _herringbone,
        "terrazzo": _terrazzo,
    }  # fmt: skip
    return patterns | PICTURE_FAMILIES


#: Families that only the test split may use.
TEST_FAMILIES = frozenset({"basket", "herringbone", "terrazzo"})


def draw_texture(rng: np.random.Generator, family: str, split: Split) -> TextureKey:
    """A random variant of a family, from the variants of the given split."""
    variants = VARIANTS[split]
    return TextureKey(family, int(rng.integers(variants.start, variants.stop)))


def weight_map(key: TextureKey) -> Map:
    """The (256, 256, 3) float32 weight map of a texture."""
    families = _families()
    if key.family not in families:
        raise ValueError(f"unknown texture family {key.family!r}; known: {sorted(families)}")
    rng = np.random.default_rng([zlib.crc32(key.family.encode()), key.variant])
    return np.clip(families[key.family](rng), 0, 1).astype(np.float32)


@functools.lru_cache(maxsize=1024)
def packed_texture(key: TextureKey) -> NDArray[np.uint8]:
    """(87381, 3) uint8: the mip levels 256^2, 128^2, ..., 1 one after the other (each the 2x2 box filter of the last)."""
    level = weight_map(key)
    packed = []
    for _ in range(LEVELS):
        packed.append(level.reshape(-1, 3))
        if len(level) > 1:
            level = (level[0::2, 0::2] + level[0::2, 1::2] + level[1::2, 0::2] + level[1::2, 1::2]) / np.float32(4)
    result = np.round(np.concatenate(packed) * 255).astype(np.uint8)
    result.setflags(write=False)
    return result
