"""A world: primitives, materials, lights and sky, and the builder that puts them together.

World frame: metres, z up. Materials take a 3-channel weight texture ``w`` and a colour matrix ``M``: linear albedo = M w, so
one texture serves many colours. A `World` is a set of flat arrays, ready for vectorised rendering.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sceneexpander.synthetic.intersect import Shape
from sceneexpander.synthetic.textures import TextureKey, packed_texture

Vector = Sequence[float] | NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """How a surface looks.

    Attributes:
        texture: family and variant of the weight texture.
        colours: three display-space (gamma 2.2) RGB colours, one per texture channel.
        repeats_per_m: texture repeats per metre; 0 stretches the texture once over the face ("fit").
        emission: radiance added, as a multiple of the albedo (windows, lamps).
        offset: texture offset in repeats.
        turned: swap u and v (planks and stripes along the other axis).
        detail: strength of added fine grain and large stains, which hide the repeat of the texture.
    """

    texture: TextureKey
    colours: tuple[tuple[float, float, float], ...]
    repeats_per_m: float = 1.0
    emission: float = 0.0
    offset: tuple[float, float] = (0.0, 0.0)
    turned: bool = False
    detail: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Light:
    """A sun (``position`` is the unit direction towards it) or a point light (``position`` in metres).

    ``colour`` is the linear irradiance at normal incidence: everywhere for a sun, at 1 m for a point light.
    ``radius`` is the size of the source for soft shadows: metres for a point light, radians for a sun.
    """

    position: tuple[float, float, float]
    colour: tuple[float, float, float]
    sun: bool = False
    radius: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Sky:
    """Background radiance (linear): a gradient from horizon to zenith with clouds."""

    horizon: tuple[float, float, float] = (0.75, 0.82, 0.9)
    zenith: tuple[float, float, float] = (0.25, 0.45, 0.8)
    clouds: float = 0.0
    texture: TextureKey = field(default_factory=lambda: TextureKey("clouds", 0))


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """Everything a renderer needs; arrays are float32 with one row per primitive unless said otherwise.

    Attributes:
        kind: the scene kind.
        shape: `Shape` per primitive.
        centre: (P,3) world position of the local origin.
        rotation: (P,3,3) ``world_from_local`` rotation.
        half: (P,3) half extents, metres.
        extra: (P,) taper, arch radius or bore.
        face_material: (P,6) material index of the faces -x, +x, -y, +y, -z, +z (round sides use the first).
        object_id: (P,) which object (a table, a wall, ...) the primitive belongs to.
        object_names: name per object id.
        casts_shadow: (P,) whether the primitive blocks light.
        texels: (3,texel) uint8 planes, all packed mip pyramids one after the other.
        texture_start: (M,) first texel of each material's pyramid.
        colour_matrix: (M,3,3) linear albedo from texture weights.
        repeats_per_m, emission, offset, turned, detail: per material.
        lights: light sources. ambient: (2,3) linear irradiance from below and from above.
        sky: background; None where the world is closed.
        sky_texels: packed pyramid of the cloud texture.
        bounds: (2,3) region in which cameras make sense.
        focus: (F,3) points worth looking at.
    """

    kind: str
    shape: NDArray[np.int64]
    centre: NDArray[np.float32]
    rotation: NDArray[np.float32]
    half: NDArray[np.float32]
    extra: NDArray[np.float32]
    face_material: NDArray[np.int64]
    object_id: NDArray[np.int64]
    object_names: tuple[str, ...]
    casts_shadow: NDArray[np.bool_]
    texels: NDArray[np.uint8]
    texture_start: NDArray[np.int64]
    colour_matrix: NDArray[np.float32]
    repeats_per_m: NDArray[np.float32]
    emission: NDArray[np.float32]
    offset: NDArray[np.float32]
    turned: NDArray[np.bool_]
    detail: NDArray[np.float32]
    lights: tuple[Light, ...]
    ambient: NDArray[np.float32]
    sky: Sky | None
    sky_texels: NDArray[np.uint8]
    bounds: NDArray[np.float32]
    focus: NDArray[np.float32]

    def clearance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Lower bound (metres) of the distance from each point (N,3) to the nearest solid; negative inside one."""
        best = np.full(len(points), np.inf)
        for index in range(len(self.shape)):
            local = (points - self.centre[index]) @ self.rotation[index]
            beyond = np.abs(local) - self.half[index]
            outside = np.linalg.norm(np.maximum(beyond, 0), axis=-1)
            distance = outside + np.minimum(beyond.max(-1), 0)
            if self.shape[index] == Shape.ROOM:
                distance = -beyond.max(-1)
            elif self.shape[index] == Shape.ARCH:
                from_axis = np.hypot(local[:, 0], local[:, 2] + self.half[index, 2])
                distance = np.maximum(distance, self.extra[index] - from_axis)
            best = np.minimum(best, distance)
        return best


