"""Camera paths: through given cameras, around a point, about one camera. Pure maths, in float64 inside.

Poses are ``world_from_cam``, OpenCV axes. Paths are sampled once per video frame.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.rigid import (
    look_at,
    quat_wxyz_from_rotation,
    rigid_from_parts,
    rotation_angle_deg,
    rotation_from_quat_wxyz,
    slerp_wxyz,
)

TURN_AS_LONG_AS_TYPICAL_STEP_DEG = 30.0  # a turn by this takes as long as moving by the median distance of two keys
SHORTEST_SHARE = 0.1  # of the mean time between keys, that even coinciding keys get
MOST_EXACT = 10  # cameras whose shortest path is searched exhaustively
GAIN_WORTH_TAKING = 1e-9  # of the path length, ends the improvement of tours in finitely many steps


def navigation(cameras: Cameras, frames: int, order: Sequence[int]) -> Cameras:
    """A flight through cameras, in the given order (an index may come more than once), starting and ending at rest.

    Positions follow a centripetal Catmull-Rom spline (no loops or cusps between keys) and rotations a spherical cubic Bezier
    spline; both have continuous velocity in frame time, focal lengths as well. Keys are met exactly, each at a frame of its own,
    if there are at least as many frames as keys. Coinciding keys are a short stop.

    Raises:
        ValueError: no keys, an index out of range, fewer than one frame, non-finite cameras.
    """
    keys = list(order)
    if not keys or frames < 1:
        raise ValueError(f"navigation needs at least one key and one frame, got {len(keys)} and {frames}")
    if not all(0 <= key < len(cameras) for key in keys):
        raise ValueError(f"navigation order {keys} has an index outside 0..{len(cameras) - 1}")
    met = cameras[keys]
    poses, intrinsics = met.world_from_cam.detach().double(), met.intrinsics_px.detach().double()
    if not bool(torch.isfinite(poses).all() and torch.isfinite(intrinsics).all()):
        raise ValueError("navigation was given cameras that are not finite")
    if len(keys) == 1:
        return met[[0] * frames]

    times = _key_times(poses, frames)
    at = torch.arange(frames, dtype=torch.float64, device=poses.device)
    if frames == 1:
        at = at + times[0]
    segment = (torch.searchsorted(times, at, right=True) - 1).clamp(0, len(keys) - 2)
    length = (times[1:] - times[:-1])[segment]
    fraction = ((at - times[segment]) / length).clamp(0, 1)

    position = _hermite(poses[:, :3, 3], times, segment, fraction)
    rotation = rotation_from_quat_wxyz(_spherical_bezier(poses[:, :3, :3], times, segment, fraction))
    lens = torch.stack(
        [intrinsics[:, 0, 0].log(), intrinsics[:, 1, 1].log(), intrinsics[:, 0, 2], intrinsics[:, 1, 2]], -1
    )
    fx, fy, cx, cy = _hermite(lens, times, segment, fraction).unbind(-1)
    path_k = torch.zeros(frames, 3, 3, dtype=torch.float64, device=poses.device)
    path_k[:, 0, 0], path_k[:, 1, 1], path_k[:, 0, 2], path_k[:, 1, 2] = fx.exp(), fy.exp(), cx, cy
    path_k[:, 2, 2] = 1
    path = rigid_from_parts(rotation, position).to(cameras.world_from_cam)
    return Cameras(path, path_k.to(cameras.intrinsics_px), cameras.height, cameras.width)


def shortest_path_order(world_from_cam: Float[Tensor, "camera 4 4"], *, last: int | None = None) -> list[int]:
    """All cameras in the order of least travel between their centres, not closed; ``last`` ends it if given. Deterministic.

    Exact up to 10 cameras (dynamic programme of Held and Karp). Beyond that nearest-neighbour paths from every start, each improved
    by reversing runs until no reversal helps.
    """
    centres = world_from_cam[:, :3, 3].detach().double()
    count = len(centres)
    distance = torch.cdist(centres, centres, compute_mode="donot_use_mm_for_euclid_dist").tolist()
    if last is not None and not 0 <= last < count:
        raise ValueError(f"last = {last} is outside 0..{count - 1}")
    starts = range(count) if last is None else [last]
    if count <= MOST_EXACT:
        return _best_path(starts, distance)[::-1]
    best: list[int] = []
    best_length = math.inf
    for start in starts:
        path = _improve(_nearest_neighbours(start, distance), distance)
        length = sum(distance[a][b] for a, b in itertools.pairwise(path))
        if length < best_length * (1 - GAIN_WORTH_TAKING):
            best, best_length = path, length
    return best[::-1]


def orbit(
    world_from_cam: Float[Tensor, "4 4"],
    target: Float[Tensor, "3"],
    frames: int,
    *,
    up: Float[Tensor, "3"],
    turn_rad: float = 2 * math.pi,
) -> Float[Tensor, "frame 4 4"]:
    """One camera carried around the axis ``up`` through ``target``; the first frame is the camera itself.

    A whole turn closes without repeating its first pose; less than one is a swing of half of it to either side and back.
    """
    if frames < 1 or not 0 < turn_rad <= 2 * math.pi or not bool(up.any()):
        raise ValueError(f"orbit with {frames} frames, a turn of {turn_rad} rad, up {up.tolist()}")
    share = torch.arange(frames, dtype=torch.float64, device=up.device) / frames
    angle = 2 * math.pi * share
    if turn_rad < 2 * math.pi:
        angle = turn_rad / 2 * torch.sin(angle)
    turn = _rotation(torch.nn.functional.normalize(up.double(), dim=0) * angle[:, None])
    centre = target.double() + turn @ (world_from_cam[:3, 3].double() - target.double())
    return rigid_from_parts(turn @ world_from_cam[:3, :3].double(), centre).to(world_from_cam)


def spiral(
    world_from_cam: Float[Tensor, "4 4"], focus_depth: float, radius: float, frames: int, *, turns: float = 2.0
) -> Float[Tensor, "frame 4 4"]:
    """A spiral about one camera that keeps looking at the point ``focus_depth`` in front of it; begins and ends at the camera.

    ``radius`` is the widest distance from the camera, scene units; the path also moves forward and back by half of it.
    """
    if focus_depth <= 0 or radius < 0 or frames < 1:
        raise ValueError(f"spiral with focus depth {focus_depth}, radius {radius}, {frames} frames")
    share = torch.linspace(0, 1, frames, dtype=world_from_cam.dtype, device=world_from_cam.device)
    angle = 2 * math.pi * turns * share
    wide = radius * torch.sin(math.pi * share)
    offset = torch.stack([wide * torch.cos(angle), wide * torch.sin(angle), 0.5 * wide * torch.sin(angle / 2)], -1)
    rotation, centre = world_from_cam[:3, :3], world_from_cam[:3, 3]
    eye = centre + offset @ rotation.T
    target = (centre + rotation[:, 2] * focus_depth).expand_as(eye)
    return look_at(eye, target, -rotation[:, 1])


def mean_up(world_from_cam: Float[Tensor, "camera 4 4"]) -> Float[Tensor, "3"]:
    """Where up is, as a unit vector of the world frame: people hold cameras upright, so the mean of what is up in them.

    Cameras that look up and down on opposite sides may cancel: then the first one decides.
    """
    mean = -world_from_cam[:, :3, 1].mean(0)
    return torch.nn.functional.normalize(mean if float(mean.norm()) > 0.2 else -world_from_cam[0, :3, 1], dim=0)


def focus_depth(depth: Float[Tensor, "view height width"]) -> Float[Tensor, "view"]:
    """What one turns around: the median z-depth of the middle half of each view."""
    height, width = depth.shape[1:]
    middle = depth[:, height // 4 : height - height // 4, width // 4 : width - width // 4]
    return middle.flatten(1).median(1).values


def _key_times(poses: Float[Tensor, "key 4 4"], frames: int) -> Float[Tensor, "key"]:
    """Frame time of every key, from 0 to frames - 1: steps as the square root of how far two keys are apart."""
    step = (poses[1:, :3, 3] - poses[:-1, :3, 3]).norm(dim=-1)
    turn = rotation_angle_deg(poses[:-1, :3, :3], poses[1:, :3, :3])
    moving = step[step > 0]
    typical = moving.median() if len(moving) else step.new_ones(())
    effort = (step / typical + turn / TURN_AS_LONG_AS_TYPICAL_STEP_DEG).sqrt()
    mean = float(effort.mean()) or 1.0
    effort = effort.clamp(min=SHORTEST_SHARE * mean)
    times = torch.cat([effort.new_zeros(1), effort.cumsum(0)])
    times = times * (max(frames - 1, 1) / times[-1])
    if frames < len(times):
        return times
    # A whole frame for every key: round, then push apart from both ends what fell together.
    whole = times.round()
    index = torch.arange(len(times), dtype=times.dtype, device=times.device)
    whole = (whole - index).cummax(0).values + index
    return torch.minimum(whole, (frames - len(times)) + index)


def _tangents(differences: Float[Tensor, "segment value"], times: Float[Tensor, "key"]) -> Float[Tensor, "key value"]:
    """Velocity at the keys, zero at both ends: slopes of the neighbouring segments, the shorter one counting more."""
    length = (times[1:] - times[:-1])[:, None]
    slope = differences / length
    inner = (slope[:-1] * length[1:] + slope[1:] * length[:-1]) / (length[:-1] + length[1:])
    rest = torch.zeros_like(slope[:1])
    return torch.cat([rest, inner, rest])


def _hermite(
    values: Float[Tensor, "key value"], times: Float[Tensor, "key"], segment: Tensor, fraction: Float[Tensor, "frame"]
) -> Float[Tensor, "frame value"]:
    """Cubic Hermite spline through the values."""
    tangent = _tangents(values[1:] - values[:-1], times)
    length = (times[1:] - times[:-1])[segment][:, None]
    u = fraction[:, None]
    begin, end = values[segment], values[segment + 1]
    rise = u * u * (3 - 2 * u)
    velocity = u * (1 - u) ** 2 * tangent[segment] - u * u * (1 - u) * tangent[segment + 1]
    return begin + rise * (end - begin) + length * velocity


def _spherical_bezier(
    rotations: Float[Tensor, "key 3 3"],
    times: Float[Tensor, "key"],
    segment: Tensor,
    fraction: Float[Tensor, "frame"],
) -> Float[Tensor, "frame 4"]:
    """The same spline for rotations: a cubic Bezier curve per segment, by repeated spherical interpolation."""
    # Velocities in the keys' own frames: a rotation vector has the same components in both frames that it connects.
    tangent = _tangents(_rotation_vector(rotations[:-1].transpose(-1, -2) @ rotations[1:]), times)
    length = (times[1:] - times[:-1])[:, None]
    quats = quat_wxyz_from_rotation(rotations)
    leave = quat_wxyz_from_rotation(rotations[:-1] @ _rotation(tangent[:-1] * length / 3))
    arrive = quat_wxyz_from_rotation(rotations[1:] @ _rotation(-tangent[1:] * length / 3))
    level = [quats[segment], leave[segment], arrive[segment], quats[segment + 1]]
    while len(level) > 1:
        level = [slerp_wxyz(a, b, fraction) for a, b in itertools.pairwise(level)]
    return level[0]


def _rotation_vector(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    quat = quat_wxyz_from_rotation(rotation)
    sine = quat[..., 1:].norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, quat[..., :1])
    return torch.where(sine > 1e-12, angle / sine.clamp(min=1e-12), torch.full_like(angle, 2.0)) * quat[..., 1:]


def _rotation(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    half = vector.norm(dim=-1, keepdim=True) / 2
    # sin(h)/h is torch.sinc(h/pi): exact at 0 as well.
    return rotation_from_quat_wxyz(torch.cat([torch.cos(half), 0.5 * torch.sinc(half / math.pi) * vector], -1))


def _best_path(starts: Sequence[int], distance: list[list[float]]) -> list[int]:
    """The shortest path over all cameras from one of the starts."""
    count = len(distance)
    if count == 0:
        return []
    # Shortest paths by (set of cameras as bits, last camera), grown one camera at a time.
    paths = {(1 << start, start): (0.0, [start]) for start in starts}
    for _ in range(count - 1):
        longer: dict[tuple[int, int], tuple[float, list[int]]] = {}
        for (seen, here), (length, path) in paths.items():
            for there in range(count):
                key, total = (seen | 1 << there, there), length + distance[here][there]
                if not seen >> there & 1 and (key not in longer or total < longer[key][0]):
                    longer[key] = (total, [*path, there])
        paths = longer
    return min(paths.values())[1]


def _nearest_neighbours(start: int, distance: list[list[float]]) -> list[int]:
    path, left = [start], set(range(len(distance))) - {start}
    while left:
        here = path[-1]
        path.append(min(left, key=lambda other: (distance[here][other], other)))
        left.remove(path[-1])
    return path


def _improve(path: list[int], distance: list[list[float]]) -> list[int]:
    """Reverse runs path[i:j] while that shortens the open path; the first camera stays first."""
    count = len(path)
    worth = GAIN_WORTH_TAKING * sum(distance[a][b] for a, b in itertools.pairwise(path))
    improved = True
    while improved:
        improved = False
        for i in range(1, count - 1):
            for j in range(i + 2, count + 1):
                before = distance[path[i - 1]][path[i]]
                after = distance[path[i - 1]][path[j - 1]]
                if j < count:
                    before += distance[path[j - 1]][path[j]]
                    after += distance[path[i]][path[j]]
                if before - after > worth:
                    path[i:j] = path[i:j][::-1]
                    improved = True
    return path
