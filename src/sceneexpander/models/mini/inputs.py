"""From images and priors of any size to the network's input: a fixed working grid, normalised scale, cross-view comparisons.

Everything here is measured, not learned, and carries no gradient. What does not depend on the pictures is measured once per set of
views (`measure`) and picked from there for any subset of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from sceneexpander.geometry.camera import pixel_centres, resize_intrinsics
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gauge import poses_relative_to
from sceneexpander.geometry.lookup import grid_of_pixels, warp_known, warp_maps
from sceneexpander.geometry.normals import normals_from_depth, viewing_rays
from sceneexpander.geometry.priors import EVIDENCE_CHANNELS, Priors
from sceneexpander.models.mini.config import OUTPUT_STRIDE, PATCH_PX, MiniConfig
from sceneexpander.models.mini.pairs import CROSS_VIEW_CHANNELS, PairGeometry

FINE_CHANNELS = 5  # RGB, log base depth, confident
COARSE_CHANNELS = len(EVIDENCE_CHANNELS) + 3 + 2 + CROSS_VIEW_CHANNELS  # evidence, base normals, rays, cross-view
CONFIDENT = EVIDENCE_CHANNELS.index("confident")
SAME_SURFACE = 1.04  # depths within this factor are taken for the same surface

# What brings each evidence channel to a spread of about one.
_EVIDENCE_GAIN = {"cost": 2.0, "ambiguity": 3.0, "parallax": 0.7, "gap": 3.0, "sparse": 3.0, "distance": 0.35}


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredPriors:
    """Priors of which nothing is missing, and all that follows from them alone. Pixels without a base depth hold the median."""

    world_from_cam: Float[Tensor, "view 4 4"]
    intrinsics_px: Float[Tensor, "view 3 3"]
    depth: Float[Tensor, "view height width"]  # > 0 everywhere
    known: Bool[Tensor, "view height width"] | None  # where there is a base depth; None: everywhere
    confident: Float[Tensor, "view height width"]  # 1 where the base is probably right
    posed: Bool[Tensor, "view"]
    log_depth_fine: Float[Tensor, "view fine_height fine_width"]  # at the working resolution
    confident_fine: Float[Tensor, "view fine_height fine_width"]
    coarse: Float[Tensor, "view channel out_height out_width"]  # all coarse channels but the cross-view ones
    base_normals: Float[Tensor, "view out_height out_width 3"]
    pairs: PairGeometry  # of all views that were measured together
    views: tuple[int, ...]  # which of them these are

    def select(self, views: Sequence[int]) -> MeasuredPriors:
        """Some of the views, in the given order; the first of them becomes the world frame."""
        index = torch.as_tensor(views, device=self.depth.device)
        names = ("intrinsics_px", "depth", "confident", "posed", "log_depth_fine", "confident_fine", "coarse")
        picked = {name: getattr(self, name)[index] for name in (*names, "base_normals")}
        poses = self.world_from_cam[index]
        return replace(
            self,
            **picked,
            world_from_cam=poses if views[0] == 0 else poses_relative_to(poses, 0),
            known=None if self.known is None else self.known[index],
            views=tuple(self.views[view] for view in views),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkingViews:
    """The network's input. The coarse grid has half the resolution of the fine one (`OUTPUT_STRIDE`)."""

    fine: Float[Tensor, "view fine height width"]
    coarse: Float[Tensor, "view coarse out_height out_width"]


@dataclass(frozen=True, slots=True, kw_only=True)
class PreparedViews:
    """Images and priors as the network reads them; the same for every set of weights."""

    images: Float[Tensor, "view 3 height width"]
    priors: MeasuredPriors
    scale: float  # median base depth of these views
    working: WorkingViews