def merge_worlds(world: World, other: World) -> World:
    """``world`` with the primitives and materials of ``other`` added; lights, sky and bounds are those of ``world``."""
    joined: dict[str, object] = {}
    for name in ("shape", "centre", "rotation", "half", "extra", "casts_shadow"):
        joined[name] = np.concatenate([getattr(world, name), getattr(other, name)])
    for name in ("colour_matrix", "repeats_per_m", "emission", "offset", "turned", "detail"):
        joined[name] = np.concatenate([getattr(world, name), getattr(other, name)])
    return replace(
        world,
        face_material=np.concatenate([world.face_material, other.face_material + len(world.texture_start)]),
        object_id=np.concatenate([world.object_id, other.object_id + len(world.object_names)]),
        object_names=world.object_names + other.object_names,
        texels=np.concatenate([world.texels, other.texels], axis=1),
        texture_start=np.concatenate([world.texture_start, other.texture_start + world.texels.shape[1]]),
        **joined,  # type: ignore[arg-type]
    )


def rotation_z(angle_rad: float) -> NDArray[np.float64]:
    """World rotation about the vertical."""
    c, s = float(np.cos(angle_rad)), float(np.sin(angle_rad))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


class WorldBuilder:
    """Collects primitives, materials and lights. Coordinates are relative to the current placement (`at`)."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.lights: list[Light] = []
        self.ambient: tuple[Vector, Vector] = ((0.2, 0.2, 0.2), (0.4, 0.4, 0.4))
        self.sky: Sky | None = None
        self.bounds: tuple[Vector, Vector] = ((-3.0, -3.0, 0.5), (3.0, 3.0, 2.0))
        self.focus: list[Vector] = []
        self._rows: list[tuple[int, Vector, NDArray[np.float64], Vector, float, list[int], int, bool]] = []
        self._materials: dict[Material, int] = {}
        self._objects: list[str] = []
        self._origin: NDArray[np.float64] = np.zeros(3)
        self._turn: NDArray[np.float64] = np.eye(3)

    def at(self, position: Vector, yaw_rad: float = 0.0, name: str = "object") -> WorldBuilder:
        """Start a new object whose parts are given relative to ``position`` and turned by ``yaw_rad``."""
        self._origin = np.asarray(position, dtype=np.float64)
        self._turn = rotation_z(yaw_rad)
        self._objects.append(name)
        return self

    def add(
        self,
        shape: Shape,
        centre: Vector,
        half: Vector,
        material: Material | Sequence[Material],
        *,
        rotation: NDArray[np.float64] | None = None,
        extra: float = 0.0,
        casts_shadow: bool = True,
    ) -> None:
        """Add one primitive to the current object; six materials give one per face."""
        if not self._objects:
            self.at((0.0, 0.0, 0.0), name="scene")
        faces = [material] * 6 if isinstance(material, Material) else list(material)
        indices = [self._materials.setdefault(face, len(self._materials)) for face in faces]
        position = self._origin + self._turn @ np.asarray(centre, dtype=np.float64)
        turn = self._turn if rotation is None else self._turn @ rotation
        size = np.maximum(np.asarray(half, dtype=np.float64), 1e-3)
        row = (int(shape), position, turn, size, extra, indices, len(self._objects) - 1, casts_shadow)
        self._rows.append(row)

    def build(self) -> World:
        """The finished world."""
        shape, centre, rotation, half, extra, faces, objects, shadow = zip(*self._rows, strict=True)
        materials = list(self._materials)
        starts: dict[TextureKey, int] = {}
        packs: list[NDArray[np.uint8]] = []
        for material in materials:
            if material.texture not in starts:
                starts[material.texture] = sum(len(pack) for pack in packs)
                packs.append(packed_texture(material.texture))
        colours = np.array([material.colours for material in materials], dtype=np.float64)
        return World(
            kind=self.kind,
            shape=np.array(shape, dtype=np.int64),
            centre=np.array(centre, dtype=np.float32),
            rotation=np.array(rotation, dtype=np.float32),
            half=np.array(half, dtype=np.float32),
            extra=np.array(extra, dtype=np.float32),
            face_material=np.array(faces, dtype=np.int64),
            object_id=np.array(objects, dtype=np.int64),
            object_names=tuple(self._objects),
            casts_shadow=np.array(shadow, dtype=np.bool_),
            texels=np.ascontiguousarray(np.concatenate(packs).T),
            texture_start=np.array([starts[material.texture] for material in materials], dtype=np.int64),
            colour_matrix=(colours**2.2).transpose(0, 2, 1).astype(np.float32),
            repeats_per_m=np.array([material.repeats_per_m for material in materials], dtype=np.float32),
            emission=np.array([material.emission for material in materials], dtype=np.float32),
            offset=np.array([material.offset for material in materials], dtype=np.float32),
            turned=np.array([material.turned for material in materials], dtype=np.bool_),
            detail=np.array([material.detail for material in materials], dtype=np.float32),
            lights=tuple(self.lights),
            ambient=np.array(self.ambient, dtype=np.float32),
            sky=self.sky,
            sky_texels=np.ascontiguousarray(packed_texture((self.sky or Sky()).texture).T),
            bounds=np.array(self.bounds, dtype=np.float32),
            focus=np.array(self.focus or [(0.0, 0.0, 1.0)], dtype=np.float32),
        )
