"""Camera sets for a world: believable walks whose views overlap, never inside an object."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.synthetic.render import cameras_at, trace_rays
from sceneexpander.synthetic.world import World

Pose = NDArray[np.float64]

OVERLAP_LIMITS = (0.20, 0.93)
MIN_CLEARANCE_M = 0.2
MIN_DEPTH_M = 0.35
_MOTIONS = ("arc", "lateral", "pan", "forward", "random")
_SHARES = (0.35, 0.25, 0.12, 0.13, 0.15)
_CORRIDOR_SHARES = (0.06, 0.09, 0.06, 0.7, 0.09)
_GRID = (12, 16)  # rays per view for the overlap test (rows, columns)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSet:
    """Cameras chosen for a world; ``overlap[i, j]`` is the share of view i's surface points that view j sees.

    ``disconnected`` is the index of a view that shares (almost) nothing with the others, or None.
    """

    cameras: Cameras
    motion: str
    overlap: NDArray[np.float64]
    disconnected: int | None


def pose_from_angles(eye: NDArray[np.float64], yaw: float, pitch: float, roll: float) -> Pose:
    """World (z up) from camera: looks along ``yaw`` (0 = +x), ``pitch`` up, then rolls about the viewing axis."""
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    down = np.cross(forward, right)
    pose = np.eye(4)
    pose[:3, 0] = np.cos(roll) * right + np.sin(roll) * down
    pose[:3, 1] = -np.sin(roll) * right + np.cos(roll) * down
    pose[:3, 2] = forward
    pose[:3, 3] = eye
    return pose


def same_lens(world_from_cam: NDArray[np.float64], focal_px: float, height: int, width: int) -> Cameras:
    """Cameras at (4,4) or (V,4,4) poses, with one focal length and the principal point in the middle; double precision."""
    lens = np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1.0]])
    return cameras_at(world_from_cam, lens, height, width)


def _aim(eye: NDArray[np.float64], target: NDArray[np.float64], damp: float, rng: np.random.Generator) -> Pose:
    to = target - eye
    yaw = float(np.arctan2(to[1], to[0]) + rng.normal(0, 0.06))
    pitch = float(np.arctan2(to[2], np.hypot(to[0], to[1]))) * damp + float(rng.normal(0, 0.02))
    return pose_from_angles(eye, yaw, pitch, float(rng.normal(0, 0.015)))


def _candidates(world: World, motion: str, count: int, rng: np.random.Generator) -> list[Pose]:
    """Poses along one random trajectory."""
    low, high = world.bounds.astype(np.float64)
    damp = 0.25 if rng.random() < 0.65 else 1.0
    target = world.focus[rng.integers(len(world.focus))].astype(np.float64)
    start = rng.uniform(low, high)
    distance = float(np.linalg.norm(target[:2] - start[:2])) + 0.3
    towards = float(np.arctan2(target[1] - start[1], target[0] - start[0]))
    poses: list[Pose] = []
    span = float(rng.uniform(0.5, 1.6))
    sideways = np.array([-np.sin(towards), np.cos(towards), 0.0])
    ahead = np.array([np.cos(towards), np.sin(towards), 0.0])
    yaw_shift = float(rng.normal(0, 0.15))
    for step in np.linspace(-1, 1, count):
        jitter = rng.normal(0, 0.03, 3) * min(distance, 3)
        if motion == "arc":
            angle = towards + np.pi + step * span
            eye = (
                np.array([target[0] + distance * np.cos(angle), target[1] + distance * np.sin(angle), start[2]])
                + jitter
            )
            poses.append(_aim(eye, target, damp, rng))
        elif motion == "lateral":
            eye = start + step * span * min(distance, 4) * 0.5 * sideways + jitter
            look = eye + distance * (np.cos(yaw_shift) * ahead + np.sin(yaw_shift) * sideways)
            look[2] = eye[2] + (target[2] - eye[2])
            poses.append(_aim(eye, look, damp, rng))
        elif motion == "pan":
            pitch = float(np.arctan2(target[2] - start[2], distance)) * damp
            poses.append(pose_from_angles(start + 2 * jitter, towards + step * span, pitch, float(rng.normal(0, 0.01))))
        elif motion == "forward":
            eye = start + (step + 1) * 0.5 * min(distance * 0.8, 6) * ahead + jitter * [1, 1, 0.3]
            pitch = float(np.arctan2(target[2] - start[2], distance + 2)) * damp
            poses.append(
                pose_from_angles(eye, towards + float(rng.normal(0, 0.015)), pitch, float(rng.normal(0, 0.006)))
            )
        else:
            eye = rng.uniform(low, high)
            poses.append(_aim(eye, target + rng.normal(0, 0.4, 3), damp, rng))
    return poses


def _grid_rays(cameras: Cameras, rows: int, columns: int) -> NDArray[np.float64]:
    """(V,N,3) rays, 1 deep, through the middles of a grid's cells, camera frames."""
    rays = []
    for lens in cameras.intrinsics_px.double().numpy():
        x = ((np.arange(columns) + 0.5) * cameras.width / columns - lens[0, 2]) / lens[0, 0]
        y = ((np.arange(rows) + 0.5) * cameras.height / rows - lens[1, 2]) / lens[1, 1]
        rays.append(np.stack([*np.meshgrid(x, y), np.ones((rows, columns))], -1).reshape(-1, 3))
    return np.stack(rays)


