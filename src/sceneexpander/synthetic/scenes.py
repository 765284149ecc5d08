"""Scene kinds: random rooms, corridors, open places, table tops and courtyards."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sceneexpander.synthetic.furniture import (
    INDOOR,
    OUTDOOR,
    Palette,
    add_chair,
    add_column,
    add_table,
    add_tree,
    add_trinket,
    plain,
)
from sceneexpander.synthetic.intersect import Shape
from sceneexpander.synthetic.textures import Split, draw_texture
from sceneexpander.synthetic.world import Light, Sky, World, WorldBuilder

KINDS: tuple[str, ...] = ("room", "corridor", "open", "table_top", "courtyard")
_KIND_SHARES = (0.36, 0.14, 0.2, 0.12, 0.18)


def _warm(rng: np.random.Generator, strength: float) -> tuple[float, float, float]:
    tint = rng.uniform(-0.12, 0.12)
    return strength * (1 + tint), strength, strength * (1 - tint)


def _daylight(b: WorldBuilder, p: Palette) -> None:
    """Sun, sky and matching ambient light."""
    azimuth, height = p.rng.uniform(0, 2 * np.pi), np.deg2rad(p.rng.uniform(22, 65))
    direction = (np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height))
    overcast = p.rng.random() < 0.3
    sun = float(p.rng.uniform(0.1, 0.3) if overcast else p.rng.uniform(0.6, 1.1))
    position = (float(direction[0]), float(direction[1]), float(direction[2]))
    b.lights.append(Light(position=position, colour=(sun * 1.05, sun, sun * 0.88), sun=True, radius=0.02))
    level = float(p.rng.uniform(0.3, 0.5)) + (0.35 if overcast else 0.0)
    b.ambient = ((level * 0.5, level * 0.48, level * 0.45), (level * 0.95, level, level * 1.1))
    clouds = float(p.rng.uniform(0.6, 1.0) if overcast else p.rng.uniform(0, 0.9))
    b.sky = Sky(clouds=clouds, texture=draw_texture(p.rng, "clouds", p.split))


def _wall_things(b: WorldBuilder, p: Palette, half: tuple[float, float, float], count: int, windows: float) -> None:
    """Pictures, posters, windows and doors as thin boxes on the four walls of a room centred at the origin."""
    for _ in range(count):
        wall = int(p.rng.integers(4))
        along_y = wall < 2
        reach = (half[1] if along_y else half[0]) * 0.8
        side, place = 1 if wall % 2 else -1, float(p.rng.uniform(-reach, reach))
        kind = p.rng.random()
        if kind < windows:
            material, size = p.picture("daylight", emission=1.3), (p.rng.uniform(0.4, 0.9), p.rng.uniform(0.4, 0.7))
            z, name = 1.5, "window"
        elif kind < windows + 0.15:
            material, size = p.picture("door"), (0.42, 1.0)
            z, name = 1.0, "door"
        else:
            material = p.picture(str(p.rng.choice(["picture", "poster"])))
            size = (p.rng.uniform(0.15, 0.6), p.rng.uniform(0.15, 0.5))
            z, name = float(p.rng.uniform(1.3, 1.8)), "picture"
        z = min(z, 2 * half[2] - float(size[1]) - 0.05)
        depth = float(p.rng.uniform(0.01, 0.04))
        centre = (side * half[0], place, z) if along_y else (place, side * half[1], z)
        extent = (depth, size[0], size[1]) if along_y else (size[0], depth, size[1])
        b.at((0.0, 0.0, 0.0), name=name).add(Shape.BOX, centre, extent, material, casts_shadow=False)


def _scatter(b: WorldBuilder, p: Palette, half_x: float, half_y: float, count: int, outdoor: bool) -> None:
    """Furniture that keeps its distance from other furniture; most of it near the edges of the area."""
    placed: list[tuple[float, float]] = []
    choice = OUTDOOR if outdoor else INDOOR
    for _ in range(count * 4):
        if len(placed) >= count:
            return
        x, y = float(p.rng.uniform(-half_x, half_x)), float(p.rng.uniform(-half_y, half_y))
        if any(np.hypot(x - u, y - v) < 1.0 for u, v in placed):
            continue
        placed.append((x, y))
        # Sofas and shelves look towards the middle.
        yaw = (
            float(np.arctan2(-y, -x) + p.rng.normal(0, 0.2)) if p.rng.random() < 0.7 else float(p.rng.uniform(0, 6.28))
        )
        made = choice[int(p.rng.integers(len(choice)))](b, p, (x, y, 0.0), yaw)
        b.focus.append((x, y, 0.6))
        if isinstance(made, tuple):
            for _ in range(int(p.rng.integers(0, 4))):
                dx, dy = p.rng.uniform(-0.3, 0.3, 2)
                add_trinket(b, p, (x + dx, y + dy, made[2]), float(p.rng.uniform(0, 6.28)))
            for turn in range(int(p.rng.integers(0, 3))):
                angle = yaw + turn * np.pi
                chair = (x + (made[0] + 0.35) * np.cos(angle), y + (made[0] + 0.35) * np.sin(angle), 0.0)
                add_chair(b, p, chair, float(angle + np.pi))


def _room(b: WorldBuilder, p: Palette) -> None:
    half = (float(p.rng.uniform(1.6, 4.0)), float(p.rng.uniform(1.6, 4.0)), float(p.rng.uniform(1.15, 1.7)))
    wall = p.surface("wall")
    walls = [wall if p.rng.random() < 0.75 else p.surface("wall") for _ in range(4)]
    ceiling = plain(p.colour("wall")) if p.rng.random() < 0.8 else p.surface("wall")
    b.at((0.0, 0.0, 0.0), name="room")
    b.add(Shape.ROOM, (0, 0, half[2]), half, [*walls, p.surface("floor"), ceiling], casts_shadow=False)
    if p.rng.random() < 0.5:
        b.at((p.rng.uniform(-0.5, 0.5), p.rng.uniform(-0.5, 0.5), 0.0), float(p.rng.uniform(0, 3)), "rug")
        b.add(Shape.BOX, (0, 0, 0.006), (p.rng.uniform(0.6, 1.4), p.rng.uniform(0.5, 1.0), 0.006), p.picture("rug"))
    _wall_things(b, p, half, int(p.rng.integers(2, 9)), 0.3)
    _scatter(b, p, half[0] - 0.5, half[1] - 0.5, int(p.rng.integers(3, 9)), outdoor=False)
    for _ in range(int(p.rng.integers(1, 4))):
        x, y = p.rng.uniform(-0.7, 0.7, 2) * half[:2]
        strength = float(p.rng.uniform(0.8, 2.2))
        b.lights.append(
            Light(position=(float(x), float(y), 2 * half[2] - 0.25), colour=_warm(p.rng, strength), radius=0.1)
        )
    level = float(p.rng.uniform(0.25, 0.5))
    b.ambient = (_warm(p.rng, level * 0.9), _warm(p.rng, level * 0.7))
    b.bounds = ((-half[0] + 0.3, -half[1] + 0.3, 0.9), (half[0] - 0.3, half[1] - 0.3, min(1.8, 2 * half[2] - 0.3)))


def _corridor(b: WorldBuilder, p: Palette) -> None:
    half = (float(p.rng.uniform(6, 14)), float(p.rng.uniform(0.8, 1.8)), float(p.rng.uniform(1.2, 2.0)))
    wall, floor = p.surface("wall"), p.surface("floor")
    is_open = p.rng.random() < 0.35
    bright = p.picture("daylight", emission=1.5) if p.rng.random() < 0.6 else p.surface("wall")
    b.at((0.0, 0.0, 0.0), name="corridor")
    if is_open:
        b.add(Shape.BOX, (0, 0, -0.5), (100, 100, 0.5), p.surface("ground"), casts_shadow=False)
        b.add(Shape.BOX, (0, 0, 0.005), (half[0], half[1] + 0.4, 0.005), floor, casts_shadow=False)
        b.add(Shape.BOX, (0, 0, 2 * half[2] + 0.15), (half[0], half[1] + 0.4, 0.15), wall)
        b.add(Shape.BOX, (0, half[1] + 0.3, half[2]), (half[0], 0.2, half[2]), wall)
        _daylight(b, p)
        for _ in range(6):
            add_tree(b, p, (p.rng.uniform(-half[0], half[0]), -half[1] - p.rng.uniform(3, 9), 0.0), 0.0)
    else:
        faces = [
            bright,
            bright,
            wall,
            wall if p.rng.random() < 0.7 else p.surface("wall"),
            floor,
            plain(p.colour("wall")),
        ]
        b.add(Shape.ROOM, (0, 0, half[2]), half, faces, casts_shadow=False)
        for x in np.arange(-half[0] + 1.5, half[0], float(p.rng.uniform(2.5, 4.5))):
            strength = float(p.rng.uniform(0.4, 1.1))
            b.lights.append(Light(position=(float(x), 0.0, 2 * half[2] - 0.2), colour=_warm(p.rng, strength)))
        b.lights = b.lights[: int(p.rng.integers(2, 5))]
        b.ambient = (_warm(p.rng, 0.45), _warm(p.rng, 0.4))
        _wall_things(b, p, half, int(p.rng.integers(4, 14)), 0.15)
    spacing, pillar, beam = float(p.rng.uniform(1.6, 3.2)), p.surface("stone"), p.surface("stone")
    style = p.rng.random()
    for x in np.arange(-half[0] + 1, half[0], spacing):
        b.at((float(x), 0.0, 0.0), name="bay")
        if style < 0.6 or is_open:
            for side in (-1, 1):
                shape = Shape.BOX if style < 0.3 else Shape.CYLINDER
                b.add(shape, (0, side * half[1], half[2]), (0.14, 0.14, half[2]), pillar)
        if style < 0.3:
            b.add(Shape.BOX, (0, 0, 2 * half[2] - 0.12), (0.12, half[1], 0.12), beam)
        elif style < 0.5 and half[1] + 0.05 < 2 * half[2] - 0.3:
            high = half[1] / 2 + 0.05
            quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
            centre = (0, 0, 2 * half[2] - high)
            b.add(
                Shape.ARCH,
                centre,
                (half[1], 0.12, high),
                beam,
                rotation=quarter,
                extra=min(half[1] * 0.95, 2 * high - 0.05),
            )
    b.bounds = ((-half[0] + 0.8, -half[1] + 0.35, 1.0), (half[0] - 0.8, half[1] - 0.35, min(1.75, 2 * half[2] - 0.4)))
    for x in (-half[0] * 0.9, half[0] * 0.9):
        b.focus.append((x, float(p.rng.uniform(-0.2, 0.2)), 1.3))


def _building(
    b: WorldBuilder, p: Palette, position: tuple[float, float], half: tuple[float, float, float], yaw: float
) -> None:
    wall = p.surface("facade")
    b.at((position[0], position[1], 0.0), yaw, "building")
    if p.rng.random() < 0.35:
        wall = p.picture("facade")
        b.add(Shape.BOX, (0, 0, half[2]), half, [wall, wall, wall, wall, wall, wall])
    else:
        b.add(Shape.BOX, (0, 0, half[2]), half, wall)
        glass, door = p.picture("window"), p.picture("door")
        for face in range(4):
            reach = half[1] if face < 2 else half[0]
            side = 1 if face % 2 else -1
            columns = max(1, int(reach * 2 / p.rng.uniform(1.4, 2.4)))
            for row in range(int(half[2] * 2 / 2.8)):
                for column in range(columns):
                    place = (column + 0.5) / columns * 2 * reach - reach
                    entrance = row == 0 and column == columns // 2
                    high = 1.05 if entrance else 0.62
                    z = 1.05 if entrance else 1.6 + 2.8 * row
                    size = (0.05, 0.45, high) if face < 2 else (0.45, 0.05, high)
                    centre = (side * half[0], place, z) if face < 2 else (place, side * half[1], z)
                    if z + high < 2 * half[2]:
                        b.add(Shape.BOX, centre, size, door if entrance else glass, casts_shadow=False)
    if p.rng.random() < 0.5:
        rise = float(p.rng.uniform(0.6, 1.4))
        b.add(
            Shape.WEDGE,
            (0, 0, 2 * half[2] + rise),
            (half[0] + 0.3, half[1] + 0.3, rise),
            p.surface("roof", textured=True),
        )


def _open(b: WorldBuilder, p: Palette) -> None:
    b.at((0.0, 0.0, 0.0), name="ground")
    b.add(Shape.BOX, (0, 0, -0.5), (150, 150, 0.5), p.surface("ground", textured=True), casts_shadow=False)
    _daylight(b, p)
    start = float(p.rng.uniform(0, 6.28))
    for index in range(int(p.rng.integers(1, 5))):
        angle, far = start + index * float(p.rng.uniform(0.7, 1.5)), float(p.rng.uniform(7, 16))
        half = (float(p.rng.uniform(1.5, 4)), float(p.rng.uniform(1.5, 4)), float(p.rng.uniform(1.4, 4.2)))
        _building(b, p, (far * np.cos(angle), far * np.sin(angle)), half, float(angle + p.rng.normal(0, 0.2)))
        b.focus.append((far * np.cos(angle) * 0.6, far * np.sin(angle) * 0.6, 1.2))
    for _ in range(int(p.rng.integers(2, 7))):
        angle, far = float(p.rng.uniform(0, 6.28)), float(p.rng.uniform(5, 14))
        add_tree(b, p, (far * np.cos(angle), far * np.sin(angle), 0.0), angle)
    if p.rng.random() < 0.4:
        direction, count = float(p.rng.uniform(0, 3.1)), int(p.rng.integers(3, 7))
        for index in range(count):
            along = (index - count / 2) * 1.6
            add_column(b, p, (2.5 + along * np.cos(direction), along * np.sin(direction) + 2.5, 0.0), direction)
    _scatter(b, p, 4.0, 4.0, int(p.rng.integers(3, 9)), outdoor=True)
    b.bounds = ((-4.5, -4.5, 1.0), (4.5, 4.5, 2.2))


def _table_top(b: WorldBuilder, p: Palette) -> None:
    half = (float(p.rng.uniform(1.8, 3.5)), float(p.rng.uniform(1.8, 3.5)), 1.4)
    b.at((0.0, 0.0, 0.0), name="room")
    wall = p.surface("wall")
    b.add(Shape.ROOM, (0, 0, half[2]), half, [wall, wall, wall, p.surface("wall"), p.surface("floor"), plain((0.9, 0.9, 0.88))],
          casts_shadow=False)  # fmt: skip
    _wall_things(b, p, half, int(p.rng.integers(2, 6)), 0.3)
    half_x, half_y, height = add_table(b, p, (0.0, 0.0, 0.0), float(p.rng.uniform(0, 3)))
    reach = min(half_x, half_y) * 0.85
    spots: list[tuple[float, float]] = []
    for _ in range(40):
        x, y = (float(value) for value in p.rng.uniform(-reach, reach, 2))
        if np.hypot(x, y) > reach or any(np.hypot(x - u, y - v) < 0.2 for u, v in spots):
            continue
        spots.append((x, y))
        add_trinket(b, p, (x, y, height), float(p.rng.uniform(0, 6.28)))
        if len(spots) >= 10:
            break
    b.lights.append(
        Light(position=(float(p.rng.uniform(-1, 1)), float(p.rng.uniform(-1, 1)), 2.5), colour=_warm(p.rng, 2.2))
    )
    b.ambient = (_warm(p.rng, 0.4), _warm(p.rng, 0.35))
    b.bounds = ((-1.5, -1.5, height + 0.15), (1.5, 1.5, height + 0.9))
    b.focus = [(x * 0.6, y * 0.6, height + 0.05) for x, y in spots]


def _courtyard(b: WorldBuilder, p: Palette) -> None:
    half_x, half_y = (float(v) for v in p.rng.uniform(3.5, 6.5, 2))
    b.at((0.0, 0.0, 0.0), name="ground")
    floor = p.surface("ground" if p.rng.random() < 0.5 else "floor", textured=True)
    b.add(Shape.BOX, (0, 0, -0.5), (60, 60, 0.5), floor, casts_shadow=False)
    _daylight(b, p)
    sides = p.rng.permutation(4)[: int(p.rng.integers(2, 5))]
    for side in sides:
        yaw = float(side) * np.pi / 2
        near, wide = (half_x, half_y) if side % 2 == 0 else (half_y, half_x)
        depth, tall = 1.5, float(p.rng.uniform(1.2, 3.5))
        _building(b, p, (np.cos(yaw) * (near + depth), np.sin(yaw) * (near + depth)), (depth, wide + 0.5, tall), yaw)
        if p.rng.random() < 0.35:
            for place in np.arange(-wide + 0.8, wide, 1.8):
                x, y = np.cos(yaw) * (near - 1) - np.sin(yaw) * place, np.sin(yaw) * (near - 1) + np.cos(yaw) * place
                add_column(b, p, (x, y, 0.0), yaw, 2.6)
        b.focus.append((np.cos(yaw) * near * 0.9, np.sin(yaw) * near * 0.9, 1.3))
    _scatter(b, p, half_x - 1.2, half_y - 1.2, int(p.rng.integers(4, 10)), outdoor=True)
    b.bounds = ((-half_x + 0.6, -half_y + 0.6, 1.0), (half_x - 0.6, half_y - 0.6, 2.0))


_RECIPES: dict[str, Callable[[WorldBuilder, Palette], None]] = {
    "room": _room,
    "corridor": _corridor,
    "open": _open,
    "table_top": _table_top,
    "courtyard": _courtyard,
}


def draw_kind(generator: np.random.Generator) -> str:
    """A scene kind with the default shares."""
    return str(generator.choice(KINDS, p=_KIND_SHARES))


def build_world(generator: np.random.Generator, kind: str, *, split: Split = "train") -> World:
    """A random world of a kind: every draw comes from ``generator``; textures from the given split.

    Raises:
        ValueError: unknown kind.
    """
    if kind not in _RECIPES:
        raise ValueError(f"unknown scene kind {kind!r}; known: {', '.join(KINDS)}")
    builder = WorldBuilder(kind)
    _RECIPES[kind](builder, Palette(generator, split, float(generator.uniform(0.25, 0.75))))
    return builder.build()