def _warped_views(priors: MeasuredPriors, grids: Sequence[Float[Tensor, "height width 2"] | None]) -> MeasuredPriors:
    """What was measured of views whose pictures are warped: all that belongs to a pixel's content moves with it, rays stay."""
    names = ("depth", "confident", "log_depth_fine", "confident_fine", "coarse", "base_normals")
    moved = {name: getattr(priors, name).clone() for name in names}
    known = None if priors.known is None else priors.known.clone()
    evidence = len(EVIDENCE_CHANNELS)
    for view, grid in enumerate(grids):
        if grid is None:
            continue
        fine, half = (_resized_grid(grid, moved[name].shape[-2:]) for name in ("log_depth_fine", "coarse"))
        for name, own in (("depth", grid), ("confident", grid), ("log_depth_fine", fine), ("confident_fine", fine)):
            moved[name][view] = warp_maps(moved[name][view][None], own)[0]
        if known is not None:
            known[view] = warp_known(priors.depth[view], priors.known[view], grid)[1]  # type: ignore[index]
        moved["coarse"][view, :evidence] = warp_maps(priors.coarse[view, :evidence], half)
        # The normals of the surface that the depth has now, as they would be measured; rays are the camera's, and stay.
        rows, columns = half.shape[:2]
        height, width = priors.depth.shape[-2:]
        intrinsics = resize_intrinsics(priors.intrinsics_px[view][None], columns / width, rows / height)
        log_depth = functional.avg_pool2d(moved["log_depth_fine"][view][None, None], OUTPUT_STRIDE)[:, 0]
        normals = normals_from_depth((log_depth - log_depth.median()).exp(), intrinsics)[0]
        moved["base_normals"][view] = normals
        moved["coarse"][view, evidence : evidence + 3] = normals.movedim(-1, 0)
    return replace(priors, **moved, known=known)


def _resized_grid(grid: Float[Tensor, "height width 2"], size: Sequence[int]) -> Float[Tensor, "rows columns 2"]:
    """The same warp for maps of another size: its displacements, which are in shares of the frame."""
    own = _centres(*grid.shape[:2], like=grid)
    offset = functional.interpolate(
        (grid - own).movedim(-1, 0)[None], size=tuple(size), mode="bilinear", antialias=True
    )
    return _centres(size[0], size[1], like=grid) + offset[0].movedim(0, -1)


def _centres(height: int, width: int, *, like: Tensor) -> Float[Tensor, "height width 2"]:
    return grid_of_pixels(pixel_centres(height, width, like=like), height, width)


def _whole(priors: Priors | None, views: int, height: int, width: int) -> dict[str, Tensor]:
    """The fields that are needed, checked."""
    if priors is None:
        raise ValueError("mini needs priors from the geometric front-end (frontend.build_priors), got none")
    shapes = {
        "world_from_cam": (views, 4, 4),
        "intrinsics_px": (views, 3, 3),
        "depth": (views, height, width),
        "evidence": (views, len(EVIDENCE_CHANNELS), height, width),
    }
    given: dict[str, Tensor | None] = {name: getattr(priors, name) for name in shapes}
    missing = sorted(name for name, value in given.items() if value is None)
    if missing:
        raise ValueError(f"mini needs the priors {missing}")
    whole = {name: value for name, value in given.items() if value is not None}
    for name, shape in shapes.items():
        if tuple(whole[name].shape) != shape:
            raise ValueError(f"priors.{name} has shape {tuple(whole[name].shape)}, the images need {shape}")
    return whole


