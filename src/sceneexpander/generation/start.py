"""Where a motion starts, and what it is measured by."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.errors import UserError, did_you_mean
from sceneexpander.generation.motion import Step, move_camera
from sceneexpander.generation.protocol import SceneSoFar
from sceneexpander.geometry.rigid import rotation_angle_deg

CENTRAL = "central"


def start_view(so_far: SceneSoFar, name: str) -> int:
    """The view that a motion starts from: the one of that file name, or the captured view in the middle of the others.

    Raises:
        UserError: there is no such view, or it has no camera.
    """
    scene = so_far.reconstruction
    if name != CENTRAL:
        names = [record.name for record in so_far.views.records]
        if name not in names:
            raise UserError(f"there is no view {name!r}", where="generator.start", fix=did_you_mean(name, names))
        if not bool(scene.posed[names.index(name)]):
            raise UserError(f"{name} has no camera", where="generator.start", fix="start from another view")
        return names.index(name)
    usable = scene.posed & ~scene.generated
    if not bool(usable.any()):
        raise UserError("no photo has a camera, so nothing can be seen from elsewhere", where="generator")
    index = usable.nonzero()[:, 0]
    apart = view_distances(scene.world_from_cam[index], scene.world_from_cam[index], scale=gaze_distance(so_far, 0))
    return int(index[int(apart.sum(1).argmin())])


def moved_camera(so_far: SceneSoFar, steps: tuple[Step, ...], view: int, *, where: str) -> Float[Tensor, "4 4"]:
    """``world_from_cam`` after a motion that starts at a view, in the frame of the reconstruction."""
    return move_camera(
        so_far.reconstruction.world_from_cam[view],
        steps,
        up=upwards(so_far, view),
        distance=gaze_distance(so_far, view),
        units_per_metre=units_per_metre(so_far),
        where=where,
    )


def upwards(so_far: SceneSoFar, view: int) -> Float[Tensor, "3"]:
    """The unit vector that is up in the world: what the photos have in common, or a view's own where they are held in all ways."""
    scene = so_far.reconstruction
    usable = scene.posed & ~scene.generated
    downs = scene.world_from_cam[usable][:, :3, 1]
    up = -torch.nn.functional.normalize(downs.mean(0), dim=0)
    if not bool(torch.isfinite(up).all()) or float(downs.mean(0).norm()) < 1e-3:
        return -scene.world_from_cam[view, :3, 1]
    return up


def gaze_distance(so_far: SceneSoFar, view: int) -> float:
    """How far away what a view looks at is, in scene units: the median of its depth."""
    return float(so_far.reconstruction.depth[view].median())


def units_per_metre(so_far: SceneSoFar) -> float | None:
    """Scene units per metre, from known cameras whose distances are metres; None without such cameras."""
    known = so_far.known
    if known is None or not known.metric or known.world_from_cam is None:
        return None
    count = min(len(known.world_from_cam), len(so_far.reconstruction.world_from_cam))
    metres = _spread(known.world_from_cam[:count])
    units = _spread(so_far.reconstruction.world_from_cam[:count])
    return units / metres if metres > 1e-6 and units > 1e-9 else None


def _spread(world_from_cam: Float[Tensor, "view 4 4"]) -> float:
    centres = world_from_cam[:, :3, 3].double()
    return float((centres - centres.mean(0)).norm(dim=-1).mean())


def view_distances(
    a: Float[Tensor, "one 4 4"], b: Float[Tensor, "other 4 4"], *, scale: float
) -> Float[Tensor, "one other"]:
    """How far apart cameras are: the distance of their centres over ``scale``, plus the angle between their gazes in radians."""
    apart = torch.cdist(a[:, :3, 3], b[:, :3, 3]) / scale
    return apart + torch.deg2rad(rotation_angle_deg(a[:, None, :3, :3], b[None, :, :3, :3]))
