"""From images and priors of any size to the network's input: a fixed working grid, normalised scale, cross-view comparisons.

Everything here is measured, not learned, and carries no gradient.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from sceneexpander.geometry.camera import resize_intrinsics
from sceneexpander.geometry.normals import normals_from_depth, viewing_rays
from sceneexpander.geometry.priors import EVIDENCE_CHANNELS, Priors
from sceneexpander.geometry.rigid import rigid_inverse, transform_points
from sceneexpander.models.mini.config import OUTPUT_STRIDE, PATCH_PX, MiniConfig

FINE_CHANNELS = 5  # RGB, log base depth, confident
CROSS_VIEW_CHANNELS = 6  # see `compare_views`
COARSE_CHANNELS = len(EVIDENCE_CHANNELS) + 3 + 2 + CROSS_VIEW_CHANNELS  # evidence, base normals, rays, cross-view
CONFIDENT = EVIDENCE_CHANNELS.index("confident")
SAME_SURFACE = 1.04  # depths within this factor are taken for the same surface

# What brings each evidence channel to a spread of about one.
_EVIDENCE_GAIN = {"cost": 2.0, "ambiguity": 3.0, "parallax": 0.7, "gap": 3.0, "sparse": 3.0, "distance": 0.35}


@dataclass(frozen=True, slots=True, kw_only=True)
class RequiredPriors:
    """`Priors` of which nothing is missing, as `Mini` needs them. Pixels without a base depth hold the scene's median."""

    world_from_cam: Float[Tensor, "view 4 4"]
    intrinsics_px: Float[Tensor, "view 3 3"]
    depth: Float[Tensor, "view height width"]  # > 0 everywhere
    evidence: Float[Tensor, "view channel height width"]
    posed: Bool[Tensor, "view"]
    scale: float  # median base depth of the scene

    @property
    def confident(self) -> Float[Tensor, "view height width"]:
        """1 where the cross-view check passed."""
        return self.evidence[:, CONFIDENT]


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkingViews:
    """The network's input. The coarse grid has half the resolution of the fine one (`OUTPUT_STRIDE`)."""

    fine: Float[Tensor, "view fine height width"]
    coarse: Float[Tensor, "view coarse out_height out_width"]
    base_normals: Float[Tensor, "view out_height out_width 3"]
    rays: Float[Tensor, "view out_height out_width 3"]


def require_priors(images: Float[Tensor, "view 3 height width"], priors: Priors | None) -> RequiredPriors:
    """Check that the priors are whole and fit the images.

    Raises:
        ValueError: a field is missing, a shape does not fit, or no depth is positive.
    """
    if priors is None:
        raise ValueError("mini needs priors from the geometric front-end (frontend.build_priors), got none")
    poses, intrinsics, depth, evidence = (
        priors.world_from_cam,
        priors.intrinsics_px,
        priors.depth,
        priors.evidence,
    )
    if poses is None or intrinsics is None or depth is None or evidence is None:
        given = {"world_from_cam": poses, "intrinsics_px": intrinsics, "depth": depth, "evidence": evidence}
        raise ValueError(f"mini needs the priors {sorted(name for name, value in given.items() if value is None)}")
    views, _, height, width = images.shape
    expected = {
        "world_from_cam": (poses, (views, 4, 4)),
        "intrinsics_px": (intrinsics, (views, 3, 3)),
        "depth": (depth, (views, height, width)),
        "evidence": (evidence, (views, len(EVIDENCE_CHANNELS), height, width)),
    }
    for name, (value, shape) in expected.items():
        if tuple(value.shape) != shape:
            raise ValueError(f"priors.{name} has shape {tuple(value.shape)}, the images need {shape}")
    known = depth > 0
    if not bool(known.any()):
        raise ValueError("priors.depth has no positive value")
    scale = depth[known].median()
    return RequiredPriors(
        world_from_cam=poses,
        intrinsics_px=intrinsics,
        depth=torch.where(known, depth, scale),
        evidence=torch.where(known[:, None], evidence, torch.zeros_like(evidence)),
        posed=torch.ones(views, dtype=torch.bool, device=images.device) if priors.posed is None else priors.posed,
        scale=float(scale),
    )


