"""The bundled scene's world: a walled courtyard with a fountain, an arcade and a house, designed by hand.

World frame: metres, z up, x to the east, y to the north. The house stands north (y = 5), the arcade west (x = -5), a brick barn
east (x = 5.6). The captured views walk along the south side and never see the barn or the north-east corner; the inserted view
turns right into that corner, where (only there and only then) a stone well stands.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.synthetic.furniture import Colour
from sceneexpander.synthetic.intersect import Shape
from sceneexpander.synthetic.textures import TextureKey
from sceneexpander.synthetic.trajectories import pose_from_angles, same_lens
from sceneexpander.synthetic.world import Light, Material, Sky, World, WorldBuilder, rotation_z

WELL = "well"
#: Objects that are part of the house: whatever moves one of them moves all.
HOUSE_PARTS = ("house", "window", "flower box", "door", "lantern", "plaque", "vine", "bench")
MOTION = "Turn right towards the corner of the courtyard."
OBJECT = "An old stone well with a wooden bucket and a small tiled roof stands to the right of the table."
PROMPT = (
    "To the right of the table in this courtyard stands an old stone well with a wooden bucket and a small tiled roof."
)

_WOOD: tuple[Colour, Colour, Colour] = ((0.55, 0.38, 0.24), (0.2, 0.13, 0.08), (0.38, 0.25, 0.16))
_STONE: tuple[Colour, Colour, Colour] = ((0.8, 0.75, 0.66), (0.5, 0.46, 0.4), (0.66, 0.58, 0.48))
_TERRACOTTA: tuple[Colour, Colour, Colour] = ((0.75, 0.42, 0.28), (0.55, 0.28, 0.18), (0.8, 0.5, 0.34))
_ROOF: tuple[Colour, Colour, Colour] = ((0.76, 0.43, 0.29), (0.4, 0.2, 0.14), (0.62, 0.33, 0.22))
_WELL_AT = (4.05, 3.0, 0.0)
_CRATE: Colour = (0.82, 0.66, 0.48)
_GREENS: tuple[Colour, ...] = ((0.24, 0.38, 0.14), (0.33, 0.47, 0.18), (0.42, 0.54, 0.24), (0.2, 0.32, 0.16))


def _material(
    family: str, variant: int, colours: tuple[Colour, Colour, Colour], rate: float, *, detail: float = 0.5, **more: Any
) -> Material:
    return Material(texture=TextureKey(family, variant), colours=colours, repeats_per_m=rate, detail=detail, **more)


def _picture(family: str, variant: int, tint: Colour = (1.0, 1.0, 1.0)) -> Material:
    red, green, blue = tint
    colours = ((red, 0.0, 0.0), (0.0, green, 0.0), (0.0, 0.0, blue))
    return Material(texture=TextureKey(family, variant), colours=colours, repeats_per_m=0.0)


def _wood(rate: float = 1.3, *, turned: bool = False, tint: float = 1.0) -> Material:
    colours = tuple((r * tint, g * tint, b * tint) for r, g, b in _WOOD)
    return _material("planks", 3, (colours[0], colours[1], colours[2]), rate, turned=turned)


def _stone(rate: float = 0.8, variant: int = 2) -> Material:
    return _material("concrete", variant, _STONE, rate, detail=0.6)


def _leaves(
    b: WorldBuilder,
    rng: np.random.Generator,
    centre: tuple[float, float, float],
    spread: tuple[float, float, float],
    count: int,
    *,
    size: float = 0.07,
    flowers: Colour | None = None,
) -> None:
    """A clump of small flat ellipsoids, a few of them flowers."""
    greens = [Material(texture=TextureKey("plain", 0), colours=(g, g, g), repeats_per_m=1.0) for g in _GREENS]
    bloom = None
    if flowers is not None:
        bloom = Material(texture=TextureKey("plain", 0), colours=(flowers, flowers, flowers), repeats_per_m=1.0)
    for _ in range(count):
        way = rng.normal(size=3)
        way *= rng.uniform(0.45, 1.0) / np.linalg.norm(way)
        place = np.asarray(centre) + way * np.asarray(spread)
        basis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        flower = bloom is not None and way[2] > -0.2 and rng.random() < 0.22
        material = bloom if flower and bloom is not None else greens[int(rng.integers(len(greens)))]
        long = size * rng.uniform(0.7, 1.3)
        half = (long * 0.6, long * 0.6, long * 0.4) if flower else (long, long * 0.5, long * 0.15)
        b.add(Shape.ELLIPSOID, place, half, material, rotation=basis)


def _pot(
    b: WorldBuilder,
    rng: np.random.Generator,
    x: float,
    y: float,
    size: float,
    *,
    flowers: Colour | None = None,
    tall: float = 1.0,
) -> None:
    b.at((x, y, 0.0), name="pot")
    clay = _material("plaster", 4, _TERRACOTTA, 1.5)
    b.add(Shape.CYLINDER, (0, 0, 0.2 * size), (0.2 * size, 0.2 * size, 0.2 * size), clay, extra=-0.25)
    b.add(Shape.CYLINDER, (0, 0, 0.41 * size), (0.27 * size, 0.27 * size, 0.035 * size), clay)
    spread = (0.3 * size, 0.3 * size, 0.28 * size * tall)
    _leaves(b, rng, (0, 0, (0.5 + 0.22 * tall) * size), spread, 70, size=0.08 * size, flowers=flowers)


def _window(
    b: WorldBuilder,
    x: float,
    y: float,
    z: float,
    variant: int,
    *,
    yaw: float = 0.0,
    shutters: Colour | None = None,
    name: str = "window",
) -> None:
    """A window in a wall that faces -y (before ``yaw``): glass, stone frame, sill, shutters."""
    b.at((x, y, z), yaw, name)
    b.add(Shape.BOX, (0, 0, 0), (0.45, 0.03, 0.62), _picture("window", variant))
    frame = _stone(1.2)
    b.add(Shape.BOX, (0, 0, 0.69), (0.6, 0.07, 0.08), frame)
    b.add(Shape.BOX, (0, -0.04, -0.68), (0.62, 0.12, 0.06), frame)
    for side in (-1, 1):
        b.add(Shape.BOX, (side * 0.5, 0, 0), (0.06, 0.06, 0.62), frame)
        if shutters is not None:
            dark = (shutters[0] * 0.45, shutters[1] * 0.45, shutters[2] * 0.45)
            slats = _material("stripes", 3, (shutters, dark, shutters), 2.6, turned=True, detail=0.3)
            b.add(Shape.BOX, (side * 0.8, -0.01, 0), (0.22, 0.035, 0.62), slats)


def _house(b: WorldBuilder, rng: np.random.Generator) -> None:
    """The north side: plastered house with plinth, door, shuttered windows, flower boxes, eaves and roof."""
    wall = _material("plaster", 7, ((0.93, 0.8, 0.6), (0.6, 0.5, 0.4), (0.8, 0.62, 0.44)), 0.35, detail=0.35)
    b.at((0.0, 5.0, 0.0), name="house")
    b.add(Shape.BOX, (-0.5, 2.0, 2.5), (6.6, 2.0, 2.5), wall)
    b.add(Shape.BOX, (-0.5, 1.95, 0.42), (6.65, 2.0, 0.42), _material("ashlar", 3, _STONE, 0.75))
    b.add(Shape.BOX, (-0.5, 1.95, 2.95), (6.65, 2.0, 0.07), _stone(0.9))
    b.add(Shape.WEDGE, (-0.5, 2.0, 5.97), (7.0, 2.7, 0.95), _material("roof", 2, _ROOF, 0.55, detail=0.4))
    b.add(Shape.BOX, (-0.5, -0.35, 4.98), (7.0, 0.3, 0.06), _wood(1.0))
    for x in np.arange(-6.6, 6.2, 0.62):
        b.add(Shape.BOX, (float(x), -0.28, 4.87), (0.06, 0.3, 0.07), _wood(1.0, tint=0.8))
    green = (0.24, 0.4, 0.36)
    for x, variant in ((-3.7, 3), (0.75, 5), (3.2, 9)):
        _window(b, x, 4.98, 1.75, variant, shutters=green)
        b.at((x, 4.8, 1.08), name="flower box")
        b.add(Shape.BOX, (0, 0, 0), (0.5, 0.13, 0.1), _material("plaster", 4, _TERRACOTTA, 1.5))
        _leaves(b, rng, (0, -0.02, 0.18), (0.5, 0.15, 0.14), 60, size=0.055, flowers=(0.86, 0.2, 0.26))
    for x, variant in ((-3.7, 12), (-1.4, 3), (0.75, 14), (3.2, 5)):
        _window(b, x, 4.98, 3.85, variant, shutters=green)
    b.at((-1.4, 5.0, 0.0), name="door")
    b.add(Shape.BOX, (0, -0.02, 1.22), (0.55, 0.04, 1.1), _picture("door", 1))
    stone = _stone(1.0)
    for side in (-1, 1):
        b.add(Shape.BOX, (side * 0.68, -0.03, 1.2), (0.13, 0.1, 1.2), _material("ashlar", 5, _STONE, 0.9))
    b.add(Shape.BOX, (0, -0.03, 2.5), (0.85, 0.13, 0.14), stone)
    b.add(Shape.BOX, (0, -0.35, 0.05), (1.0, 0.5, 0.05), stone)
    b.add(Shape.BOX, (0, -0.2, 0.12), (0.8, 0.3, 0.06), stone)
    b.at((-2.45, 4.93, 2.2), name="lantern")
    iron = Material(texture=TextureKey("plain", 0), colours=((0.12, 0.12, 0.13),) * 3, repeats_per_m=1.0)
    b.add(Shape.BOX, (0, -0.1, 0.2), (0.015, 0.12, 0.015), iron)
    b.add(Shape.CYLINDER, (0, -0.2, 0.02), (0.08, 0.08, 0.13), _picture("window", 2), extra=-0.3)
    b.add(Shape.CYLINDER, (0, -0.2, 0.18), (0.11, 0.11, 0.04), iron, extra=0.7)
    b.at((-5.0, 4.9, 0.0), name="vine")
    _leaves(b, rng, (0.1, -0.02, 2.3), (0.45, 0.13, 2.2), 330, size=0.11)
    b.at((1.98, 4.97, 1.9), name="plaque")
    b.add(Shape.BOX, (0, 0, 0), (0.16, 0.03, 0.22), _picture("poster", 4))


def _arcade(b: WorldBuilder) -> None:
    """The west side: three arches on square piers, a shaded walk, a back wall with doors, a lean-to roof."""
    ashlar = _material("ashlar", 1, ((0.78, 0.7, 0.58), (0.5, 0.44, 0.36), (0.62, 0.52, 0.42)), 0.7)
    b.at((-5.0, 0.0, 0.0), name="arcade")
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    span = 2.3
    for bay in range(4):
        y = 3.85 - bay * span
        b.add(Shape.ARCH, (0, y, 2.75), (span / 2, 0.2, 0.75), ashlar, rotation=quarter, extra=0.68)
        b.add(Shape.BOX, (0, y - span / 2, 1.0), (0.24, 0.27, 1.0), ashlar)
        b.add(Shape.BOX, (0, y - span / 2, 1.94), (0.29, 0.32, 0.07), _stone(1.0))
        b.add(Shape.BOX, (0, y - span / 2, 0.12), (0.31, 0.34, 0.12), _stone(1.0))
        for side in (-1, 1):
            b.add(Shape.BOX, (0, y + side * (span / 2 - 0.235), 2.05), (0.2, 0.235, 0.06), _stone(1.0))
    b.add(Shape.BOX, (-2.2, 0, 2.0), (0.2, 5.2, 2.0), _material("plaster", 9, ((0.9, 0.86, 0.78),) * 3, 0.4))
    for index, y in enumerate((3.8, 1.5, -0.8)):
        b.add(Shape.BOX, (-2.0, y, 1.1), (0.05, 0.5, 1.1), _picture("door", 4 + index))
    b.add(Shape.BOX, (-1.0, 0, 3.58), (1.35, 5.2, 0.08), _wood(0.8))
    tilt = 0.42
    slope = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    roof = _material("roof", 2, _ROOF, 0.55, turned=True, detail=0.4)
    b.add(Shape.BOX, (-1.0, 0, 4.15), (1.6, 5.2, 0.07), roof, rotation=slope)


def _barn(b: WorldBuilder, rng: np.random.Generator) -> None:
    """The east side, which no captured view sees: brick barn, wooden gate, window, ivy."""
    brick = _material("brick", 6, ((0.68, 0.38, 0.28), (0.78, 0.72, 0.64), (0.5, 0.27, 0.22)), 0.85)
    b.at((5.6, 0.0, 0.0), name="barn")
    b.add(Shape.BOX, (2.0, 1.0, 2.2), (2.0, 6.0, 2.2), brick)
    b.add(Shape.BOX, (1.95, 1.0, 0.25), (2.0, 6.02, 0.25), _material("ashlar", 3, _STONE, 0.75))
    b.add(Shape.WEDGE, (2.0, 1.0, 5.1), (6.4, 2.5, 0.7), _material("roof", 2, _ROOF, 0.55),
          rotation=np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))  # fmt: skip
    b.at((5.57, 1.6, 0.0), -np.pi / 2, "gate")
    for side in (-1, 1):
        b.add(Shape.BOX, (side * 0.62, 0, 1.2), (0.6, 0.06, 1.2), _wood(0.9, turned=True, tint=0.9))
        b.add(Shape.BOX, (side * 1.34, -0.02, 1.25), (0.12, 0.1, 1.25), _stone(1.0))
        for z in (0.4, 2.0):
            b.add(Shape.BOX, (side * 0.62, -0.07, z), (0.56, 0.02, 0.08), _wood(1.5, tint=0.6))
    b.add(Shape.BOX, (0, -0.02, 2.56), (1.5, 0.12, 0.14), _wood(1.0, tint=0.8))
    _window(b, 5.58, 3.75, 2.0, 9, yaw=-np.pi / 2, shutters=(0.3, 0.42, 0.55), name="barn window")
    b.at((5.5, 4.75, 0.0), name="ivy")
    _leaves(b, rng, (0, 0, 1.7), (0.14, 0.35, 1.7), 200, size=0.1)
    _pot(b, rng, 5.05, 3.1, 0.9, flowers=(0.95, 0.75, 0.25))


def _fountain(b: WorldBuilder) -> None:
    b.at((-0.9, 1.3, 0.0), name="fountain")
    stone = _material("ashlar", 2, _STONE, 0.8)
    smooth = _stone(1.0)
    water = _material("marble", 1, ((0.28, 0.42, 0.44), (0.45, 0.6, 0.62), (0.2, 0.33, 0.36)), 0.9, detail=0.2)
    b.add(Shape.CYLINDER, (0, 0, 0.06), (1.35, 1.35, 0.06), smooth)
    b.add(Shape.TUBE, (0, 0, 0.33), (1.15, 1.15, 0.22), stone, extra=0.86)
    b.add(Shape.TUBE, (0, 0, 0.57), (1.22, 1.22, 0.045), smooth, extra=0.8)
    b.add(Shape.CYLINDER, (0, 0, 0.24), (1.0, 1.0, 0.2), water)
    b.add(Shape.CYLINDER, (0, 0, 0.7), (0.17, 0.17, 0.35), smooth, extra=0.25)
    b.add(Shape.CYLINDER, (0, 0, 1.1), (0.4, 0.4, 0.09), smooth, extra=-0.6)
    b.add(Shape.CYLINDER, (0, 0, 1.19), (0.56, 0.56, 0.012), water)
    b.add(Shape.TUBE, (0, 0, 1.2), (0.64, 0.64, 0.035), smooth, extra=0.88)
    b.add(Shape.CYLINDER, (0, 0, 1.42), (0.09, 0.09, 0.24), smooth, extra=0.3)
    b.add(Shape.ELLIPSOID, (0, 0, 1.74), (0.12, 0.12, 0.14), smooth)


def _bench(b: WorldBuilder, x: float, y: float, yaw: float = 0.0) -> None:
    b.at((x, y, 0.0), yaw, "bench")
    board = _wood(1.1)
    for offset in (-0.16, 0.0, 0.16):
        b.add(Shape.BOX, (0, offset, 0.46), (0.85, 0.07, 0.025), board)
    for z in (0.66, 0.84):
        b.add(Shape.BOX, (0, 0.26, z), (0.85, 0.025, 0.07), board)
    iron = Material(texture=TextureKey("metal", 2), colours=((0.2, 0.2, 0.21),) * 3, repeats_per_m=1.0)
    for side in (-1, 1):
        for y_leg in (-0.2, 0.24):
            b.add(
                Shape.BOX,
                (side * 0.75, y_leg, 0.22 if y_leg < 0 else 0.46),
                (0.03, 0.03, 0.22 if y_leg < 0 else 0.46),
                iron,
            )


def _props(b: WorldBuilder, rng: np.random.Generator) -> None:
    """What stands about: benches, pots, barrel, crates, an orange tree in a tub, a table with chairs."""
    _bench(b, 1.75, 4.5)
    _pot(b, rng, -0.35, 4.5, 1.1, flowers=(0.92, 0.45, 0.62))
    _pot(b, rng, -2.6, 4.45, 1.3, tall=1.6)
    _pot(b, rng, -4.3, 2.8, 1.0, flowers=(0.95, 0.85, 0.4))
    _pot(b, rng, 0.35, -0.2, 0.95, flowers=(0.75, 0.35, 0.75))
    b.at((-3.6, 4.3, 0.0), name="barrel")
    staves = _wood(1.4, turned=True)
    hoop = Material(texture=TextureKey("metal", 2), colours=((0.25, 0.24, 0.23),) * 3, repeats_per_m=1.0)
    # Two truncated cones, base to base.
    b.add(Shape.CYLINDER, (0, 0, 0.23), (0.335, 0.335, 0.23), staves, extra=-0.13)
    b.add(Shape.CYLINDER, (0, 0, 0.69), (0.335, 0.335, 0.23), staves, extra=0.13)
    for z in (0.14, 0.78):
        b.add(Shape.CYLINDER, (0, 0, z), (0.335, 0.335, 0.03), hoop)
    b.at((-4.25, 0.9, 0.0), 0.3, "crates")
    for place, half, turn in (
        ((0, 0, 0.25), 0.25, 0.0),
        ((0.05, -0.62, 0.22), 0.22, 0.4),
        ((0.03, -0.1, 0.68), 0.18, 0.5),
    ):
        spin = rotation_z(turn)
        b.add(Shape.BOX, place, (half, half * 1.1, half), _picture("crate", 3, _CRATE), rotation=spin)
    b.at((-3.0, -0.3, 0.0), name="orange tree")
    b.add(Shape.BOX, (0, 0, 0.27), (0.32, 0.32, 0.27), _picture("crate", 2, _CRATE))
    b.add(Shape.CYLINDER, (0, 0, 0.95), (0.045, 0.045, 0.45), _wood(2.0, turned=True), extra=0.2)
    _leaves(b, rng, (0, 0, 1.75), (0.55, 0.55, 0.5), 560, size=0.068)
    fruit = Material(texture=TextureKey("plaster", 4), colours=((0.95, 0.55, 0.12),) * 3, repeats_per_m=3.0)
    for _ in range(22):
        way = rng.normal(size=3)
        way /= np.linalg.norm(way)
        b.add(Shape.ELLIPSOID, (0.5 * way[0], 0.5 * way[1], 1.75 + 0.46 * way[2]), (0.05, 0.05, 0.05), fruit)
    b.at((1.7, 2.0, 0.0), 0.4, "table")
    cloth = _material("checker", 2, ((0.92, 0.9, 0.85), (0.72, 0.2, 0.2), (0.9, 0.9, 0.9)), 1.6, detail=0.15)
    b.add(Shape.CYLINDER, (0, 0, 0.74), (0.48, 0.48, 0.02), cloth)
    b.add(Shape.CYLINDER, (0, 0, 0.37), (0.04, 0.04, 0.36), hoop)
    b.add(Shape.CYLINDER, (0, 0, 0.02), (0.25, 0.25, 0.02), hoop)
    b.add(
        Shape.CYLINDER,
        (0.1, 0.05, 0.86),
        (0.07, 0.07, 0.1),
        _material("plaster", 2, ((0.25, 0.42, 0.62),) * 3, 4.0),
        extra=0.3,
    )
    _leaves(b, rng, (0.1, 0.05, 1.04), (0.13, 0.13, 0.12), 26, size=0.05, flowers=(0.97, 0.9, 0.85))
    for angle in (2.2, 4.0):
        x, y = 0.75 * np.cos(angle), 0.75 * np.sin(angle)
        c, s = np.cos(angle), np.sin(angle)
        toward = rotation_z(angle)
        b.add(Shape.BOX, (x, y, 0.45), (0.2, 0.2, 0.02), _wood(1.6), rotation=toward)
        b.add(Shape.BOX, (x + 0.2 * c, y + 0.2 * s, 0.7), (0.015, 0.2, 0.2), _wood(1.6), rotation=toward)
        for dx in (-0.17, 0.17):
            for dy in (-0.17, 0.17):
                b.add(Shape.BOX, (x + dx * c - dy * s, y + dx * s + dy * c, 0.22), (0.017, 0.017, 0.22), _wood(2.0))


def _well(b: WorldBuilder, rng: np.random.Generator) -> None:
    """The object of the prompt: a ring of stones, two posts with a crank, rope and bucket, a small tiled roof."""
    b.at(_WELL_AT, -0.35, WELL)
    for course in range(4):
        count = 15
        for index in range(count):
            angle = 2 * np.pi * (index + 0.5 * (course % 2)) / count
            c, s = float(np.cos(angle)), float(np.sin(angle))
            spin = rotation_z(angle)
            grey = float(rng.uniform(0.42, 0.68))
            stone = _material(
                "concrete", int(rng.integers(3)), ((grey, grey * 0.95, grey * 0.87),) * 3, 1.5, detail=0.9
            )
            out = 0.66 + float(rng.uniform(-0.015, 0.02))
            b.add(Shape.BOX, (out * c, out * s, 0.1 + 0.2 * course), (0.1, 0.133, 0.093), stone, rotation=spin)
    b.add(
        Shape.TUBE,
        (0, 0, 0.4),
        (0.72, 0.72, 0.385),
        _material("concrete", 1, ((0.3, 0.28, 0.26),) * 3, 1.5),
        extra=0.82,
    )
    b.add(Shape.TUBE, (0, 0, 0.84), (0.8, 0.8, 0.045), _stone(1.2), extra=0.72)
    b.add(
        Shape.CYLINDER,
        (0, 0, 0.15),
        (0.6, 0.6, 0.1),
        Material(texture=TextureKey("plain", 0), colours=((0.06, 0.08, 0.09),) * 3),
    )
    for side in (-1, 1):
        b.add(Shape.BOX, (side * 0.72, 0, 1.45), (0.055, 0.055, 0.62), _wood(1.6, turned=True))
    along = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    b.add(Shape.CYLINDER, (0.08, 0, 1.5), (0.06, 0.06, 0.85), _wood(1.6), rotation=along)
    iron = Material(texture=TextureKey("metal", 2), colours=((0.22, 0.21, 0.2),) * 3)
    b.add(Shape.BOX, (0.92, 0, 1.4), (0.015, 0.015, 0.12), iron)
    b.add(Shape.CYLINDER, (1.0, 0, 1.29), (0.02, 0.02, 0.09), iron, rotation=along)
    rope = _material("stripes", 1, ((0.78, 0.68, 0.48), (0.5, 0.42, 0.28), (0.7, 0.6, 0.4)), 9.0, turned=True)
    b.add(Shape.CYLINDER, (-0.1, 0, 1.5), (0.085, 0.085, 0.12), rope, rotation=along)
    b.add(Shape.CYLINDER, (-0.1, 0, 1.35), (0.012, 0.012, 0.15), rope)
    b.add(Shape.CYLINDER, (-0.1, 0, 1.07), (0.14, 0.14, 0.13), _wood(2.5, turned=True, tint=1.1), extra=-0.15)
    for z in (0.99, 1.14):
        b.add(Shape.CYLINDER, (-0.1, 0, z), (0.152, 0.152, 0.012), iron, extra=-0.1)
    b.add(Shape.WEDGE, (0, 0, 2.27), (0.98, 0.72, 0.24), _material("roof", 4, _ROOF, 1.1, detail=0.4))
    b.add(Shape.BOX, (0, 0, 2.02), (0.9, 0.06, 0.05), _wood(1.6))
    _leaves(b, rng, (-0.75, -0.55, 0.08), (0.3, 0.2, 0.1), 40, size=0.06)


def courtyard_world(*, well: bool) -> World:
    """The courtyard, with or without the stone well that the inserted view adds. Always the same bits."""
    b = WorldBuilder("courtyard")
    rng = np.random.default_rng(20)
    b.at((0.0, 0.0, 0.0), name="ground")
    paving = _material("tiles", 6, ((0.78, 0.7, 0.6), (0.5, 0.45, 0.38), (0.66, 0.56, 0.47)), 0.36, detail=0.75)
    b.add(Shape.BOX, (0, 0, -0.5), (80, 80, 0.5), paving, casts_shadow=False)
    cobble = _material("cobble", 5, ((0.62, 0.57, 0.5), (0.36, 0.33, 0.29), (0.52, 0.46, 0.4)), 0.8)
    for centre, half in (((0.0, 4.55), (5.6, 0.45)), ((-4.45, 0.0), (0.55, 4.1)), ((5.1, 0.0), (0.5, 4.1))):
        b.add(Shape.BOX, (*centre, 0.002), (*half, 0.012), cobble, casts_shadow=False)
    _fountain(b)
    _house(b, rng)
    _arcade(b)
    _barn(b, rng)
    _props(b, rng)
    if well:
        _well(b, np.random.default_rng(21))
    direction = np.array([-0.62, -0.5, 0.78])
    direction /= np.linalg.norm(direction)
    sun = (float(direction[0]), float(direction[1]), float(direction[2]))
    b.lights.append(Light(position=sun, colour=(1.0, 0.9, 0.74), sun=True, radius=0.018))
    b.ambient = ((0.26, 0.23, 0.2), (0.36, 0.41, 0.5))
    b.sky = Sky(horizon=(0.72, 0.82, 0.92), zenith=(0.2, 0.4, 0.75), clouds=0.75, texture=TextureKey("clouds", 3))
    b.bounds = ((-4.5, -4.0, 1.2), (4.5, 3.5, 2.2))
    b.focus = [(-0.9, 1.3, 1.0)]
    return b.build()


#: x, y, z (metres), yaw, pitch, roll (degrees) of the captured views: a walk from left to right along the south side.
_CAPTURED = (
    (-3.35, -3.0, 1.62, 86.0, 1.0, 0.3),
    (-2.6, -3.45, 1.58, 88.5, 0.5, -0.4),
    (-1.8, -3.7, 1.66, 91.5, 1.0, 0.2),
    (-1.0, -3.6, 1.7, 95.0, 0.0, 0.0),
    (-0.2, -3.3, 1.6, 99.5, 1.0, 0.5),
    (0.6, -3.5, 1.55, 104.5, 1.5, -0.3),
    (1.4, -3.1, 1.64, 110.0, 0.5, 0.2),
    (2.2, -2.9, 1.72, 115.5, 0.5, -0.2),
)
_INSERTED = (0.75, -2.9, 1.62, 70.5, 0.5, 0.0)
FOCAL_PER_WIDTH = 0.9


def _poses(rows: tuple[tuple[float, ...], ...]) -> NDArray[np.float64]:
    poses = [
        pose_from_angles(np.array(row[:3]), np.deg2rad(row[3]), np.deg2rad(row[4]), np.deg2rad(row[5])) for row in rows
    ]
    return np.stack(poses)


def captured_cameras(height: int, width: int) -> Cameras:
    """Of the eight captured views, in the world's frame."""
    return same_lens(_poses(_CAPTURED), FOCAL_PER_WIDTH * width, height, width)


def inserted_camera(height: int, width: int) -> Cameras:
    """The one from which a consistent inserted view would be taken."""
    return same_lens(_poses((_INSERTED,)), FOCAL_PER_WIDTH * width, height, width)
