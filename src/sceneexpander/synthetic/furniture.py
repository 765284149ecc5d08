"""Materials drawn at random, and furniture and plants made of several primitives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sceneexpander.synthetic.intersect import Shape
from sceneexpander.synthetic.textures import TEST_FAMILIES, Split, TextureKey, draw_texture
from sceneexpander.synthetic.world import Material, Vector, WorldBuilder

Colour = tuple[float, float, float]
RGB: tuple[Colour, ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

#: Hue ranges (degrees), saturation and value ranges by kind of thing.
_TONES: dict[str, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    "wall": ((20, 60), (0.02, 0.25), (0.65, 0.97)),
    "wood": ((18, 38), (0.3, 0.65), (0.3, 0.85)),
    "stone": ((20, 60), (0.03, 0.22), (0.4, 0.85)),
    "brick": ((5, 25), (0.35, 0.65), (0.45, 0.75)),
    "leaf": ((70, 130), (0.35, 0.7), (0.3, 0.65)),
    "roof": ((5, 25), (0.35, 0.6), (0.4, 0.7)),
    "metal": ((190, 240), (0.02, 0.12), (0.3, 0.85)),
    "any": ((0, 360), (0.1, 0.75), (0.25, 0.95)),
}

_SURFACES: dict[str, tuple[tuple[str, str, float], ...]] = {
    # (texture family, tone, repeats per metre)
    "wall": (
        ("wallpaper", "wall", 0.9), ("brick", "brick", 0.9), ("plaster", "wall", 0.5), ("ashlar", "stone", 0.5),
        ("concrete", "stone", 0.4), ("stripes", "wall", 0.9), ("planks", "wood", 0.7), ("tiles", "any", 0.8),
        ("basket", "any", 0.9), ("terrazzo", "stone", 0.8),
    ),
    "floor": (
        ("planks", "wood", 0.6), ("tiles", "stone", 0.6), ("checker", "any", 0.6), ("marble", "stone", 0.5),
        ("fabric", "any", 1.0), ("concrete", "stone", 0.4), ("cobble", "stone", 0.7), ("herringbone", "wood", 0.6),
        ("terrazzo", "stone", 1.0),
    ),
    "ground": (
        ("grass", "leaf", 0.5), ("gravel", "stone", 0.6), ("cobble", "stone", 0.4), ("concrete", "stone", 0.2),
        ("tiles", "stone", 0.4), ("herringbone", "brick", 0.5),
    ),
    "facade": (
        ("brick", "brick", 0.5), ("ashlar", "stone", 0.35), ("plaster", "wall", 0.25), ("concrete", "stone", 0.2),
        ("planks", "wood", 0.4), ("basket", "stone", 0.5),
    ),
    "object": (
        ("wood", "wood", 1.5), ("fabric", "any", 2.0), ("metal", "metal", 1.5), ("marble", "any", 1.5),
        ("planks", "wood", 1.5), ("wallpaper", "any", 2.0), ("checker", "any", 2.5), ("stripes", "any", 2.0),
        ("crate", "rgb", 0.0), ("picture", "rgb", 0.0), ("poster", "rgb", 0.0), ("terrazzo", "any", 2.0),
    ),
    "cloth": (("fabric", "any", 1.5), ("stripes", "any", 1.5), ("wallpaper", "any", 2.0), ("checker", "any", 2.0)),
    "wood": (("wood", "wood", 1.2), ("planks", "wood", 1.0)),
    "leaf": (("foliage", "leaf", 1.0),),
    "roof": (("roof", "roof", 0.5),),
    "stone": (("ashlar", "stone", 0.6), ("marble", "stone", 0.6), ("concrete", "stone", 0.5)),
}  # fmt: skip


def _hsv(hue_deg: float, saturation: float, value: float) -> Colour:
    k = [(n + hue_deg / 60) % 6 for n in (5, 3, 1)]
    r, g, b = (value - value * saturation * max(0.0, min(x, 4 - x, 1.0)) for x in k)
    return r, g, b


@dataclass(frozen=True, slots=True)
class Palette:
    """Draws materials: nearly plain ones with probability ``plain_share``."""

    rng: np.random.Generator
    split: Split
    plain_share: float

    def colour(self, tone: str) -> Colour:
        """A random display-space colour."""
        return _hsv(*(float(self.rng.uniform(*limits)) for limits in _TONES[tone]))

    def picture(self, family: str, *, emission: float = 0.0) -> Material:
        """A picture-like texture, stretched once over its face."""
        return Material(
            texture=draw_texture(self.rng, family, self.split), colours=RGB, repeats_per_m=0.0, emission=emission
        )

    def surface(self, use: str, *, textured: bool = False) -> Material:
        """A material for a use (wall, floor, ...); ``textured`` rules out the nearly plain ones."""
        options = [o for o in _SURFACES[use] if self.split == "test" or o[0] not in TEST_FAMILIES]
        family, tone, rate = options[int(self.rng.integers(len(options)))]
        if not textured and self.rng.random() < self.plain_share and tone != "rgb":
            family = str(self.rng.choice(["plain", "plain", "plaster"]))
            rate = float(self.rng.uniform(0.02, 0.4))
        if tone == "rgb":
            return self.picture(family)
        first = self.colour(tone)
        shift = self.rng.uniform(0.35, 0.9)
        second = tuple(float(np.clip(c * shift, 0, 1)) for c in first)
        third = self.colour(tone if self.rng.random() < 0.7 else "any")
        offset = self.rng.random(2)
        return Material(
            texture=draw_texture(self.rng, family, self.split),
            colours=(first, (second[0], second[1], second[2]), third),
            repeats_per_m=rate * float(self.rng.uniform(0.7, 1.5)),
            offset=(float(offset[0]), float(offset[1])),
        )


def plain(colour: Colour, *, emission: float = 0.0, variant: int = 0) -> Material:
    """One colour with very weak noise."""
    return Material(texture=TextureKey("plain", variant), colours=(colour,) * 3, repeats_per_m=0.5, emission=emission)


def add_table(b: WorldBuilder, p: Palette, position: Vector, yaw: float) -> tuple[float, float, float]:
    """A table; returns the half extents of its top and its height."""
    half_x, half_y, height = p.rng.uniform(0.4, 1.0), p.rng.uniform(0.35, 0.6), p.rng.uniform(0.4, 0.8)
    top, leg = p.surface("wood"), p.surface("wood")
    b.at(position, yaw, "table")
    round_top = p.rng.random() < 0.3
    b.add(Shape.CYLINDER if round_top else Shape.BOX, (0, 0, height - 0.025), (half_x, half_y, 0.025), top)
    if round_top or p.rng.random() < 0.2:
        b.add(Shape.CYLINDER, (0, 0, height / 2), (0.05, 0.05, height / 2 - 0.02), leg)
        b.add(Shape.CYLINDER, (0, 0, 0.02), (0.3, 0.3, 0.02), leg)
    else:
        for sx in (-1, 1):
            for sy in (-1, 1):
                centre = (sx * (half_x - 0.05), sy * (half_y - 0.05), height / 2 - 0.02)
                b.add(Shape.BOX, centre, (0.03, 0.03, height / 2 - 0.02), leg)
    return float(half_x), float(half_y), float(height)


def add_chair(b: WorldBuilder, p: Palette, position: Vector, yaw: float) -> None:
    """A chair that looks along +x of its own frame."""
    seat, leg = p.surface("cloth"), p.surface("wood")
    b.at(position, yaw, "chair")
    b.add(Shape.BOX, (0, 0, 0.45), (0.22, 0.22, 0.03), seat)
    b.add(Shape.BOX, (-0.2, 0, 0.75), (0.02, 0.2, 0.22), leg)
    for sx in (-1, 1):
        for sy in (-1, 1):
            b.add(Shape.BOX, (sx * 0.19, sy * 0.19, 0.21), (0.02, 0.02, 0.21), leg)


def add_sofa(b: WorldBuilder, p: Palette, position: Vector, yaw: float) -> None:
    """A sofa that looks along +x of its own frame."""
    cloth, cushion = p.surface("cloth"), p.surface("cloth", textured=True)
    width = float(p.rng.uniform(0.7, 1.1))
    b.at(position, yaw, "sofa")
    b.add(Shape.BOX, (0, 0, 0.22), (0.42, width, 0.2), cloth)
    b.add(Shape.BOX, (-0.36, 0, 0.5), (0.1, width, 0.35), cloth)
    for side in (-1, 1):
        b.add(Shape.BOX, (0, side * (width - 0.08), 0.35), (0.42, 0.08, 0.27), cloth)
        b.add(Shape.ELLIPSOID, (-0.18, side * width * 0.45, 0.55), (0.1, 0.22, 0.18), cushion)


def add_shelf(b: WorldBuilder, p: Palette, position: Vector, yaw: float) -> None:
    """A shelf with books whose open side looks along +x of its own frame."""
    wood = p.surface("wood")
    width, height, boards = float(p.rng.uniform(0.4, 0.9)), float(p.rng.uniform(1.0, 2.1)), int(p.rng.integers(3, 6))
    b.at(position, yaw, "shelf")
    b.add(Shape.BOX, (-0.14, 0, height / 2), (0.01, width, height / 2), wood)
    for side in (-1, 1):
        b.add(Shape.BOX, (0, side * width, height / 2), (0.15, 0.015, height / 2), wood)
    step = height / boards
    for board in range(boards + 1):
        b.add(Shape.BOX, (0, 0, 0.02 + board * (height - 0.04) / boards), (0.15, width, 0.015), wood)
        if board < boards and p.rng.random() < 0.8:
            filled = width * p.rng.uniform(0.5, 0.95)
            tall = step * p.rng.uniform(0.3, 0.42)
            centre = (-0.02, (width - filled) * p.rng.choice([-1, 1]), 0.035 + board * (height - 0.04) / boards + tall)
            b.add(Shape.BOX, centre, (0.1, filled - 0.02, tall), p.picture("books"))


def add_lamp(b: WorldBuilder, p: Palette, position: Vector, yaw: float) -> None:
    """A standing lamp with a glowing shade."""
    height = float(p.rng.uniform(1.2, 1.7))
    b.at(position, yaw, "lamp")
    metal = plain(p.colour("metal"))
    b.add(Shape.CYLINDER, (0, 0, 0.015), (0.15, 0.15, 0.015), metal)
    b.add(Shape.CYLINDER, (0, 0, height / 2), (0.015, 0.015, height / 2), metal)
    glow = plain(p.colour("wall"), emission=0.8)
    b.add(Shape.CYLINDER, (0, 0, height), (0.2, 0.2, 0.15), glow, extra=0.25, casts_shadow=False)


def add_plant(b: WorldBuilder, p: Palette, position: Vector, yaw: float) -> None:
    """A pot with leaves."""
    size = float(p.rng.uniform(0.6, 1.3))
    b.at(position, yaw, "plant")
    pot = p.surface("object") if p.rng.random() < 0.5 else plain(p.colour("brick"))
    b.add(Shape.CYLINDER, (0, 0, 0.18 * size), (0.16 * size, 0.16 * size, 0.18 * size), pot, extra=-0.2)
    leaf = p.surface("leaf", textured=True)
    for _ in range(int(p.rng.integers(3, 8))):
        centre = p.rng.normal(0, 0.12, 3) * size + [0, 0, 0.6 * size]
        b.add(Shape.ELLIPSOID, centre, p.rng.uniform(0.08, 0.25, 3) * size, leaf)


def add_crate(b: WorldBuilder, p: Palette, position: Vector, yaw: float) -> None:
    """One crate, or a stack."""
    half = p.rng.uniform(0.12, 0.4, 3)
    b.at(position, yaw, "crate")
    b.add(Shape.BOX, (0, 0, half[2]), half, p.picture("crate") if p.rng.random() < 0.5 else p.surface("object"))
    if p.rng.random() < 0.4:
        upper = half * p.rng.uniform(0.5, 0.9)
        b.add(Shape.BOX, (0, 0, 2 * half[2] + upper[2]), upper, p.surface("object"))


def add_column(b: WorldBuilder, p: Palette, position: Vector, yaw: float, height: float = 3.0) -> None:
    """A column with base and capital."""
    stone = p.surface("stone")
    radius = float(p.rng.uniform(0.14, 0.3))
    b.at(position, yaw, "column")
    b.add(Shape.BOX, (0, 0, 0.1), (1.5 * radius, 1.5 * radius, 0.1), stone)
    b.add(Shape.CYLINDER, (0, 0, height / 2), (radius, radius, height / 2 - 0.1), stone, extra=0.06)
    b.add(Shape.BOX, (0, 0, height - 0.1), (1.5 * radius, 1.5 * radius, 0.1), stone)


def add_tree(b: WorldBuilder, p: Palette, position: Vector, yaw: float) -> None:
    """A trunk and a crown of ellipsoids."""
    height = float(p.rng.uniform(2.5, 5.0))
    b.at(position, yaw, "tree")
    b.add(
        Shape.CYLINDER, (0, 0, height * 0.35), (0.15, 0.15, height * 0.35), p.surface("wood", textured=True), extra=0.2
    )
    leaf = p.surface("leaf", textured=True)
    for _ in range(int(p.rng.integers(4, 9))):
        centre = p.rng.normal(0, 0.5, 3) + [0, 0, height * 0.85]
        b.add(Shape.ELLIPSOID, centre, p.rng.uniform(0.5, 1.2, 3), leaf)


def add_trinket(b: WorldBuilder, p: Palette, position: Vector, yaw: float) -> None:
    """A small thing for a table top: book, cup, bottle, vase, ball, box."""
    b.at(position, yaw, "trinket")
    style, size = int(p.rng.integers(5)), float(p.rng.uniform(0.7, 1.4))
    surface = p.surface("object", textured=bool(p.rng.random() < 0.5))
    if style == 0:
        z = 0.0
        for _ in range(int(p.rng.integers(1, 4))):
            half = p.rng.uniform([0.07, 0.1, 0.01], [0.11, 0.15, 0.025]) * size
            b.add(Shape.BOX, (0, 0, z + half[2]), half, p.surface("object"))
            z += 2 * half[2]
    elif style == 1:
        b.add(Shape.TUBE, (0, 0, 0.05 * size), (0.045 * size, 0.045 * size, 0.05 * size), surface, extra=0.88)
    elif style == 2:
        b.add(Shape.CYLINDER, (0, 0, 0.1 * size), (0.04 * size, 0.04 * size, 0.1 * size), surface)
        b.add(Shape.CYLINDER, (0, 0, 0.24 * size), (0.022 * size, 0.022 * size, 0.045 * size), surface, extra=0.4)
    elif style == 3:
        radius = 0.08 * size
        b.add(Shape.ELLIPSOID, (0, 0, radius * 0.98), (radius, radius, radius * p.rng.uniform(0.7, 1)), surface)
    else:
        half = p.rng.uniform(0.03, 0.12, 3) * size
        b.add(Shape.BOX, (0, 0, half[2]), half, surface)


Furniture = Callable[[WorldBuilder, Palette, Vector, float], object]
INDOOR: tuple[Furniture, ...] = (add_table, add_chair, add_chair, add_sofa, add_shelf, add_lamp, add_plant, add_crate)
OUTDOOR: tuple[Furniture, ...] = (add_crate, add_column, add_plant, add_tree, add_table, add_chair)
