"""Where the camera could go next: what the scene does not show yet, and the motions that show it (beyond the paper).

A motion is worth proposing when its picture shows much that is new beside enough of the scene for the picture's camera to be found.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.generation.backends.reproject import fill_unseen
from sceneexpander.generation.motion import Direction, Step
from sceneexpander.generation.protocol import SceneSoFar
from sceneexpander.generation.start import CENTRAL, gaze_distance, moved_camera, start_view, upwards, view_distances
from sceneexpander.geometry.camera import resize_intrinsics
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.rigid import rigid_from_parts
from sceneexpander.splatting.render import Render, render

COVERED_ALPHA = 0.5  # of what is drawn over a pixel: below it, nothing is known there
FEWEST_SEEN = 0.4  # of a proposed picture, so that its camera can be found; set by hand
FEWEST_NEW = 0.1  # of a proposed picture
MOST_PROPOSALS = 3
_LEAST_APART = 0.35  # of proposed cameras: radians, and distances in those to what the camera looks at
_RATED_SIDE_PX = 96
_FACE_PX, _MAP_HEIGHT = 192, 288
_TURNS_DEG, _UPS_DEG, _ORBITS_DEG, _BACK = (20.0, 35.0, 50.0), (15.0, 25.0), (20.0, 35.0), 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class ProposedMotion:
    """A motion with what it would show.

    Attributes:
        steps: of the motion.
        new: share of the picture that the scene does not show yet.
        direction_deg: of its gaze: azimuth to the right of the start view's, elevation above the horizon.
        preview: the scene from there, unseen parts continued from around.
    """

    steps: tuple[Step, ...]
    new: float
    direction_deg: tuple[float, float]
    preview: Float[Tensor, "3 height width"]

    @property
    def words(self) -> str:
        """What `parse_motion` reads as ``steps``."""
        return ", ".join(step.words() for step in self.steps)


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """What is shown in all directions from the middle of the cameras.

    ``panorama`` is equirectangular: its middle column is the start view's heading, its middle row the horizon; unseen is black.
    ``share`` is that of the sphere.
    """

    panorama: Float[Tensor, "3 height width"]
    share: float


def start_of(so_far: SceneSoFar) -> int:
    """The view that proposed motions start from, which is where generators start as well."""
    return start_view(so_far, CENTRAL)


@torch.no_grad()
def propose_motions(so_far: SceneSoFar) -> tuple[ProposedMotion, ...]:
    """At most three motions that differ, the one that shows most new first; none where nothing new is in reach.

    Raises:
        UserError: no photo has a camera.
    """
    view = start_of(so_far)
    rated = []
    for steps in _motions():
        pose = moved_camera(so_far, steps, view, where="proposal")
        seen = _drawn(so_far, pose, view, long_side_px=_RATED_SIDE_PX).alpha[0] >= COVERED_ALPHA
        new = 1 - float(seen.float().mean())
        if FEWEST_NEW <= new <= 1 - FEWEST_SEEN:
            rated.append((new, steps, pose))
    rated.sort(key=lambda item: -item[0])
    taken: list[tuple[float, tuple[Step, ...], Tensor]] = []
    for item in rated:
        others = torch.stack([other[2] for other in taken]) if taken else item[2].new_zeros(0, 4, 4)
        apart = view_distances(item[2][None], others, scale=gaze_distance(so_far, view))
        if bool((apart >= _LEAST_APART).all()):
            taken.append(item)
        if len(taken) == MOST_PROPOSALS:
            break
    basis = _basis(so_far, view)
    return tuple(
        ProposedMotion(
            steps=steps,
            new=new,
            direction_deg=_direction_deg(basis.T @ pose[:3, 2]),
            preview=_preview(so_far, pose, view),
        )
        for new, steps, pose in taken
    )


@torch.no_grad()
def measure_coverage(so_far: SceneSoFar) -> Coverage:
    """What the Gaussians show in all directions from the middle of the cameras that are known."""
    view, scene = start_of(so_far), so_far.reconstruction
    basis = _basis(so_far, view)
    middle = scene.world_from_cam[scene.posed][:, :3, 3].mean(0)
    half = _FACE_PX / 2
    lens = basis.new_tensor([[half, 0, half], [0, half, half], [0, 0, 1]])
    directions = _map_directions(like=basis)
    rgb, alpha = directions.new_zeros(3, *directions.shape[:2]), directions.new_zeros(directions.shape[:2])
    for face in _cube_faces(like=basis):
        seen = render(
            scene.gaussians, Cameras(rigid_from_parts(basis @ face, middle)[None], lens[None], _FACE_PX, _FACE_PX)
        )
        x, y, z = (directions @ face).unbind(-1)
        inside = (z > 0) & (x.abs() <= z) & (y.abs() <= z)
        column, row = ((half + half * part / z.clamp(min=1e-9)).long().clamp(0, _FACE_PX - 1) for part in (x, y))
        rgb = torch.where(inside, seen.rgb[0][:, row, column], rgb)
        alpha = torch.where(inside, seen.alpha[0][row, column], alpha)
    covered = alpha >= COVERED_ALPHA
    area = (1 - directions[..., 1] ** 2).clamp(min=0).sqrt()  # a row near a pole is a short circle
    share = float((area * covered).sum() / area.sum())
    return Coverage(panorama=(rgb * covered).clamp(0, 1), share=share)


def _motions() -> Iterable[tuple[Step, ...]]:
    sides: tuple[Direction, ...] = ("left", "right")
    for direction in sides:
        for angle in _TURNS_DEG:
            yield (Step(kind="turn", direction=direction, amount=angle, unit="degrees"),)
        for angle in _ORBITS_DEG:
            yield (Step(kind="orbit", direction=direction, amount=angle, unit="degrees"),)
    tilts: tuple[Direction, ...] = ("up", "down")
    for tilt in tilts:
        for angle in _UPS_DEG:
            yield (Step(kind="turn", direction=tilt, amount=angle, unit="degrees"),)
    yield (Step(kind="move", direction="back", amount=_BACK, unit="share"),)


def _drawn(so_far: SceneSoFar, pose: Float[Tensor, "4 4"], view: int, *, long_side_px: int) -> Render:
    scene, views = so_far.reconstruction, so_far.views
    scale = min(1.0, long_side_px / max(views.height, views.width))
    height, width = round(views.height * scale), round(views.width * scale)
    lens = resize_intrinsics(scene.intrinsics_px[view], width / views.width, height / views.height)
    return render(scene.gaussians, Cameras(pose[None], lens[None], height, width))


def _preview(so_far: SceneSoFar, pose: Float[Tensor, "4 4"], view: int) -> Float[Tensor, "3 height width"]:
    seen = _drawn(so_far, pose, view, long_side_px=max(so_far.views.height, so_far.views.width))
    return fill_unseen(seen.rgb[0], seen.alpha[0])


def _basis(so_far: SceneSoFar, view: int) -> Float[Tensor, "3 3"]:
    """World from (right, down, forward): forward is the view's heading on the horizon."""
    down = -upwards(so_far, view)
    gaze = so_far.reconstruction.world_from_cam[view, :3, 2]
    forward = gaze - (gaze @ down) * down
    if float(forward.norm()) < 1e-3:  # it looks straight up or down
        forward = so_far.reconstruction.world_from_cam[view, :3, 1]
    forward = torch.nn.functional.normalize(forward, dim=0)
    return torch.stack([torch.linalg.cross(down, forward), down, forward], dim=-1)