def _ray_depths(world: World, cameras: Cameras) -> NDArray[np.float64]:
    """(V, rows, columns) z-depth on the coarse grid, +inf for sky."""
    rows, columns = _GRID
    poses = cameras.world_from_cam.double().numpy()
    direction = np.einsum("vij,vnj->vni", poses[:, :3, :3], _grid_rays(cameras, rows, columns)).astype(np.float32)
    origin = np.broadcast_to(poses[:, None, :3, 3], direction.shape).astype(np.float32)
    return (
        trace_rays(world, origin.reshape(-1, 3), direction.reshape(-1, 3)).reshape(-1, rows, columns).astype(np.float64)
    )


def pairwise_overlap(cameras: Cameras, depths: NDArray[np.float64]) -> NDArray[np.float64]:
    """(V,V): share of view i's surface points that lie in view j's frame and are not hidden there (coarse grids)."""
    rows, columns = depths.shape[1:]
    poses, lenses = cameras.world_from_cam.double().numpy(), cameras.intrinsics_px.double().numpy()
    views = len(poses)
    flat = depths.reshape(views, -1)
    solid = np.isfinite(flat)
    points = np.where(solid, flat, 1.0)[..., None] * _grid_rays(cameras, rows, columns)
    world_points = np.einsum("vij,vnj->vni", poses[:, :3, :3], points) + poses[:, None, :3, 3]
    overlap = np.eye(views)
    for j in range(views):
        cam = (world_points - poses[j, :3, 3]) @ poses[j, :3, :3]
        z = np.maximum(cam[..., 2], 1e-6)
        u = (cam[..., 0] / z * lenses[j, 0, 0] + lenses[j, 0, 2]) * columns / cameras.width
        v = (cam[..., 1] / z * lenses[j, 1, 1] + lenses[j, 1, 2]) * rows / cameras.height
        inside = solid & (cam[..., 2] > 1e-3) & (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
        column, row = np.clip(u, 0, columns - 1).astype(int), np.clip(v, 0, rows - 1).astype(int)
        seen = depths[j][row, column]
        # The coarse grid cannot resolve edges: 10 % of depth counts as the same surface.
        visible = inside & (z < seen * 1.1)
        overlap[:, j] = visible.sum(1) / np.maximum(solid.sum(1), 1)
    return overlap


def _greedy(overlap: NDArray[np.float64], views: int, rng: np.random.Generator) -> list[int] | None:
    mutual = (overlap + overlap.T) / 2
    chosen = [int(rng.integers(len(mutual)))]
    while len(chosen) < views:
        best = mutual[:, chosen].max(1)
        allowed = (best >= OVERLAP_LIMITS[0]) & (best <= OVERLAP_LIMITS[1])
        allowed[chosen] = False
        options = np.nonzero(allowed)[0]
        if not len(options):
            return None
        chosen.append(int(rng.choice(options)))
    return chosen


def choose_cameras(
    world: World, views: int, height: int, width: int, rng: np.random.Generator, *, disconnected: bool = False
) -> CameraSet | None:
    """Cameras with one focal length; each view overlaps an earlier one by 20-93 %. None if no trajectory was found.

    With ``disconnected`` the last of three or more views looks at a part of the world that no other view sees.
    """
    shares = _CORRIDOR_SHARES if world.kind == "corridor" else _SHARES
    for attempt in range(12):
        motion = str(rng.choice(_MOTIONS, p=shares if attempt < 6 else (0.25, 0.25, 0.25, 0.1, 0.15)))
        focal = float(rng.uniform(0.55, 1.25)) * max(height, width)
        poses = np.stack(_candidates(world, motion, max(3 * views, 10), rng))
        eyes = poses[:, :3, 3]
        inside = ((eyes >= world.bounds[0] - 1e-6) & (eyes <= world.bounds[1] + 1e-6)).all(1)
        poses = poses[inside]
        if len(poses) < views:
            continue
        poses = poses[world.clearance(poses[:, :3, 3]) > MIN_CLEARANCE_M]
        if len(poses) < views:
            continue
        cameras = same_lens(poses, focal, height, width)
        depths = _ray_depths(world, cameras)
        flat = np.where(np.isfinite(depths), depths, 1e3).reshape(len(poses), -1)
        good = (flat.min(1) > MIN_DEPTH_M) & (np.median(flat, 1) > 0.7) & (np.isfinite(depths).mean((1, 2)) > 0.45)
        cameras, depths = cameras[torch.from_numpy(good)], depths[good]
        if len(cameras) < views:
            continue
        overlap = pairwise_overlap(cameras, depths)
        lonely = disconnected and views >= 3
        chosen = _greedy(overlap, views - int(lonely), rng)
        if chosen is None:
            continue
        rng.shuffle(chosen)
        selected = cameras[chosen]
        if lonely:
            turned = _lonely_view(world, selected, rng)
            if turned is None:
                continue
            selected = selected.followed_by(turned)
        return CameraSet(
            cameras=selected,
            motion=motion,
            overlap=pairwise_overlap(selected, _ray_depths(world, selected)),
            disconnected=views - 1 if lonely else None,
        )
    return None


def _lonely_view(world: World, cameras: Cameras, rng: np.random.Generator) -> Cameras | None:
    """A camera of the same lens that shares less than 2 % with every given one."""
    for _ in range(8):
        eye = rng.uniform(world.bounds[0].astype(np.float64), world.bounds[1].astype(np.float64))
        away = cameras.world_from_cam[0, :3, 2].numpy()
        yaw = float(np.arctan2(-away[1], -away[0]) + rng.normal(0, 0.5))
        pose = pose_from_angles(eye, yaw, float(rng.normal(0, 0.05)), 0.0)
        camera = replace(cameras[0], world_from_cam=torch.from_numpy(pose)[None])
        together = cameras.followed_by(camera)
        depths = _ray_depths(world, together)
        if (
            world.clearance(eye[None])[0] < MIN_CLEARANCE_M
            or depths[-1].min() < MIN_DEPTH_M
            or np.isinf(depths[-1]).mean() > 0.5
        ):
            continue
        overlap = pairwise_overlap(together, depths)
        if max(overlap[-1, :-1].max(), overlap[:-1, -1].max()) < 0.02:
            return camera
    return None
