"""Where the camera of a video goes, in the frame of the reconstruction that is shown."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.errors import UserError
from sceneexpander.evaluation.views import same_place
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.rigid import look_at
from sceneexpander.geometry.trajectory import focus_depth, mean_up, navigation, orbit, shortest_path_order, spiral
from sceneexpander.rendering.config import RenderConfig, ViewKey

_STEEPEST = 1e-3  # sine of the angle between a line of sight and the vertical, below which nothing says where left is
_EVEN = 2  # video codecs with subsampled colour need even sides


@dataclass(frozen=True, slots=True, kw_only=True)
class Tour:
    """Cameras of the video's frames in the reconstruction's own frame."""

    cameras: Cameras
    inserted_frame: int  # nearest to the inserted camera
    inserted_camera: str  # method that the inserted camera comes from


@dataclass(frozen=True, slots=True, kw_only=True)
class _Views:
    """The reconstruction's own cameras by view, the inserted one always among them."""

    names: tuple[str, ...]
    cameras: Cameras
    goal: str  # the inserted view

    def at(self, *names: str) -> Cameras:
        return self.cameras[[self.names.index(name) for name in names]]


def plan_tour(reconstruction: Reconstruction, reference: Reconstruction, config: RenderConfig) -> Tour:
    """The path that the configuration asks for.

    Args:
        reconstruction: whose scene is shown; its own cameras are used.
        reference: a reconstruction with the inserted view last. If ``reconstruction`` lacks that view (nothing was inserted yet), the
            camera comes from here, brought over by aligning the captured cameras of both.
        config: path, number of frames and size.

    Raises:
        UserError: a key frame at a view that does not exist.
    """
    views = _views(reconstruction, reference)
    goal = views.at(views.goal)
    owner = reconstruction if views.goal in reconstruction.view_ids else reference
    match config.path:
        case "tour":
            path = _through_the_cameras(views, reconstruction, reference, config)
        case "keyframes":
            path = _through_key_frames(views, reconstruction, reference, config)
        case "orbit" | "spiral":
            poses = _around_the_inserted_view(owner, owner.view_ids.index(views.goal), config)
            if owner is not reconstruction:
                poses = same_place(poses, reference, reconstruction)
            path = replace(goal[[0] * config.frames], world_from_cam=poses)
    height_px, width_px = (_EVEN * max(1, round(side * config.scale / _EVEN)) for side in (path.height, path.width))
    return Tour(
        cameras=path.resized(height_px, width_px),
        inserted_frame=int((path.world_from_cam - goal.world_from_cam).flatten(1).norm(dim=1).argmin()),
        inserted_camera=owner.method,
    )


def _views(reconstruction: Reconstruction, reference: Reconstruction) -> _Views:
    goal, names, cameras = reference.view_ids[-1], reconstruction.view_ids, reconstruction.cameras
    if goal not in names:
        pose = same_place(reference.world_from_cam[-1:], reference, reconstruction)
        names, cameras = (*names, goal), cameras.followed_by(replace(reference.cameras[-1], world_from_cam=pose))
    return _Views(names=names, cameras=cameras, goal=goal)


def _through_the_cameras(
    views: _Views, reconstruction: Reconstruction, reference: Reconstruction, config: RenderConfig
) -> Cameras:
    # The order comes from the reference for all methods, so that their videos show the same tour.
    seen = [
        i
        for i, view in enumerate(reference.view_ids[:-1])
        if view in reconstruction.view_ids and bool(reference.posed[i])
    ]
    order = shortest_path_order(reference.world_from_cam[[*seen, -1]], last=len(seen))
    there = [reference.view_ids[seen[i]] for i in order[:-1]]
    keys = views.at(*there, views.goal)
    # The way back is the way there, to the last bit: what is drawn of a camera once is not drawn again.
    way = navigation(keys, (config.frames + 1) // 2, range(len(keys)))
    return way.followed_by(way[list(range(config.frames // 2))[::-1]])


def _through_key_frames(
    views: _Views, reconstruction: Reconstruction, reference: Reconstruction, config: RenderConfig
) -> Cameras:
    poses, lenses = [], []
    captured = (~reference.generated).nonzero()[:, 0]
    up = mean_up(reference.world_from_cam[captured])
    for index, key in enumerate(config.keyframes):
        if isinstance(key, ViewKey):
            if key.view not in views.names:
                raise UserError(
                    f"key frame {index} is at view {key.view!r}, which the scene does not have",
                    where="render.keyframes",
                    fix=f"there are {', '.join(views.names)}",
                )
            poses.append(views.at(key.view).world_from_cam[0])
            lenses.append(key.view)
            continue
        eye, target = up.new_tensor(key.eye), up.new_tensor(key.target)
        ahead = torch.nn.functional.normalize(target - eye, dim=0)
        if float(torch.linalg.cross(ahead, up).norm()) < _STEEPEST:
            raise UserError(f"key frame {index} looks straight up or down", where="render.keyframes")
        pose = look_at(eye, target, up)
        if reconstruction.method != reference.method:
            pose = same_place(pose[None], reference, reconstruction)[0]
        poses.append(pose)
        lenses.append(views.goal)
    keys = replace(views.at(*lenses), world_from_cam=torch.stack(poses))
    return navigation(keys, config.frames, range(len(keys)))


def _around_the_inserted_view(owner: Reconstruction, goal: int, config: RenderConfig) -> Float[Tensor, "frame 4 4"]:
    """In the frame of the reconstruction that has the inserted view, at index ``goal``."""
    pose, focus = owner.world_from_cam[goal], focus_depth(owner.depth)[goal]
    if config.path == "spiral":
        radius = config.spiral_radius * float(focus)
        return spiral(pose, float(focus), radius, config.frames, turns=config.spiral_turns)
    target = pose[:3, 3] + focus * pose[:3, 2]
    up = mean_up(owner.world_from_cam[(~owner.generated).nonzero()[:, 0]])
    return orbit(pose, target, config.frames, up=up, turn_rad=math.radians(config.orbit_deg))
