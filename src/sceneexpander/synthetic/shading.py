"""From hits to colour: local geometry of each hit, texture look-up with mip levels, light, sky."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneexpander.synthetic.intersect import Array, Shape
from sceneexpander.synthetic.textures import LEVEL_START, LEVELS, SIZE, TextureKey, packed_texture
from sceneexpander.synthetic.world import World


@dataclass(frozen=True, slots=True, kw_only=True)
class Surface:
    """What the rays of one image hit; arrays (H,W), vectors as three of them, world frame. Sky: depth inf, normal 0.

    ``u, v`` are face coordinates in metres (v downwards), ``size_u, size_v`` the face's size, ``face`` 0..5 as in
    `World.face_material`, ``edge`` the distance to the nearest other wall for room walls (+inf elsewhere).
    """

    depth: Array
    primitive: NDArray[np.int32]
    direction: list[Array]
    points: list[Array]
    normals: list[Array]
    face: NDArray[np.int64]
    u: Array
    v: Array
    size_u: Array
    size_v: Array
    edge: Array


def _face_geometry(
    local: list[Array], half: list[Array], room: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], list[Array], list[Array], Array]:
    """Box faces: (face, local normal, [u, v, size_u, size_v], distance to the second nearest pair of walls)."""
    relative = [np.abs(local[k] / half[k]) for k in range(3)]
    on_x = (relative[0] >= relative[1]) & (relative[0] >= relative[2])
    on_y = ~on_x & (relative[1] >= relative[2])
    on_z = ~on_x & ~on_y
    along = np.where(on_x, local[0], np.where(on_y, local[1], local[2]))
    sign = np.where(along < 0, np.float32(-1), np.float32(1))
    face = np.where(on_x, 0, np.where(on_y, 2, 4)) + (sign > 0)
    outward = np.where(room, -sign, sign)
    normal = [outward * on_x, outward * on_y, outward * on_z]
    # u runs to the right as seen from the visible side, v runs down (towards -z) on upright faces.
    u = np.where(on_x, local[1] * outward, np.where(on_y, -local[0] * outward, local[0]))
    v = np.where(on_z, -local[1], -local[2])
    size_u, size_v = np.where(on_x, half[1], half[0]) * 2, np.where(on_z, half[1], half[2]) * 2
    gaps = [np.where(on, np.inf, half[k] - np.abs(local[k])) for k, on in enumerate((on_x, on_y, on_z))]
    edge = np.where(room, np.minimum(np.minimum(gaps[0], gaps[1]), gaps[2]), np.inf).astype(np.float32)
    return face, normal, [u, v, size_u, size_v], edge


def _round_part(shape: int, p: list[Array], half: list[Array], extra: Array) -> tuple[list[Array], list[Array] | None]:
    """(local normal, [u, v, size_u, size_v] or None to keep the box mapping) of hits on one curved or sloped shape."""
    if shape == Shape.ELLIPSOID:
        normal = [p[k] / (half[k] * half[k]) for k in range(3)]
        u = np.arctan2(p[1], p[0]) * (half[0] + half[1]) / 2
        return normal, [u, -p[2], np.float32(np.pi) * (half[0] + half[1]), 2 * half[2]]
    if shape == Shape.WEDGE:
        height = np.abs(p[1]) / half[1] + p[2] / (2 * half[2])
        sloped = (height > 0.499) & (np.abs(p[0]) / half[0] < 0.99999) & (p[2] / half[2] > -0.99999)
        side = np.where(p[1] < 0, np.float32(-1), np.float32(1))
        end = ~sloped & (np.abs(p[0]) / half[0] > 0.9999)
        zero = np.zeros_like(p[0])
        flat = ~sloped & ~end
        normal = [
            np.where(end, np.sign(p[0]), zero),
            np.where(sloped, side / half[1], zero),
            np.where(sloped, 1 / (2 * half[2]), np.where(flat, np.float32(-1), zero)),
        ]
        slant = np.hypot(half[1], 2 * half[2])
        u = np.where(end, p[1], p[0])
        v = np.where(sloped, np.abs(p[1]) / half[1] * slant, -p[2])
        return normal, [u, v, 2 * half[0], np.where(sloped, slant, 2 * half[2])]
    if shape == Shape.ARCH:
        up = p[2] + half[2]
        in_arch = np.hypot(p[0], up) < extra * np.float32(1.0005)
        inside = [np.where(in_arch, -p[0], 0), np.zeros_like(up), np.where(in_arch, -up, 0)]
        u = np.arctan2(p[0], up) * extra
        return inside, [np.where(in_arch, p[1], np.nan), u, 2 * half[1], np.float32(np.pi) * extra]
    radial = np.sqrt((p[0] / half[0]) ** 2 + (p[1] / half[1]) ** 2)
    wall = 1 - extra * p[2] / half[2] if shape == Shape.CYLINDER else np.ones_like(radial)
    bore = (shape == Shape.TUBE) & (radial < (1 + extra) / 2) & (radial < extra * np.float32(1.001))
    cap = ~bore & (np.abs(p[2]) > half[2] * np.float32(0.99995)) & (radial < wall * np.float32(0.99995))
    out = np.where(bore, np.float32(-1), np.float32(1))
    rise = extra * wall / half[2] if shape == Shape.CYLINDER else np.zeros_like(radial)
    normal = [
        np.where(cap, 0, out * p[0] / half[0] ** 2),
        np.where(cap, 0, out * p[1] / half[1] ** 2),
        np.where(cap, np.sign(p[2]), rise),
    ]
    u = np.where(cap, p[0], np.arctan2(p[1], p[0]) * (half[0] + half[1]) / 2)
    turn = np.float32(np.pi) * (half[0] + half[1])
    return normal, [
        u,
        np.where(cap, -p[1], -p[2]),
        np.where(cap, 2 * half[0], turn),
        np.where(cap, 2 * half[1], 2 * half[2]),
    ]


def surface_at(
    world: World, pose: NDArray[np.float64], ray_x: Array, ray_y: Array, depth: Array, ids: NDArray[np.int32]
) -> Surface:
    """Geometry of the hits of one camera (``depth``, ``ids`` from `render.trace_camera`)."""
    rotation, eye = pose[:3, :3].astype(np.float32), pose[:3, 3].astype(np.float32)
    direction = [ray_x * rotation[k, 0] + (ray_y * rotation[k, 1] + rotation[k, 2])[:, None] for k in range(3)]
    hit = ids >= 0
    safe = np.where(hit, depth, 1)
    points = [direction[k] * safe + eye[k] for k in range(3)]
    index = np.maximum(ids, 0)
    relative = [points[k] - world.centre[:, k][index] for k in range(3)]
    turn = [[world.rotation[:, i, k][index] for k in range(3)] for i in range(3)]
    local = [relative[0] * turn[0][k] + relative[1] * turn[1][k] + relative[2] * turn[2][k] for k in range(3)]
    half = [world.half[:, k][index] for k in range(3)]
    shape = world.shape[index]
    face, normal, mapping, edge = _face_geometry(local, half, shape == Shape.ROOM)
    for kind in np.unique(world.shape):
        if kind in (Shape.BOX, Shape.ROOM):
            continue
        where = np.nonzero((shape == kind) & hit)
        if not len(where[0]):
            continue
        part, size = [p[where] for p in local], [h[where] for h in half]
        bent, coordinates = _round_part(int(kind), part, size, world.extra[index[where]])
        if kind == Shape.ARCH:
            curved = (bent[0] != 0) | (bent[2] != 0)
            where = (where[0][curved], where[1][curved])
            bent = [value[curved] for value in bent]
            coordinates = (
                None if coordinates is None else [np.broadcast_to(c, curved.shape)[curved] for c in coordinates]
            )
        for k in range(3):
            normal[k][where] = bent[k]
        if kind not in (Shape.WEDGE, Shape.ARCH):
            face[where] = np.where(np.abs(bent[2]) > np.hypot(bent[0], bent[1]) * 4, np.where(bent[2] > 0, 5, 4), 0)
        elif kind == Shape.WEDGE:
            face[where] = np.where(bent[0] != 0, 0, np.where(bent[2] > 0, 5, 4))
        if coordinates is not None:
            for target, value in zip(mapping, coordinates, strict=True):
                target[where] = value
    length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    scale = hit / np.maximum(length, np.float32(1e-12))
    upright = [(normal[0] * turn[i][0] + normal[1] * turn[i][1] + normal[2] * turn[i][2]) * scale for i in range(3)]
    facing = upright[0] * direction[0] + upright[1] * direction[1] + upright[2] * direction[2]
    flip = np.where(facing > 0, np.float32(-1), np.float32(1))
    u, v, size_u, size_v = mapping
    return Surface(
        depth=depth, primitive=ids, direction=direction, points=points, normals=[n * flip for n in upright],
        face=face, u=u, v=v, size_u=size_u, size_v=size_v, edge=edge,
    )  # fmt: skip


_SIDE = (SIZE >> np.arange(LEVELS)).astype(np.int64)
_SIDE_FLOAT = _SIDE.astype(np.float32)


def _bilinear(
    texels: NDArray[np.uint8], start: NDArray[np.int64], level: NDArray[np.int64], u: Array, v: Array
) -> Array:
    """Wrapped bilinear sample of one mip level per ray: (3,N) in 0..255."""
    side, extent = _SIDE[level], _SIDE_FLOAT[level]
    first = start + LEVEL_START[level]
    x, y = u * extent - np.float32(0.5), v * extent - np.float32(0.5)
    column, row = np.floor(x), np.floor(y)
    fx, fy = x - column, y - row
    mask = side - 1
    left, top = column.astype(np.int64) & mask, row.astype(np.int64) & mask
    right, bottom = (left + 1) & mask, first + ((top + 1) & mask) * side
    top = first + top * side
    corners = (top + left, top + right, bottom + left, bottom + right)
    shares = ((1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy)
    result = np.zeros((3, len(u)), dtype=np.float32)
    for corner, share in zip(corners, shares, strict=True):
        for k in range(3):
            result[k] += np.take(texels[k], corner) * share
    return result


def sample_texture(
    texels: NDArray[np.uint8], start: NDArray[np.int64], u: Array, v: Array, texels_per_ray: Array
) -> Array:
    """Trilinear weights (3,N) in [0,1]: ``u, v`` in repeats, ``texels_per_ray`` the footprint in finest texels."""
    level = np.clip(np.log2(np.maximum(texels_per_ray, np.float32(1e-6))), 0, LEVELS - 1.001).astype(np.float32)
    base = level.astype(np.int64)
    blend = level - base.astype(np.float32)
    result = _bilinear(texels, start, base, u, v)
    # Magnified textures need one level only; a blend under 2 % cannot be seen.
    coarse = np.flatnonzero(blend > 0.02)
    if len(coarse):
        weight = blend[coarse]
        next_level = _bilinear(texels, start[coarse], base[coarse] + 1, u[coarse], v[coarse])
        result[:, coarse] += (next_level - result[:, coarse]) * weight
    return result * np.float32(1 / 255)


_DETAIL = TextureKey("concrete", 0)
#: Repeats of the detail texture per repeat of the surface's own: fine grain, and stains that hide the repetition.
_DETAIL_RATES = (5.3, 0.23)


def _detail(strength: Array, u: Array, v: Array, texels: Array) -> Array:
    """Factor on the albedo, mean about 1: grain and stains at scales the surface's own texture does not have."""
    planes = np.ascontiguousarray(packed_texture(_DETAIL).T)
    start = np.zeros(len(u), dtype=np.int64)
    factor = np.ones(len(u), dtype=np.float32)
    for rate in _DETAIL_RATES:
        weights = sample_texture(planes, start, u * np.float32(rate), v * np.float32(rate), texels * np.float32(rate))
        factor *= 1 + strength * (weights[0] / np.float32(0.78) - 1)
    return factor