def measure(priors: Priors | None, views: int, height: int, width: int, config: MiniConfig) -> MeasuredPriors:
    """Everything that follows from the priors of some views alone.

    Raises:
        ValueError: a field is missing, a shape does not fit the images, or no depth is positive.
    """
    given = _whole(priors, views, height, width)
    depth, evidence = given["depth"], given["evidence"]
    known = depth > 0
    complete = bool(known.all())
    if not bool(known.any()):
        raise ValueError("priors.depth has no positive value")
    scale = depth[known].median()
    if not complete:
        depth = torch.where(known, depth, scale)
        evidence = torch.where(known[:, None], evidence, torch.zeros_like(evidence))
    size = working_size(height, width, config.work_px)
    out_size = (size[0] // OUTPUT_STRIDE, size[1] // OUTPUT_STRIDE)
    fine = _resample(torch.stack([depth.log(), evidence[:, CONFIDENT]], dim=1), size)
    half = functional.avg_pool2d(fine, OUTPUT_STRIDE)
    intrinsics = resize_intrinsics(given["intrinsics_px"], out_size[1] / width, out_size[0] / height)
    rays = viewing_rays(intrinsics, *out_size)
    base_normals = normals_from_depth((half[:, 0] - scale.log()).exp(), intrinsics)
    gains = evidence.new_tensor([_EVIDENCE_GAIN.get(name, 1.0) for name in EVIDENCE_CHANNELS])
    poses = given["world_from_cam"].clone()
    poses[:, :3, 3] /= scale
    posed = None if priors is None else priors.posed
    posed = torch.ones(views, dtype=torch.bool, device=depth.device) if posed is None else posed
    return MeasuredPriors(
        world_from_cam=given["world_from_cam"],
        intrinsics_px=given["intrinsics_px"],
        depth=depth,
        known=None if complete else known,
        confident=evidence[:, CONFIDENT].contiguous(),
        posed=posed,
        log_depth_fine=fine[:, 0],
        confident_fine=fine[:, 1],
        coarse=torch.cat(
            [
                _resample(evidence, out_size) * gains[:, None, None],
                base_normals.movedim(-1, 1),
                rays[..., :2].movedim(-1, 1),
            ],
            dim=1,
        ),
        base_normals=base_normals,
        pairs=PairGeometry(half[:, 0] - scale.log(), half[:, 1], Cameras(poses, intrinsics, *out_size), posed),
        views=tuple(range(views)),
    )


def prepare(
    images: Float[Tensor, "view 3 height width"],
    priors: MeasuredPriors,
    config: MiniConfig,
    grids: Sequence[Float[Tensor, "height width 2"] | None] = (),
) -> PreparedViews:
    """Everything the network reads, at its working resolution and in the scale of these views.

    With ``grids``, views are warped after they were measured and compared with one another, see `PreparesInputs.prepare`.
    """
    size = (priors.log_depth_fine.shape[-2], priors.log_depth_fine.shape[-1])
    rgb = _resample(images, size)
    crossed = priors.pairs.compare(
        functional.avg_pool2d(rgb, OUTPUT_STRIDE), priors.views, most_views=config.cross_views
    )
    if any(grid is not None for grid in grids):
        priors, images = _warped_views(priors, grids), images.clone()
    for view, grid in enumerate(grids):
        if grid is not None:
            images[view] = warp_maps(images[view], grid)
            rgb[view] = _resample(images[view][None], size)[0]
            crossed[view] = warp_maps(crossed[view], _resized_grid(grid, crossed.shape[-2:]))
    depth = priors.depth if priors.known is None else priors.depth[priors.known]
    scale = depth.median() if depth.numel() else priors.depth.median()
    log_base = priors.log_depth_fine - scale.log()
    fine = torch.cat(
        [(rgb - 0.5) * 4, log_base[:, None], ((priors.confident_fine - 0.5) * 2)[:, None]],
        dim=1,
    ).clamp_(-4, 4)
    working = WorkingViews(fine=fine, coarse=torch.cat([priors.coarse, crossed], dim=1))
    return PreparedViews(images=images, priors=priors, scale=float(scale), working=working)


def working_size(height: int, width: int, work_px: int) -> tuple[int, int]:
    """(height, width) of the working grid: longer side ``work_px``, both multiples of the patch, aspect nearly kept."""
    longer = max(height, width)
    rows, columns = (max(round(side * work_px / longer / PATCH_PX), 2) * PATCH_PX for side in (height, width))
    return rows, columns


def _resample(maps: Float[Tensor, "view channel height width"], size: tuple[int, int]) -> Tensor:
    """Area average when shrinking, bilinear when growing."""
    return functional.interpolate(maps, size=size, mode="bilinear", antialias=True, align_corners=False)