def _direction_deg(direction: Float[Tensor, "3"]) -> tuple[float, float]:
    right, down, forward = direction.tolist()
    return math.degrees(math.atan2(right, forward)), math.degrees(math.asin(max(-1.0, min(1.0, -down))))


def _map_directions(*, like: Tensor) -> Float[Tensor, "height width 3"]:
    """Unit vectors (right, down, forward) of the panorama's pixels."""
    height, width = _MAP_HEIGHT, 2 * _MAP_HEIGHT
    elevation = (0.5 - (torch.arange(height, dtype=like.dtype, device=like.device) + 0.5) / height) * math.pi
    azimuth = ((torch.arange(width, dtype=like.dtype, device=like.device) + 0.5) / width - 0.5) * 2 * math.pi
    high, round_ = torch.meshgrid(elevation, azimuth, indexing="ij")
    return torch.stack([high.cos() * round_.sin(), -high.sin(), high.cos() * round_.cos()], dim=-1)


def _cube_faces(*, like: Tensor) -> list[Float[Tensor, "3 3"]]:
    """Rotations of six cameras of 90 degrees that see everything: columns are their right, down and forward."""
    ahead = [(0, 0, 1), (1, 0, 0), (0, 0, -1), (-1, 0, 0)]
    downs = dict.fromkeys(ahead, (0, 1, 0)) | {(0, 1, 0): (0, 0, -1), (0, -1, 0): (0, 0, 1)}
    faces = []
    for forward, down in downs.items():
        axes = like.new_tensor([down, forward])
        faces.append(torch.stack([torch.linalg.cross(axes[0], axes[1]), axes[0], axes[1]], dim=-1))
    return faces