def _sky_radiance(world: World, direction: list[Array]) -> Array:
    """(N,3) background; grey where a closed world has a gap."""
    length = np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    up = direction[2] / length
    if world.sky is None:
        return np.full((len(up), 3), 0.3, dtype=np.float32)
    height = np.clip(up, 0, 1)[:, None] ** np.float32(0.6)
    colour = np.array(world.sky.horizon, np.float32) * (1 - height) + np.array(world.sky.zenith, np.float32) * height
    if world.sky.clouds:
        flat = np.maximum(up, np.float32(0.02)) + np.float32(0.15)
        u, v = direction[0] / length / flat * np.float32(0.2), direction[1] / length / flat * np.float32(0.2)
        zero = np.zeros(len(u), dtype=np.int64)
        cover = sample_texture(world.sky_texels, zero, u, v, np.full(len(u), 2.0, np.float32))[1][:, None]
        cover = cover * np.float32(world.sky.clouds) * np.clip(up * 6, 0, 1)[:, None]
        colour = colour * (1 - cover) + np.float32(0.95) * cover
    return colour.astype(np.float32)


def shade(world: World, surface: Surface, light: list[Array], open_share: Array | None, focal_px: float) -> Array:
    """(H,W,3) linear radiance: albedo x (direct + ambient light) + emission, sky where nothing is hit.

    Args:
        light: direct irradiance per channel. open_share: ambient visibility, or None for the closed form in room corners.
        focal_px: of the image that ``surface`` samples; sets the texture footprint.
    """
    flat_primitive = surface.primitive.ravel()
    hit = np.flatnonzero(flat_primitive >= 0)
    complete = len(hit) == flat_primitive.size

    def at_hits(values: Array) -> Array:
        return values.ravel() if complete else values.ravel()[hit]

    primitive = at_hits(surface.primitive)
    material = world.face_material[primitive, at_hits(surface.face)]
    u, v = at_hits(surface.u), at_hits(surface.v)
    rate = world.repeats_per_m[material]
    fit = rate == 0
    middle = np.where(fit, np.float32(0.5), np.float32(0))
    rate_u = np.where(fit, 1 / at_hits(surface.size_u), rate)
    rate_v = np.where(fit, 1 / at_hits(surface.size_v), rate)
    u, v = u * rate_u + middle, v * rate_v + middle
    turned = world.turned[material]
    u, v = np.where(turned, v, u) + world.offset[:, 0][material], np.where(turned, u, v) + world.offset[:, 1][material]
    direction = [at_hits(d) for d in surface.direction]
    normal = [at_hits(n) for n in surface.normals]
    length = np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    cosine = -(normal[0] * direction[0] + normal[1] * direction[1] + normal[2] * direction[2]) / length
    footprint = at_hits(surface.depth) / np.float32(focal_px) / np.sqrt(np.maximum(cosine, np.float32(0.02)))
    texels = footprint * np.maximum(rate_u, rate_v) * np.float32(SIZE)
    weights = sample_texture(world.texels, world.texture_start[material], u, v, texels)
    if world.detail.any():
        weights = weights * _detail(world.detail[material], u, v, texels)
    up = (normal[2] + 1) * np.float32(0.5)
    if open_share is None:
        visible = 1 - np.float32(0.3) * np.exp(at_hits(surface.edge) * np.float32(-1 / 0.35))
    else:
        visible = at_hits(open_share)
    emission = world.emission[material]
    result = np.empty((flat_primitive.size, 3), dtype=np.float32)
    for k in range(3):
        columns = [np.ascontiguousarray(world.colour_matrix[:, k, j])[material] for j in range(3)]
        albedo = weights[0] * columns[0] + weights[1] * columns[1] + weights[2] * columns[2]
        ambient = (world.ambient[0, k] + (world.ambient[1, k] - world.ambient[0, k]) * up) * visible
        result[hit, k] = albedo * (at_hits(light[k]) + ambient + emission)
    if not complete:
        empty = np.flatnonzero(flat_primitive < 0)
        result[empty] = _sky_radiance(world, [d.ravel()[empty] for d in surface.direction])
    return result.reshape(*surface.primitive.shape, 3)
