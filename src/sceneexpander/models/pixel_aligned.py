"""One rule that turns any depth map with a camera into pixel-aligned Gaussians.

Every method without a Gaussian head gets its Gaussians from here, with the same constants, so that a comparison compares the
geometry that the methods predict and not the ways they are drawn. For a pixel with depth z, confidence c (> 1), colour and
surface normal n, seen along the unit ray r by a camera of focal length f:

- position: the pixel's centre at depth z, through the predicted camera;
- orientation: the axes are the direction in which the surface recedes from the camera, the one across it, and n;
- scale: ``std_px * z / f`` across, the same divided by the cosine of the slant -n.r (at most times ``max_stretch``) along the
  recession, so that the footprint covers the pixel, and a share ``thickness`` of it along n; then the band limit of a pixel
  of that size (`sceneexpander.geometry.sampling`), for rasterisers that compensate opacities for the screen blur: so the surface
  stays closed at sizes larger than the picture's own;
- opacity: ``0.95 (1 - 0.3 / c)``: 0.67 for the least certain pixel, towards 0.95 for certain ones;
- colour: the pixel's own, the same from everywhere.

Methods that predict points instead give their z-depth in the predicted camera (`depth_of_points`). Normals are those of the
depth map (`sceneexpander.geometry.normals`) unless the method has its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from sceneexpander.geometry.camera import unproject_to_world
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians, sh_from_rgb
from sceneexpander.geometry.normals import normals_from_depth, viewing_rays
from sceneexpander.geometry.rigid import quat_wxyz_from_rotation, rigid_inverse, transform_points
from sceneexpander.geometry.sampling import band_limited

MAX_OPACITY = 0.95
DOUBT = 0.3  # share of the opacity that the least certain pixel loses
MIN_DEPTH = 1e-6  # of points behind their camera


@dataclass(frozen=True, slots=True, kw_only=True)
class SplatRule:
    """The constants of the rule.

    With the band limit, ``std_px`` comes to 0.67 px across. The rule alone is then closed (alpha above 0.9 for certain pixels) from half
    the size of its pictures to any multiple of it; with 0.4 it is not at half the size.
    """

    std_px: float = 0.5  # standard deviation across before the band limit, in pixels of the Gaussian's own view
    max_stretch: float = 3.0  # along the slant of a surface, 1 / cosine at most
    thickness: float = 0.2  # standard deviation along the normal / across


def pixel_aligned(
    *,
    images: Float[Tensor, "view 3 height width"],
    depth: Float[Tensor, "view height width"],
    depth_conf: Float[Tensor, "view height width"],
    cameras: Cameras,
    normals: Float[Tensor, "view height width 3"] | None = None,
    generated: Bool[Tensor, "view"] | None = None,
    scale_factors: Float[Tensor, "view height width 3"] | None = None,
    rule: SplatRule = SplatRule(),
) -> Gaussians:
    """One Gaussian per pixel, in (view, row, column) order; see the module's text for the rule.

    Positions and scales are differentiable in the depth; cameras, normals and confidences receive no gradient.

    Args:
        images: RGB in [0, 1].
        depth: z-depth, > 0.
        depth_conf: confidence of the depth, > 1.
        cameras: at the images' size.
        normals: camera frame, unit, facing the camera; default: those of the depth map.
        generated: which views are generated (default: none).
        scale_factors: on the scales of the rule, before the band limit (default: 1).
        rule: constants.

    Raises:
        ValueError: if the maps do not have the images' size.
    """
    views, _, height, width = images.shape
    for name, value in (("depth", depth), ("depth_conf", depth_conf)):
        if tuple(value.shape) != (views, height, width):
            raise ValueError(f"{name} has shape {tuple(value.shape)}, the images need {(views, height, width)}")
    poses, intrinsics = cameras.world_from_cam.detach(), cameras.intrinsics_px.detach()
    with torch.no_grad():
        if normals is None:
            normals = normals_from_depth(depth, intrinsics)
        rays = functional.normalize(viewing_rays(intrinsics, height, width), dim=-1)
        rotation_cam, slant_cosine = slant_frame(normals, rays)
        quat = quat_wxyz_from_rotation(poses[:, None, None, :3, :3] @ rotation_cam)
        stretch = 1 / slant_cosine.clamp(min=1 / rule.max_stretch)
        opacities = MAX_OPACITY * (1 - DOUBT / depth_conf)
    focal = (intrinsics[:, 0, 0] * intrinsics[:, 1, 1]).sqrt()[:, None, None]
    across = rule.std_px * depth / focal
    scales = torch.stack([across * stretch, across, across * rule.thickness], dim=-1)
    if scale_factors is not None:
        scales = scales * scale_factors
    source = torch.arange(views, device=depth.device)[:, None, None].expand(views, height, width).flatten()
    flags = torch.zeros(views, dtype=torch.bool, device=depth.device) if generated is None else generated
    return Gaussians(
        means=unproject_to_world(depth, intrinsics, poses).flatten(0, 2),
        quat_wxyz=quat.flatten(0, 2),
        scales=band_limited(scales, depth / focal).flatten(0, 2),
        opacities=opacities.flatten(),
        sh=sh_from_rgb(images.movedim(1, -1)).reshape(-1, 1, 3),
        source_view=source,
        generated=flags[source],
        antialiased=True,
    )


def depth_of_points(
    points: Float[Tensor, "view height width 3"], world_from_cam: Float[Tensor, "view 4 4"]
) -> Float[Tensor, "view height width"]:
    """z-depth (at least 1e-6) of world points in the cameras that see them: what `pixel_aligned` needs of a point map."""
    cam_from_world = rigid_inverse(world_from_cam)
    z = transform_points(cam_from_world, points.flatten(1, 2))[..., 2]
    return z.clamp(min=MIN_DEPTH).view(points.shape[:3])


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
