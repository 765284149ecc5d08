"""Where the camera of a video goes, in the frame of the reconstruction that is shown."""

from __future__ import annotations

import math
from dataclasses import dataclass

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
class _Cameras:
    """The reconstruction's own cameras by view, the inserted one always among them."""

    world_from_cam: dict[str, Float[Tensor, "4 4"]]
    intrinsics_px: dict[str, Float[Tensor, "3 3"]]
    goal: str  # the inserted view

    def stacked(self, views: list[str]) -> tuple[Float[Tensor, "view 4 4"], Float[Tensor, "view 3 3"]]:
        return torch.stack([self.world_from_cam[v] for v in views]), torch.stack([self.intrinsics_px[v] for v in views])


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
    cameras = _cameras(reconstruction, reference)
    owner = reconstruction if cameras.goal in reconstruction.view_ids else reference
    match config.path:
        case "tour":
            poses, intrinsics = _through_the_cameras(cameras, reconstruction, reference, config)
        case "keyframes":
            poses, intrinsics = _through_key_frames(cameras, reconstruction, reference, config)
        case "orbit" | "spiral":
            poses = _around_the_inserted_view(owner, owner.view_ids.index(cameras.goal), config)
            if owner is not reconstruction:
                poses = same_place(poses, reference, reconstruction)
            intrinsics = cameras.intrinsics_px[cameras.goal].expand(config.frames, 3, 3)
    height, width = (int(side) for side in reconstruction.depth.shape[1:])
    height_px, width_px = (_EVEN * max(1, round(side * config.scale / _EVEN)) for side in (height, width))
    return Tour(
        cameras=Cameras(poses, intrinsics, height, width).resized(height_px, width_px),
        inserted_frame=int((poses - cameras.world_from_cam[cameras.goal]).flatten(1).norm(dim=1).argmin()),
        inserted_camera=owner.method,
    )


def _cameras(reconstruction: Reconstruction, reference: Reconstruction) -> _Cameras:
    goal = reference.view_ids[-1]
    poses = dict(zip(reconstruction.view_ids, reconstruction.world_from_cam, strict=True))
    intrinsics = dict(zip(reconstruction.view_ids, reconstruction.intrinsics_px, strict=True))
    if goal not in poses:
        poses[goal] = same_place(reference.world_from_cam[-1:], reference, reconstruction)[0]
        intrinsics[goal] = reference.intrinsics_px[-1]
    return _Cameras(world_from_cam=poses, intrinsics_px=intrinsics, goal=goal)


def _through_the_cameras(
    cameras: _Cameras, reconstruction: Reconstruction, reference: Reconstruction, config: RenderConfig
) -> tuple[Tensor, Tensor]:
    # The order comes from the reference for all methods, so that their videos show the same tour.
    seen = [
        i
        for i, view in enumerate(reference.view_ids[:-1])
        if view in reconstruction.view_ids and bool(reference.posed[i])
    ]
    order = shortest_path_order(reference.world_from_cam[[*seen, -1]], last=len(seen))
    there = [reference.view_ids[seen[i]] for i in order[:-1]]
    keys = [*there, cameras.goal]
    # The way back is the way there, to the last bit: what is drawn of a camera once is not drawn again.
    poses, intrinsics = navigation(*cameras.stacked(keys), (config.frames + 1) // 2, range(len(keys)))
    back = list(range(config.frames // 2))[::-1]
    return torch.cat([poses, poses[back]]), torch.cat([intrinsics, intrinsics[back]])


def _through_key_frames(
    cameras: _Cameras, reconstruction: Reconstruction, reference: Reconstruction, config: RenderConfig
) -> tuple[Tensor, Tensor]:
    poses, intrinsics = [], []
    captured = (~reference.generated).nonzero()[:, 0]
    up = mean_up(reference.world_from_cam[captured])
    for index, key in enumerate(config.keyframes):
        if isinstance(key, ViewKey):
            if key.view not in cameras.world_from_cam:
                raise UserError(
                    f"key frame {index} is at view {key.view!r}, which the scene does not have",
                    where="render.keyframes",
                    fix=f"there are {', '.join(cameras.world_from_cam)}",
                )
            poses.append(cameras.world_from_cam[key.view])
            intrinsics.append(cameras.intrinsics_px[key.view])
            continue
        eye, target = up.new_tensor(key.eye), up.new_tensor(key.target)
        ahead = torch.nn.functional.normalize(target - eye, dim=0)
        if float(torch.linalg.cross(ahead, up).norm()) < _STEEPEST:
            raise UserError(f"key frame {index} looks straight up or down", where="render.keyframes")
        pose = look_at(eye, target, up)
        if reconstruction.method != reference.method:
            pose = same_place(pose[None], reference, reconstruction)[0]
        poses.append(pose)
        intrinsics.append(cameras.intrinsics_px[cameras.goal])
    return navigation(torch.stack(poses), torch.stack(intrinsics), config.frames, range(len(poses)))


def _around_the_inserted_view(owner: Reconstruction, goal: int, config: RenderConfig) -> Float[Tensor, "frame 4 4"]:
    """In the frame of the reconstruction that has the inserted view, at index ``goal``."""
    pose, focus = owner.world_from_cam[goal], focus_depth(owner.depth)[goal]
    if config.path == "spiral":
        radius = config.spiral_radius * float(focus)
        return spiral(pose, float(focus), radius, config.frames, turns=config.spiral_turns)
    target = pose[:3, 3] + focus * pose[:3, 2]
    up = mean_up(owner.world_from_cam[(~owner.generated).nonzero()[:, 0]])
    return orbit(pose, target, config.frames, up=up, turn_rad=math.radians(config.orbit_deg))
