"""Rays against analytic primitives, vectorised over rays.

Every routine works in the primitive's local frame (metres, centred at its origin) and returns the distance ``t`` along the
ray ``origin + t * direction`` to the first surface in front of the origin, +inf where there is none. Directions need not be
unit: with directions of unit z in the camera frame, ``t`` is the z-depth.

Solids are convex sets (an interval of ``t``), or a convex set minus an infinite cylinder (arches and tubes), which is a
second interval. The standard slab and quadratic tests are written out on separate x, y, z arrays because short contiguous
arrays are what numpy is fast at.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: A float32 array; numpy's stubs widen float32 in mixed arithmetic, so the checker is told only that it is one.
Array = NDArray[Any]
Coordinate = Array | np.float32 | float

#: Hits nearer than this are ignored, so that a ray may start on a surface.
NEAR = np.float32(1e-4)
INFINITE = np.float32(np.inf)


class Shape(enum.IntEnum):
    """Primitive shapes; ``half`` are the half extents along local x, y, z."""

    BOX = 0
    ROOM = 1  # a box seen from inside
    ELLIPSOID = 2
    CYLINDER = 3  # axis z; radius shrinks linearly by `extra` (taper) from the middle to the top
    WEDGE = 4  # gable roof: base at -z, ridge along x at +z
    ARCH = 5  # box minus a cylinder along y of radius `extra` about the middle of the bottom edge
    TUBE = 6  # cylinder minus a concentric one of relative radius `extra`


def slab_interval(origin: Coordinate, direction: Array, half: float) -> tuple[Array, Array]:
    """Entry and exit of |x| <= half."""
    inverse = 1 / direction
    middle = -origin * inverse
    reach = np.abs(inverse) * np.float32(half)
    return middle - reach, middle + reach


def _box_interval(o: Sequence[Coordinate], d: Sequence[Array], half: Sequence[float]) -> tuple[Array, Array]:
    enter, leave = slab_interval(o[0], d[0], half[0])
    for axis in (1, 2):
        near, far = slab_interval(o[axis], d[axis], half[axis])
        enter, leave = np.maximum(enter, near), np.minimum(leave, far)
    return enter, leave


def _quadratic_interval(a: Array, b: Coordinate, c: Coordinate) -> tuple[Array, Array]:
    """Where a t^2 + 2 b t + c <= 0 for a > 0; an empty interval (inf, -inf) where there is no root."""
    disc = b * b - a * c
    root = np.sqrt(np.maximum(disc, 0))
    inverse = 1 / a
    missed = disc < 0
    enter = np.where(missed, INFINITE, (-b - root) * inverse)
    leave = np.where(missed, -INFINITE, (-b + root) * inverse)
    return enter, leave


def _round_interval(
    o: Sequence[Coordinate], d: Sequence[Array], radius: Sequence[float], axes: Sequence[int]
) -> tuple[Array, Array]:
    """Inside of the ellipse (two axes: infinite cylinder) or ellipsoid (three axes) with the given radii."""
    a: Coordinate = np.float32(0)
    b: Coordinate = np.float32(0)
    c: Coordinate = np.float32(-1)
    for axis in axes:
        inverse = np.float32(1 / radius[axis])
        direction, origin = d[axis] * inverse, o[axis] * inverse
        a = a + direction * direction
        b = b + direction * origin
        c = c + origin * origin
    return _quadratic_interval(np.asarray(a), b, c)


def _cone_interval(
    o: Sequence[Coordinate], d: Sequence[Array], half: Sequence[float], taper: float
) -> tuple[Array, Array]:
    """A truncated cone: radius ``1 - taper * z/half_z`` (relative), |taper| < 1, between the two caps."""
    enter_z, leave_z = slab_interval(o[2], d[2], half[2])
    inverse = [np.float32(1 / h) for h in half]
    dx, dy, dz = (d[k] * inverse[k] for k in range(3))
    ox, oy, oz = (o[k] * inverse[k] for k in range(3))
    slope = np.float32(taper)
    radius, growth = 1 - slope * oz, -slope * dz
    a = dx * dx + dy * dy - growth * growth
    a = np.where(np.abs(a) < 1e-9, np.float32(1e-9), a)
    b = dx * ox + dy * oy - growth * radius
    c = ox * ox + oy * oy - radius * radius
    disc = b * b - a * c
    root = np.sqrt(np.maximum(disc, 0))
    first, second = (-b - root) / a, (-b + root) / a
    low, high = np.minimum(first, second), np.maximum(first, second)
    # a > 0: inside between the roots. a < 0: the ray leaves one nappe and enters the other; only one of the two nappes
    # lies between the caps, so the part that overlaps the slab is the one wanted.
    on_first = low > enter_z
    enter = np.where(a > 0, np.maximum(low, enter_z), np.where(on_first, enter_z, np.maximum(high, enter_z)))
    leave = np.where(a > 0, np.minimum(high, leave_z), np.where(on_first, np.minimum(low, leave_z), leave_z))
    nothing = (disc < 0) & (a > 0)
    inside_all = (disc < 0) & (a < 0)
    enter = np.where(nothing, INFINITE, np.where(inside_all, enter_z, enter))
    leave = np.where(nothing, -INFINITE, np.where(inside_all, leave_z, leave))
    return enter, leave


def _wedge_interval(o: Sequence[Coordinate], d: Sequence[Array], half: Sequence[float]) -> tuple[Array, Array]:
    enter, leave = slab_interval(o[0], d[0], half[0])
    near, far = slab_interval(o[2], d[2], half[2])
    enter, leave = np.maximum(enter, near), np.minimum(leave, far)
    for side in (-1.0, 1.0):
        # Half space side * y / half_y + z / (2 half_z) <= 1/2.
        ny, nz = np.float32(side / half[1]), np.float32(0.5 / half[2])
        slope = d[1] * ny + d[2] * nz
        t = (np.float32(0.5) - o[1] * ny - o[2] * nz) / slope
        enter = np.where(slope < 0, np.maximum(enter, t), enter)
        leave = np.where(slope > 0, np.minimum(leave, t), leave)
    return enter, leave


def _first_of_interval(enter: Array, leave: Array) -> Array:
    return np.where((enter < leave) & (enter > NEAR), enter, INFINITE)


def _first_of_difference(solid: tuple[Array, Array], hole: tuple[Array, Array]) -> Array:
    """First surface of ``solid`` minus ``hole``: the solid's front, or the hole's far wall where the front is cut away."""
    start = np.maximum(solid[0], NEAR)
    in_hole = (start > hole[0]) & (start < hole[1])
    far_wall = np.where(hole[1] < solid[1], hole[1], INFINITE)
    front = np.where(solid[0] > NEAR, solid[0], INFINITE)
    return np.where(solid[0] < solid[1], np.where(in_hole, far_wall, front), INFINITE)


def first_hit(shape: int, half: Sequence[float], extra: float, o: Sequence[Coordinate], d: Sequence[Array]) -> Array:
    """Distance to the first surface of one primitive.

    Args:
        shape: a `Shape`.
        half: half extents along local x, y, z, metres.
        extra: taper, arch radius (metres) or relative bore, see `Shape`.
        o: ray origins in the local frame: three scalars, or three arrays that broadcast against ``d``.
        d: ray directions in the local frame, any length; no component may be exactly zero.
    """
    if shape == Shape.BOX:
        return _first_of_interval(*_box_interval(o, d, half))
    if shape == Shape.ROOM:
        leave = _box_interval(o, d, half)[1]
        return np.where(leave > NEAR, leave, INFINITE)
    if shape == Shape.ELLIPSOID:
        return _first_of_interval(*_round_interval(o, d, half, (0, 1, 2)))
    if shape == Shape.WEDGE:
        return _first_of_interval(*_wedge_interval(o, d, half))
    if shape == Shape.ARCH:
        low = [o[0], o[1], o[2] + np.float32(half[2])]
        hole = _round_interval(low, d, (extra, 1.0, extra), (0, 2))
        return _first_of_difference(_box_interval(o, d, half), hole)
    if shape == Shape.TUBE or not extra:
        side, caps = _round_interval(o, d, half, (0, 1)), slab_interval(o[2], d[2], half[2])
        solid = np.maximum(side[0], caps[0]), np.minimum(side[1], caps[1])
        if shape == Shape.TUBE:
            bore = (half[0] * extra, half[1] * extra)
            return _first_of_difference(solid, _round_interval(o, d, bore, (0, 1)))
        return _first_of_interval(*solid)
    return _first_of_interval(*_cone_interval(o, d, half, extra))