def working_size(height: int, width: int, work_px: int) -> tuple[int, int]:
    """(height, width) of the working grid: longer side ``work_px``, both multiples of the patch, aspect nearly kept."""
    longer = max(height, width)
    rows, columns = (max(round(side * work_px / longer / PATCH_PX), 2) * PATCH_PX for side in (height, width))
    return rows, columns


def working_views(
    images: Float[Tensor, "view 3 height width"], priors: RequiredPriors, config: MiniConfig
) -> WorkingViews:
    """Everything the network reads, at its working resolution."""
    height, width = images.shape[-2:]
    size = working_size(height, width, config.work_px)
    out_size = (size[0] // OUTPUT_STRIDE, size[1] // OUTPUT_STRIDE)
    log_base = (priors.depth / priors.scale).log()[:, None]
    fine = _resample(torch.cat([images, log_base, priors.evidence[:, CONFIDENT, None]], dim=1), size)
    half = functional.avg_pool2d(fine, OUTPUT_STRIDE)
    evidence = _resample(priors.evidence, out_size)
    intrinsics = resize_intrinsics(priors.intrinsics_px, out_size[1] / width, out_size[0] / height)
    rays = viewing_rays(intrinsics, *out_size)
    base_normals = normals_from_depth(half[:, 3].exp(), intrinsics)
    poses = priors.world_from_cam.clone()
    poses[:, :3, 3] /= priors.scale
    crossed = compare_views(
        half[:, :3], half[:, 3], half[:, 4], poses, intrinsics, priors.posed, most_views=config.cross_views
    )
    gains = evidence.new_tensor([_EVIDENCE_GAIN.get(name, 1.0) for name in EVIDENCE_CHANNELS])
    coarse = torch.cat(
        [evidence * gains[:, None, None], base_normals.movedim(-1, 1), rays[..., :2].movedim(-1, 1), crossed], dim=1
    )
    centred = fine - fine.new_tensor([0.5, 0.5, 0.5, 0.0, 0.5])[:, None, None]
    fine = (centred * fine.new_tensor([4.0, 4.0, 4.0, 1.0, 2.0])[:, None, None]).clamp(-4, 4)
    return WorkingViews(fine=fine, coarse=coarse, base_normals=base_normals, rays=rays)


def compare_views(
    images: Float[Tensor, "view 3 height width"],
    log_depth: Float[Tensor, "view height width"],
    confident: Float[Tensor, "view height width"],
    world_from_cam: Float[Tensor, "view 4 4"],
    intrinsics_px: Float[Tensor, "view 3 3"],
    posed: Bool[Tensor, "view"],
    *,
    most_views: int,
) -> Float[Tensor, "view 6 height width"]:
    """What the other posed views say about each pixel's base depth; zeros where none says anything.

    Channels: (0) smallest colour difference to any other view at the reprojection; (1) share of the other views that
    have the point in frame; (2) how far behind, (3) how far in front of confident surfaces of other views it lies (mean
    log ratio over them); (4) log of the nearest confident surface of other views seen in this pixel / base depth; (5)
    whether there is one.

    Args:
        images: RGB, at the resolution of the depth.
        log_depth: natural logarithm of the base depth, in the poses' scale.
        confident: share of confident pixels.
        world_from_cam: camera poses.
        intrinsics_px: intrinsics at the resolution of the depth.
        posed: views whose pose is only a placeholder take no part.
        most_views: each view is compared with this many others at most, those with the nearest cameras.
    """
    views, height, width = log_depth.shape
    out = images.new_zeros(views, CROSS_VIEW_CHANNELS, height, width)
    points_cam = viewing_rays(intrinsics_px, height, width) * log_depth.exp()[..., None]
    points_world = transform_points(world_from_cam, points_cam.flatten(1, 2))
    cam_from_world = rigid_inverse(world_from_cam)
    content = torch.cat([images, log_depth[:, None], confident[:, None]], dim=1)
    centres = world_from_cam[:, :3, 3]
    for view in range(views):
        others = [other for other in range(views) if other != view and bool(posed[other])]
        if not others or not bool(posed[view]):
            continue
        others.sort(key=lambda other: float((centres[other] - centres[view]).square().sum()))
        chosen = torch.tensor(others[:most_views], device=images.device)
        seen, log_z, in_frame = sample_other_views(
            points_world[view], content[chosen], cam_from_world[chosen], intrinsics_px[chosen]
        )
        colour = (seen[:, :3] - images[view].flatten(1)).abs().mean(1)
        out[view, 0] = torch.where(in_frame, colour, 1.0).amin(0).view(height, width) * in_frame.any(0).view(
            height, width
        )
        out[view, 1] = in_frame.float().mean(0).view(height, width)
        weight = seen[:, 4] * in_frame
        total = weight.sum(0).clamp(min=0.5)
        behind = (log_z - seen[:, 3]).clamp(-1, 1)
        out[view, 2] = ((weight * behind.clamp(min=0)).sum(0) / total).view(height, width)
        out[view, 3] = ((weight * (-behind).clamp(min=0)).sum(0) / total).view(height, width)
        sure = confident[chosen].flatten(1) > 0.5
        nearest = splat_log_depth(points_world[chosen][sure], cam_from_world[view], intrinsics_px[view], height, width)
        found = nearest.isfinite()
        out[view, 4] = torch.where(found, (nearest - log_depth[view]).clamp(-1, 1), 0.0)
        out[view, 5] = found.float()
    return out


def sample_other_views(
    points_world: Float[Tensor, "point 3"],
    content: Float[Tensor, "other channel height width"],
    cam_from_world: Float[Tensor, "other 4 4"],
    intrinsics_px: Float[Tensor, "other 3 3"],
) -> tuple[Float[Tensor, "other channel point"], Float[Tensor, "other point"], Bool[Tensor, "other point"]]:
    """(content of other views where the points project, log of the points' depth there, whether they are in frame)."""
    height, width = content.shape[-2:]
    points = transform_points(cam_from_world, points_world.expand(len(content), -1, -1))
    depth = points[..., 2]
    pixel = (points @ intrinsics_px.transpose(-1, -2))[..., :2] / depth.clamp(min=1e-6)[..., None]
    grid = pixel / pixel.new_tensor([width / 2, height / 2]) - 1
    in_frame = (depth > 1e-6) & (grid.abs() < 1).all(-1)
    # Far outside coordinates would overflow the sampler's integers.
    sampled = functional.grid_sample(
        content, grid.clamp(-2, 2)[:, :, None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return sampled[..., 0], depth.clamp(min=1e-6).log(), in_frame


def splat_log_depth(
    points_world: Float[Tensor, "point 3"],
    cam_from_world: Float[Tensor, "4 4"],
    intrinsics_px: Float[Tensor, "3 3"],
    height: int,
    width: int,
) -> Float[Tensor, "height width"]:
    """Log depth of the nearest point that falls in each pixel, infinite where there is none."""
    points = transform_points(cam_from_world, points_world)
    depth = points[:, 2]
    pixel = (points @ intrinsics_px.T)[:, :2] / depth.clamp(min=1e-6)[:, None]
    column, row = pixel.floor().long().unbind(-1)
    kept = (depth > 1e-6) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    nearest = depth.new_full((height * width,), torch.inf)
    index = (row * width + column)[kept]
    return nearest.scatter_reduce(0, index, depth[kept].log(), reduce="amin").view(height, width)


def _resample(maps: Float[Tensor, "view channel height width"], size: tuple[int, int]) -> Tensor:
    """Area average when shrinking, bilinear when growing."""
    return functional.interpolate(maps, size=size, mode="bilinear", antialias=True, align_corners=False)
