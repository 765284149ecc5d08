"""Primitives are hit where geometry says, and the screen-space tracer agrees with brute force."""

from __future__ import annotations

import numpy as np
import pytest

from sceneexpander.synthetic import KINDS, Material, Shape, TextureKey, WorldBuilder, build_world, render_world
from sceneexpander.synthetic.intersect import first_hit
from sceneexpander.synthetic.render import trace_camera, trace_rays
from sceneexpander.synthetic.textures import LEVEL_START, SIZE, packed_texture, weight_map
from sceneexpander.synthetic.trajectories import pose_from_angles, same_lens

HALF = (0.6, 0.4, 0.5)


def _inside(shape: Shape, extra: float, p: np.ndarray) -> np.ndarray:
    """Membership of points (N,3) in the solid, straight from its definition."""
    x, y, z = (p / HALF).T
    box = (np.abs(p) <= HALF).all(1)
    if shape in (Shape.BOX, Shape.ROOM):
        return box
    if shape == Shape.ELLIPSOID:
        return x**2 + y**2 + z**2 <= 1
    if shape == Shape.CYLINDER:
        return (x**2 + y**2 <= (1 - extra * z) ** 2) & (np.abs(z) <= 1)
    if shape == Shape.WEDGE:
        return box & (np.abs(y) <= (1 - z) / 2)
    if shape == Shape.ARCH:
        return box & (np.hypot(p[:, 0], p[:, 2] + HALF[2]) >= extra)
    return (np.abs(z) <= 1) & (x**2 + y**2 <= 1) & (x**2 + y**2 >= extra**2)


@pytest.mark.parametrize(
    ("shape", "extra"),
    [
        (Shape.BOX, 0.0), (Shape.ROOM, 0.0), (Shape.ELLIPSOID, 0.0), (Shape.CYLINDER, 0.0), (Shape.CYLINDER, 0.4),
        (Shape.CYLINDER, -0.6), (Shape.WEDGE, 0.0), (Shape.ARCH, 0.45), (Shape.TUBE, 0.7),
    ],
)  # fmt: skip
def test_first_hit_agrees_with_marching(shape: Shape, extra: float) -> None:
    rng = np.random.default_rng(3)
    count, step = 300, 0.002
    if shape == Shape.ROOM:
        origin = rng.uniform(-0.3, 0.3, (count, 3))
    else:
        origin = rng.normal(size=(count, 3))
        origin *= 2 / np.linalg.norm(origin, axis=1, keepdims=True)
    direction = rng.uniform(-0.5, 0.5, (count, 3)) - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    t = first_hit(shape, HALF, extra, list(origin.T.astype(np.float32)), list(direction.T.astype(np.float32)))
    distances = np.arange(step, 4, step)
    along = origin[:, None] + distances[:, None] * direction[:, None]
    solid = _inside(shape, extra, along.reshape(-1, 3)).reshape(count, -1)
    if shape == Shape.ROOM:
        solid = ~solid
    marched = np.where(solid.any(1), distances[solid.argmax(1)], np.inf)
    # Rays that clip less than a marching step of a corner may be missed by marching.
    hit = np.isfinite(t)
    assert (hit == np.isfinite(marched)).mean() > 0.98
    assert hit.mean() > 0.3
    both = hit & np.isfinite(marched)
    assert (np.abs(t[both] - marched[both]) < 2 * step).mean() > 0.98


@pytest.mark.parametrize("kind", KINDS)
def test_screen_rectangles_lose_nothing(kind: str) -> None:
    world = build_world(np.random.default_rng(2), kind)
    eye = world.bounds.mean(0).astype(np.float64)
    pose = pose_from_angles(eye, 0.7, -0.1, 0.05)
    depth, ids = trace_camera(world, same_lens(pose, 40.0, 48, 64))
    x, y = np.meshgrid((np.arange(64) + 0.5 - 32) / 40, (np.arange(48) + 0.5 - 24) / 40)
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) @ pose[:3, :3].T
    brute = trace_rays(world, np.broadcast_to(eye, rays.shape).astype(np.float32), rays.astype(np.float32))
    brute = brute.reshape(48, 64)
    assert (np.isfinite(depth) == (ids >= 0)).all()
    np.testing.assert_array_equal(np.isfinite(depth), np.isfinite(brute))
    solid = np.isfinite(depth)
    # Single precision in two orders of operations; outlines of round things are ill-conditioned.
    assert (np.abs(depth[solid] - brute[solid]) < 1e-3 * brute[solid]).mean() > 0.999


def test_shadow_falls_where_the_light_is_blocked() -> None:
    from sceneexpander.synthetic import Light

    white = Material(texture=TextureKey("plain", 0), colours=((1.0, 1.0, 1.0),) * 3)
    b = WorldBuilder("test")
    b.at((0, 0, 0), name="floor").add(Shape.BOX, (0, 0, -0.5), (20, 20, 0.5), white, casts_shadow=False)
    b.at((0, 0, 0), name="slab").add(Shape.BOX, (0, 0, 2), (0.5, 0.5, 0.05), white)
    b.lights.append(Light(position=(0.0, 0.0, 1.0), colour=(1.0, 1.0, 1.0), sun=True))
    b.ambient = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    pose = pose_from_angles(np.array([0.0, 0.0, 1.5]), 0.0, -np.pi / 2 + 1e-3, 0.0)
    picture = render_world(b.build(), same_lens(pose, 40.0, 48, 64), supersample=1.0)
    luminance = picture.radiance[0].mean(-1)
    # From 1.5 m the slab's shadow, 1 m wide, covers 40 / 1.5 = 27 pixels.
    assert luminance[16:32, 24:40].max() < 1e-6
    assert luminance[2:6].min() > 0.8
    np.testing.assert_allclose(picture.depth[0], 1.5, rtol=2e-2)
    assert set(np.unique(picture.object_id)) == {0}


def test_ambient_occlusion_darkens_corners() -> None:
    white = Material(texture=TextureKey("plain", 0), colours=((1.0, 1.0, 1.0),) * 3)
    b = WorldBuilder("test")
    b.at((0, 0, 0), name="floor").add(Shape.BOX, (0, 0, -0.5), (20, 20, 0.5), white)
    b.at((0, 0, 0), name="wall").add(Shape.BOX, (2.5, 0, 2), (0.5, 20, 2), white)
    pose = pose_from_angles(np.array([0.0, 0.0, 1.5]), 0.0, -0.6, 0.0)
    options = {"supersample": 1.0, "ambient_samples": 16}
    picture = render_world(b.build(), same_lens(pose, 40.0, 48, 64), **options)
    floor = picture.object_id[0] == 0
    # Bottom rows look at the floor near the camera; the topmost floor row touches the wall.
    rows = np.flatnonzero(floor[:, 32])
    near_wall, far = picture.radiance[0, rows[0] + 1, :].mean(), picture.radiance[0, rows[-1], :].mean()
    assert near_wall < 0.85 * far


def test_mip_levels_are_box_filters() -> None:
    key = TextureKey("brick", 1)
    packed, full = packed_texture(key).astype(np.float64) / 255, weight_map(key)
    assert full.shape == (SIZE, SIZE, 3)
    start = LEVEL_START[3]
    side = SIZE >> 3
    level = packed[start : start + side * side].reshape(side, side, 3)
    expected = full.reshape(side, 8, side, 8, 3).mean(axis=(1, 3))
    # 8-bit storage.
    np.testing.assert_allclose(level, expected, atol=0.5 / 255 + 1e-6)


def test_unknown_texture_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown texture family 'velvet'"):
        weight_map(TextureKey("velvet", 0))
