"""Pixel-aligned Gaussians from depth, cameras, normals and colours: an analytic rule plus learned residuals."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from sceneexpander.geometry.camera import unproject_to_world
from sceneexpander.geometry.gaussians import Gaussians, sh_from_rgb
from sceneexpander.geometry.rigid import quat_wxyz_from_rotation, rigid_inverse
from sceneexpander.models.mini.config import MiniConfig
from sceneexpander.models.mini.inputs import SAME_SURFACE, sample_other_views
from sceneexpander.models.mini.normals import viewing_rays

SPLAT_RESIDUALS = 4  # log scale along the slant, log scale across, opacity logit, log depth offset
_OPACITY_RANGE = (0.01, 0.97)  # of the analytic opacity, so that its logit stays finite
_OFFSET_LIMIT = 0.05  # the learned offset moves a Gaussian by 5 % of its depth at most


def pixel_aligned_gaussians(
    images: Float[Tensor, "view 3 height width"],
    depth: Float[Tensor, "view height width"],
    depth_conf: Float[Tensor, "view height width"],
    normals: Float[Tensor, "view height width 3"],
    world_from_cam: Float[Tensor, "view 4 4"],
    intrinsics_px: Float[Tensor, "view 3 3"],
    transparent: Float[Tensor, "view height width"],
    residuals: Float[Tensor, "view 4 height width"],
    generated: Bool[Tensor, " view"],
    config: MiniConfig,
) -> tuple[Gaussians, Float[Tensor, "view height width"]]:
    """One Gaussian per pixel, in (view, row, column) order, and the depth that placed them.

    The analytic rule (all residuals zero): centre = the pixel centre at its depth; a flat ellipse in the surface's
    tangent plane that covers the pixel, stretched along the slant; colour = the pixel; opacity from confidence, times
    1 - ``transparent``. Cameras and normals receive no gradient from here.
    """
    views, height, width = depth.shape
    log_scale, opacity_logit, offset = residuals[:, :2], residuals[:, 2], residuals[:, 3]
    splat_depth = depth * (_OFFSET_LIMIT * torch.tanh(offset)).exp()
    poses, intrinsics = world_from_cam.detach(), intrinsics_px.detach()
    means = unproject_to_world(splat_depth, intrinsics, poses)

    with torch.no_grad():
        rays = functional.normalize(viewing_rays(intrinsics, height, width), dim=-1)
        rotation_cam, slant_cosine = slant_frame(normals, rays)
        quat = quat_wxyz_from_rotation(poses[:, None, None, :3, :3] @ rotation_cam)
        stretch = 1 / slant_cosine.clamp(min=1 / config.max_stretch)
        opacity = 0.95 * (1 - 0.3 / depth_conf) * (1 - transparent)
        base_logit = torch.logit(opacity.clamp(*_OPACITY_RANGE))
    focal = (intrinsics[:, 0, 0] * intrinsics[:, 1, 1]).sqrt()[:, None, None]
    across = config.splat_std_px * splat_depth / focal
    learned = log_scale.clamp(-2, 2).exp()
    scales = torch.stack(
        [across * stretch * learned[:, 0], across * learned[:, 1], across * config.splat_thickness], dim=-1
    )
    source = torch.arange(views, device=depth.device)[:, None, None].expand(views, height, width)
    gaussians = Gaussians(
        means=means.flatten(0, 2),
        quat_wxyz=quat.flatten(0, 2),
        scales=scales.flatten(0, 2),
        opacities=torch.sigmoid(base_logit + opacity_logit).flatten(),
        sh=sh_from_rgb(images.movedim(1, -1)).reshape(-1, 1, 3),
        source_view=source.flatten(),
        generated=generated[source].flatten(),
    )
    return gaussians, splat_depth


def slant_frame(
    normals: Float[Tensor, "*batch 3"], unit_rays: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch"]]:
    """(rotation with columns [direction of the slant, across, normal], cosine of the slant) of surface elements.

    The direction of the slant is that in which the surface recedes from the camera.
    """
    cosine = -(normals * unit_rays).sum(-1)
    recede = unit_rays + cosine[..., None] * normals
    # A surface that faces the camera has no slant: any direction in its plane will do.
    axis = torch.zeros_like(normals)
    axis[..., 0] = 1
    any_tangent = axis - normals[..., :1] * normals
    recede = functional.normalize(torch.where(recede.norm(dim=-1, keepdim=True) > 1e-3, recede, any_tangent), dim=-1)
    across = torch.linalg.cross(normals, recede)
    return torch.stack([recede, across, normals], dim=-1), cosine


@torch.no_grad()
def covered_by_others(
    depth: Float[Tensor, "view height width"],
    confident: Float[Tensor, "view height width"],
    world_from_cam: Float[Tensor, "view 4 4"],
    intrinsics_px: Float[Tensor, "view 3 3"],
    *,
    most_views: int,
) -> Float[Tensor, "view height width"]:
    """1 where a pixel is a guess and another view confidently sees the same space: its surface, or free space there.

    A guess behind another view's confident surface is hidden from that view and stays.
    """
    views, height, width = depth.shape
    out = torch.zeros_like(depth)
    if views == 1:
        return out
    log_depth = depth.log()
    content = torch.stack([log_depth, confident], dim=1)
    points = unproject_to_world(depth, intrinsics_px, world_from_cam).flatten(1, 2)
    cam_from_world = rigid_inverse(world_from_cam)
    centres = world_from_cam[:, :3, 3]
    tolerance = torch.tensor(SAME_SURFACE).log()
    for view in range(views):
        distance = (centres - centres[view]).square().sum(-1)
        distance[view] = torch.inf
        others = distance.argsort()[: min(views - 1, most_views)]
        seen, log_z, in_frame = sample_other_views(
            points[view], content[others], cam_from_world[others], intrinsics_px[others]
        )
        sees = in_frame & (log_z < seen[:, 0] + tolerance)
        out[view] = (seen[:, 1] * sees).amax(0).view(height, width) * (1 - confident[view])
    return out
