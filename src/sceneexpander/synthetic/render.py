"""Rendering of a `World`: exact depth, normals and ids at pixel centres, and anti-aliased linear radiance.

Primary rays are traced per primitive on the screen rectangle that its projected bounding box covers; shadow rays per
primitive on the 8x8 tiles whose beams to the light come near its bounding sphere. Everything is vectorised over rays.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.synthetic.intersect import Array, Shape, first_hit
from sceneexpander.synthetic.shading import Surface, shade, surface_at
from sceneexpander.synthetic.world import World

_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
_EDGES = np.array([(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 2])
_NEAR_PLANE = 0.02
_TINY = np.float32(1e-9)  # keeps direction components away from an exact zero
TILE = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderedViews:
    """Ground truth and pictures of V views of a world; world frame and metres are the world's own.

    Attributes:
        radiance: (V,H,W,3) float32 linear radiance, box-filtered over the pixel.
        depth: (V,H,W) float32 z-depth at pixel centres, +inf for sky.
        normals: (V,H,W,3) float32 camera frame, unit, facing the camera; 0 for sky.
        object_id: (V,H,W) int32 index into ``world.object_names``, -1 for sky.
        primitive_id: (V,H,W) int32 index of the primitive, -1 for sky.
    """

    radiance: NDArray[np.float32]
    depth: NDArray[np.float32]
    normals: NDArray[np.float32]
    object_id: NDArray[np.int32]
    primitive_id: NDArray[np.int32]


def cameras_at(
    world_from_cam: NDArray[np.float64], intrinsics_px: NDArray[np.float64], height: int, width: int
) -> Cameras:
    """Cameras (double precision) of (4,4) or (V,4,4) poses and of (3,3) intrinsics that all share, or (V,3,3)."""
    poses = np.array(world_from_cam, np.float64).reshape(-1, 4, 4)
    lenses = np.array(np.broadcast_to(intrinsics_px, (len(poses), 3, 3)), np.float64)
    return Cameras(torch.from_numpy(poses), torch.from_numpy(lenses), height, width)


def pose_and_intrinsics(camera: Cameras) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """((4,4), (3,3)) of one camera, as arrays in double precision."""
    (pose,), (intrinsics,) = (values.cpu().double().numpy() for values in (camera.world_from_cam, camera.intrinsics_px))
    return pose, intrinsics


def _screen_rectangles(world: World, camera: Cameras) -> NDArray[np.int64]:
    """(P,4) pixel rectangle x0, x1, y0, y1 (half open) that covers each primitive; empty where it is behind the camera."""
    world_from_cam, intrinsics = pose_and_intrinsics(camera)
    height, width = camera.height, camera.width
    rotation = world.rotation.astype(np.float64)
    corners = np.einsum("pij,pcj->pci", rotation, _CORNERS * world.half[:, None]) + world.centre[:, None]
    cam = (corners - world_from_cam[:3, 3]) @ world_from_cam[:3, :3]
    first, second = cam[:, _EDGES[:, 0]], cam[:, _EDGES[:, 1]]
    step = second[..., 2] - first[..., 2]
    crossing: NDArray[np.bool_] = np.asarray((first[..., 2] - _NEAR_PLANE) * (second[..., 2] - _NEAR_PLANE) < 0)
    fraction = np.where(crossing, (_NEAR_PLANE - first[..., 2]) / np.where(crossing, step, 1), 0)
    clipped = first + fraction[..., None] * (second - first)
    points = np.concatenate([cam, clipped], axis=1)
    usable = np.concatenate([cam[..., 2] >= _NEAR_PLANE, crossing], axis=1)
    z = np.where(usable, np.maximum(points[..., 2], _NEAR_PLANE), 1)
    x = points[..., 0] / z * intrinsics[0, 0] + intrinsics[0, 2]
    y = points[..., 1] / z * intrinsics[1, 1] + intrinsics[1, 2]
    low_x, low_y = (np.where(usable, v, np.inf).min(1) for v in (x, y))
    high_x, high_y = (np.where(usable, v, -np.inf).max(1) for v in (x, y))
    rectangle = np.stack([low_x - 1, high_x + 1, low_y - 1, high_y + 1], axis=1)
    rectangle = np.where(usable.any(axis=1, keepdims=True), rectangle, 0)
    limit = np.array([width, width, height, height])
    result = np.clip(np.array([0, 1, 0, 1]) + np.floor(np.clip(rectangle, -1e6, 1e6)), 0, limit).astype(np.int64)
    result[world.shape == Shape.ROOM] = [0, width, 0, height]
    return result


def _ray_grid(intrinsics: NDArray[np.float64], height: int, width: int) -> tuple[Array, Array]:
    x = ((np.arange(width) + 0.5 - intrinsics[0, 2]) / intrinsics[0, 0]).astype(np.float32)
    y = ((np.arange(height) + 0.5 - intrinsics[1, 2]) / intrinsics[1, 1]).astype(np.float32)
    return x, y


def trace_camera(world: World, camera: Cameras) -> tuple[Array, NDArray[np.int32]]:
    """(depth, primitive id) of every pixel centre of one camera: (H,W) each; +inf and -1 where nothing is hit."""
    world_from_cam, intrinsics = pose_and_intrinsics(camera)
    height, width = camera.height, camera.width
    depth = np.full((height, width), np.inf, dtype=np.float32)
    ids = np.full((height, width), -1, dtype=np.int32)
    ray_x, ray_y = _ray_grid(intrinsics, height, width)
    rectangles = _screen_rectangles(world, camera)
    local_from_cam = np.einsum("pji,jk->pik", world.rotation.astype(np.float64), world_from_cam[:3, :3])
    offset = world_from_cam[:3, 3] - world.centre
    origins = np.einsum("pji,pj->pi", world.rotation.astype(np.float64), offset).astype(np.float32)
    axes = local_from_cam.astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for index in range(len(world.shape)):
            x0, x1, y0, y1 = rectangles[index]
            if x0 >= x1 or y0 >= y1:
                continue
            part = (slice(y0, y1), slice(x0, x1))
            a = axes[index]
            columns, rows = ray_x[x0:x1], ray_y[y0:y1]
            d = [columns * a[k, 0] + (rows * a[k, 1] + (a[k, 2] + _TINY))[:, None] for k in range(3)]
            t = first_hit(int(world.shape[index]), world.half[index], float(world.extra[index]), origins[index], d)
            closer = t < depth[part]
            np.copyto(depth[part], t, where=closer)
            ids[part][closer] = index
    return depth, ids


def trace_rays(world: World, origin: Array, direction: Array) -> Array:
    """Distance along each ray (N,3), (N,3) to the first surface: (N,), +inf where there is none. No culling."""
    best = np.full(len(origin), np.inf, dtype=np.float32)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for index in range(len(world.shape)):
            turn = world.rotation[index]
            o = ((origin - world.centre[index]) @ turn).T
            d = (direction @ turn).T + _TINY
            t = first_hit(int(world.shape[index]), world.half[index], float(world.extra[index]), o, d)
            np.minimum(best, t, out=best)
    return best


def _tiles(array: Array) -> Array:
    """(H,W) -> (tile, 64); H and W are multiples of the tile side."""
    height, width = array.shape
    return np.ascontiguousarray(
        array.reshape(height // TILE, TILE, width // TILE, TILE).swapaxes(1, 2).reshape(-1, TILE * TILE)
    )


def _untile(array: Array, height: int, width: int) -> Array:
    return array.reshape(height // TILE, width // TILE, TILE, TILE).swapaxes(1, 2).reshape(height, width)


def _near_beam(
    world: World, blockers: NDArray[np.int64], middle: Array, reach: Array, light_at: Array, sun: bool
) -> NDArray[np.bool_]:
    """(tile, blocker): does the blocker's bounding sphere come near the tile's beam towards the light?"""
    centre = world.centre[blockers]
    radius = np.sqrt((world.half[blockers] ** 2).sum(-1))
    towards = np.broadcast_to(light_at, middle.shape) if sun else light_at - middle
    squared = np.einsum("tk,tk->t", towards, towards)[:, None]
    to_centre = towards @ centre.T - np.einsum("tk,tk->t", towards, middle)[:, None]
    along = to_centre / squared
    along = np.maximum(along, 0) if sun else np.clip(along, 0, 1)
    # |c - m - along t|^2 with everything quadratic as matrix products; the margin covers single-precision cancellation.
    distance = np.einsum("tk,tk->t", middle, middle)[:, None] - 2 * (middle @ centre.T) + (centre**2).sum(-1)
    distance += along * (along * squared - 2 * to_centre)
    return distance < (radius + reach[:, None]) ** 2 + 1e-2


def _shadow(
    world: World, surface: Surface, light_at: NDArray[np.float32], sun: bool, facing: NDArray[np.bool_]
) -> Array:
    """(H,W) visibility (0 or 1) of a light: ``light_at`` is its position, or for a sun the unit direction towards it."""
    height, width = surface.depth.shape
    # Start a little off the surface, on the side the camera sees.
    points = [_tiles(surface.points[k] + np.float32(2e-3) * surface.normals[k]) for k in range(3)]
    active = _tiles(facing)
    lit = np.ones(active.shape, dtype=np.bool_)
    rows_used = active.any(1)
    low = np.stack([np.where(active, p, np.inf).min(1) for p in points], -1)[rows_used]
    high = np.stack([np.where(active, p, -np.inf).max(1) for p in points], -1)[rows_used]
    used = np.nonzero(rows_used)[0]
    middle, reach = (low + high) / 2, np.sqrt(np.einsum("tk,tk->t", high - low, high - low)) / 2
    blockers = np.nonzero(world.casts_shadow)[0]
    near_beam = _near_beam(world, blockers, middle, reach, light_at, sun)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for column, index in enumerate(blockers):
            rows = used[near_beam[:, column]]
            if not len(rows):
                continue
            turn, centre = world.rotation[index], world.centre[index]
            p = [points[k][rows] - centre[k] for k in range(3)]
            o = [p[0] * turn[0, k] + p[1] * turn[1, k] + p[2] * turn[2, k] for k in range(3)]
            target = (light_at if sun else light_at - centre) @ turn + _TINY
            d = [np.full_like(o[k], target[k]) if sun else target[k] - o[k] for k in range(3)]
            t = first_hit(int(world.shape[index]), world.half[index], float(world.extra[index]), o, d)
            lit[rows] &= ~(t < (np.inf if sun else 1))
    return _untile(lit, height, width).astype(np.float32)


def _jittered(light_at: NDArray[np.float32], radius: float, samples: int, rng: np.random.Generator) -> list[Array]:
    if samples <= 1 or not radius:
        return [light_at]
    return [light_at + np.float32(radius) * rng.normal(0, 0.5, 3).astype(np.float32) for _ in range(samples)]


def direct_light(world: World, surface: Surface, samples: int, rng: np.random.Generator) -> list[Array]:
    """Linear irradiance from all lights, shadows included: three (H,W) arrays."""
    shape = surface.depth.shape
    total = [np.zeros(shape, dtype=np.float32) for _ in range(3)]
    for light in world.lights:
        positions = _jittered(np.array(light.position, dtype=np.float32), light.radius, samples, rng)
        for position in positions:
            if light.sun:
                to = [np.float32(position[k] / np.linalg.norm(position)) for k in range(3)]
                strength = np.float32(1)
            else:
                to = [position[k] - surface.points[k] for k in range(3)]
                squared = to[0] * to[0] + to[1] * to[1] + to[2] * to[2]
                strength = 1 / ((squared + np.float32(0.3)) * np.sqrt(squared + np.float32(1e-6)))
            cosine = surface.normals[0] * to[0] + surface.normals[1] * to[1] + surface.normals[2] * to[2]
            facing = (cosine > 0) & np.isfinite(surface.depth)
            if not facing.any():
                continue
            target = np.array(to, dtype=np.float32) if light.sun else position
            received = _shadow(world, surface, target, light.sun, facing) * np.maximum(cosine, 0) * strength
            for k in range(3):
                total[k] += received * np.float32(light.colour[k] / len(positions))
    return total


def _open_fraction(world: World, surface: Surface, samples: int, reach: float, rng: np.random.Generator) -> Array:
    """(H,W) mean over cosine-distributed rays of min(distance / reach, 1), smoothed within surfaces."""
    hit = np.isfinite(surface.depth)
    height, width = hit.shape
    normals = [_tiles(n) for n in surface.normals]
    points = [_tiles(surface.points[k]) + np.float32(2e-3) * normals[k] for k in range(3)]
    active = _tiles(hit)
    low = np.stack([np.where(active, p, np.inf).min(1) for p in points], -1)
    high = np.stack([np.where(active, p, -np.inf).max(1) for p in points], -1)
    used = np.flatnonzero(active.any(1))
    middle = (low[used] + high[used]) / 2
    spread = np.linalg.norm(high[used] - low[used], axis=-1) / 2 + reach
    directions, nearest = [], []
    for _ in range(samples):
        bounce = [rng.standard_normal(points[0].shape, dtype=np.float32) for _ in range(3)]
        length = np.sqrt(bounce[0] ** 2 + bounce[1] ** 2 + bounce[2] ** 2)
        directions.append([normals[k] + np.float32(0.999) * bounce[k] / length + _TINY for k in range(3)])
        nearest.append(np.full(points[0].shape, np.inf, dtype=np.float32))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for index in range(len(world.shape)):
            turn, centre, half = world.rotation[index], world.centre[index], world.half[index]
            # Distance from the oriented box, which for walls and floors is much tighter than from a bounding sphere.
            outside = np.maximum(np.abs((middle - centre) @ turn) - half, 0)
            rows = used[(outside * outside).sum(-1) < spread * spread]
            if not len(rows):
                continue
            p = [points[k][rows] - centre[k] for k in range(3)]
            o = [p[0] * turn[0, k] + p[1] * turn[1, k] + p[2] * turn[2, k] for k in range(3)]
            for direction, best in zip(directions, nearest, strict=True):
                w = [direction[k][rows] for k in range(3)]
                d = [w[0] * turn[0, k] + w[1] * turn[1, k] + w[2] * turn[2, k] for k in range(3)]
                t = first_hit(int(world.shape[index]), half, float(world.extra[index]), o, d)
                best[rows] = np.minimum(best[rows], t)
    share = np.zeros(points[0].shape, dtype=np.float32)
    for direction, best in zip(directions, nearest, strict=True):
        length = np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
        share += np.minimum(best * length / np.float32(reach), 1) / samples
    return _smooth_within_surfaces(_untile(share, height, width), surface, 3)


def _smooth_within_surfaces(values: Array, surface: Surface, radius: int) -> Array:
    """Mean over the (2 radius + 1)^2 neighbours of the same primitive with a similar normal."""
    total, count = np.zeros_like(values), np.zeros_like(values)
    height, width = values.shape
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            here = (slice(max(dy, 0), height + min(dy, 0)), slice(max(dx, 0), width + min(dx, 0)))
            there = (slice(max(-dy, 0), height + min(-dy, 0)), slice(max(-dx, 0), width + min(-dx, 0)))
            cosine = sum(n[here] * n[there] for n in surface.normals)
            weight = (surface.primitive[here] == surface.primitive[there]) & (cosine > 0.9)
            total[here] += weight * values[there]
            count[here] += weight
    return np.where(count > 0, total / np.maximum(count, 1), values)


def _surface_seen(world: World, camera: Cameras) -> Surface:
    """What every pixel centre of one camera shows."""
    pose, intrinsics = pose_and_intrinsics(camera)
    return surface_at(world, pose, *_ray_grid(intrinsics, camera.height, camera.width), *trace_camera(world, camera))


def _in_tiles(side: float) -> int:
    return max(TILE, round(side / TILE) * TILE)


def render_world(
    world: World,
    cameras: Cameras,
    *,
    supersample: float = 1.6,
    light_samples: int = 1,
    ambient_samples: int = 0,
    ambient_reach: float = 1.5,
    seed: int = 0,
) -> RenderedViews:
    """Render a picture of each camera.

    Args:
        world: what to render.
        cameras: in the world's frame.
        supersample: colour samples per pixel side (rounded so that tiles fit).
        light_samples: shadow samples per light and colour sample, for lights with a radius.
        ambient_samples: ambient-occlusion rays per pixel; 0 uses a closed form for room corners only.
        ambient_reach: distance (metres) up to which things occlude the ambient light.
        seed: of the light and occlusion samples.
    """
    height, width = cameras.height, cameras.width
    cameras = cameras.double()
    out: list[tuple[Array, Array, Array, NDArray[np.int32]]] = []
    for view in range(len(cameras)):
        rng = np.random.default_rng([seed, view])
        camera = cameras[view]
        exact = _surface_seen(world, camera)
        normals = np.stack(exact.normals, -1) @ pose_and_intrinsics(camera)[0][:3, :3].astype(np.float32)
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), np.float32(1e-9))
        fine = camera.resized(_in_tiles(height * supersample), _in_tiles(width * supersample))
        surface = _surface_seen(world, fine)
        light = direct_light(world, surface, light_samples, rng)
        open_share = None
        if ambient_samples:
            # Occlusion is smooth: one evaluation per pixel is enough, also when colour is sampled more finely.
            even = _surface_seen(world, camera.resized(_in_tiles(height), _in_tiles(width)))
            open_share = _open_fraction(world, even, ambient_samples, ambient_reach, rng)
            open_share = np.asarray(cv2.resize(open_share, (fine.width, fine.height), interpolation=cv2.INTER_LINEAR))
        radiance = shade(world, surface, light, open_share, float(fine.intrinsics_px[0, 0, 0]))
        # Clip before filtering: one very bright sample must not swallow a pixel.
        radiance = cv2.resize(np.minimum(radiance, 4), (width, height), interpolation=cv2.INTER_AREA)
        out.append((radiance, exact.depth, normals, exact.primitive))
    primitive_id = np.stack([item[3] for item in out])
    object_id = np.where(primitive_id >= 0, world.object_id[primitive_id], -1).astype(np.int32)
    return RenderedViews(
        radiance=np.stack([item[0] for item in out]),
        depth=np.stack([item[1] for item in out]),
        normals=np.stack([item[2] for item in out]),
        object_id=object_id,
        primitive_id=primitive_id,
    )
