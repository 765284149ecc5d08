"""Cameras and depth maps of any subset of the views, as OmniVGGT reads them (omnivggt spec 4)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.rigid import rigid_from_parts, rigid_inverse
from sceneexpander.models.layers.quaternion import raw_camera_vector

MIN_CAMERA_DISTANCE = 1e-6
DEPTH_EPSILON = 1e-8


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchPriors:
    """Priors of B scenes of S views. Rows of views that are not listed are ignored, whatever they hold.

    ``camera_views`` have a pose and intrinsics; the first of them is the reference. The network was trained with view 0 among
    them whenever there are any. ``depth_views`` have a depth map. Both lists hold for every scene of the batch.
    """

    world_from_cam: Float[Tensor, "batch view 4 4"] | None = None
    intrinsics_px: Float[Tensor, "batch view 3 3"] | None = None
    camera_views: tuple[int, ...] = ()
    depth: Float[Tensor, "batch view height width"] | None = None
    depth_mask: Float[Tensor, "batch view height width"] | None = None  # 1 where the depth is valid, else 0
    depth_views: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.camera_views and (self.world_from_cam is None or self.intrinsics_px is None):
            raise ValueError(
                f"views {self.camera_views} are said to have cameras: poses and intrinsics are both needed"
            )
        if self.depth_views and (self.depth is None or self.depth_mask is None):
            raise ValueError(f"views {self.depth_views} are said to have depth: maps and masks are both needed")


@dataclass(frozen=True, slots=True, kw_only=True)
class EncodedPriors:
    """Priors as the trunk embeds them: one row for each listed view."""

    cameras: Float[Tensor, "batch given_cameras 9"] | None = None
    camera_views: tuple[int, ...] = ()
    depth: Float[Tensor, "batch given_depths 2 height width"] | None = None
    depth_views: tuple[int, ...] = ()


def encode_priors(priors: BatchPriors | None, height: int, width: int) -> EncodedPriors:
    """Normalise what is given for images of ``height x width`` pixels. Cameras and depth are normalised independently."""
    cameras = depth = None
    if priors is None:
        return EncodedPriors()
    if priors.camera_views and priors.world_from_cam is not None and priors.intrinsics_px is not None:
        index = list(priors.camera_views)
        cameras = encoded_cameras(priors.world_from_cam[:, index], priors.intrinsics_px[:, index], height, width)
    if priors.depth_views and priors.depth is not None and priors.depth_mask is not None:
        index = list(priors.depth_views)
        depth = encoded_depth(priors.depth[:, index], priors.depth_mask[:, index])
    return EncodedPriors(cameras=cameras, camera_views=priors.camera_views, depth=depth, depth_views=priors.depth_views)


def encoded_cameras(
    world_from_cam: Float[Tensor, "batch given 4 4"],
    intrinsics_px: Float[Tensor, "batch given 3 3"],
    height: int,
    width: int,
) -> Float[Tensor, "batch given 9"]:
    """``[t, quat xyzw, vertical fov, horizontal fov]`` of ``cam_from_world``, the first camera being the world.

    Translations are divided by the mean distance of the other cameras from the first; the principal point is not read.
    """
    cam_from_first = rigid_inverse(world_from_cam) @ world_from_cam[:, :1]
    translation = cam_from_first[..., :3, 3]
    if translation.shape[1] > 1:
        distance = (translation[:, 1:] - translation[:, :1]).norm(dim=-1).mean(dim=1)
        translation = translation / distance.clamp(min=MIN_CAMERA_DISTANCE)[:, None, None]
    cameras = rigid_from_parts(cam_from_first[..., :3, :3], translation)
    return raw_camera_vector(cameras, intrinsics_px, height, width)


def encoded_depth(
    depth: Float[Tensor, "batch given height width"], mask: Float[Tensor, "batch given height width"]
) -> Float[Tensor, "batch given 2 height width"]:
    """``[depth / mean depth, mask]``; the mean is that of all valid pixels of a scene."""
    valid = mask > 0
    known = torch.where(valid, depth, torch.zeros_like(depth)).flatten(1)
    mean = known.sum(dim=1) / valid.flatten(1).sum(dim=1).clamp(min=1)
    # A scene without valid pixels has mean 0, and its mask makes everything 0.
    scaled = torch.where(valid, depth / (mean[:, None, None, None] + DEPTH_EPSILON) * mask, torch.zeros_like(depth))
    return torch.stack([scaled, mask], dim=2)


def batch_priors(priors: Priors | None, images: Float[Tensor, "view 3 height width"]) -> BatchPriors | None:
    """Priors of one scene as a batch of one, for views whose poses (if any) come with intrinsics.

    The network takes cameras whole. Intrinsics without poses are given as the camera of the first view, which is the world.
    Depth counts where it is finite and positive; a view without any such pixel has no depth prior.

    Raises:
        ValueError: a shape does not fit the images, a value is not finite, or the first view has no pose but others do.
    """
    if priors is None:
        return None
    views, _, height, width = images.shape
    poses, intrinsics, depth = priors.world_from_cam, priors.intrinsics_px, priors.depth
    _check_shape("world_from_cam", poses, (views, 4, 4))
    _check_shape("intrinsics_px", intrinsics, (views, 3, 3))
    _check_shape("depth", depth, (views, height, width))
    _check_shape("posed", priors.posed, (views,))
    camera_views: tuple[int, ...] = ()
    if poses is not None and intrinsics is not None:
        posed = range(views) if priors.posed is None else torch.nonzero(priors.posed)[:, 0].tolist()
        camera_views = tuple(posed)
        if camera_views and camera_views[0] != 0:
            raise ValueError(f"views {camera_views} have poses but the first view, which is the world, has none")
    elif intrinsics is not None:
        camera_views = (0,)
        poses = torch.eye(4).expand(views, 4, 4)
    for name, value in (("world_from_cam", poses), ("intrinsics_px", intrinsics)):
        for view in camera_views:
            if value is not None and not bool(torch.isfinite(value[view]).all()):
                raise ValueError(f"{name} of view {view} is not finite")
    mask = None if depth is None else (torch.isfinite(depth) & (depth > 0))
    depth_views = () if mask is None else tuple(torch.nonzero(mask.flatten(1).any(dim=1))[:, 0].tolist())

    def lift(value: Tensor | None) -> Tensor | None:
        return None if value is None else value[None].to(images)

    return BatchPriors(
        world_from_cam=lift(poses),
        intrinsics_px=lift(intrinsics),
        camera_views=camera_views,
        depth=lift(depth),
        depth_mask=lift(mask),
        depth_views=depth_views,
    )


def _check_shape(name: str, value: Tensor | None, expected: tuple[int, ...]) -> None:
    if value is not None and tuple(value.shape) != expected:
        raise ValueError(f"prior {name} has shape {tuple(value.shape)}, these images need {expected}")
