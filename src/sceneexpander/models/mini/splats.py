"""Pixel-aligned Gaussians from depth, cameras, normals and colours: an analytic rule plus learned residuals."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.models.mini.config import MiniConfig
from sceneexpander.models.mini.inputs import SAME_SURFACE
from sceneexpander.models.pixel_aligned import SplatRule, pixel_aligned

SPLAT_RESIDUALS = 4  # log scale along the slant, log scale across, opacity logit, log depth offset
_OPACITY_RANGE = (0.01, 0.97)  # of the analytic opacity, so that its logit stays finite
_SNAP_ROUNDS = 3
_SNAP_STEP = 0.08  # range of log depth within 3x3 pixels from which on it is an edge and not a slanted surface
_LOG_SCALE_LIMIT = (
    2.0  # Gaussians may get wider than the rule makes them, not narrower: at a larger size a surface would fall apart
)
_OFFSET_LIMIT = 0.05  # the learned offset moves a Gaussian by 5 % of its depth at most


def pixel_aligned_gaussians(
    images: Float[Tensor, "view 3 height width"],
    depth: Float[Tensor, "view height width"],
    depth_conf: Float[Tensor, "view height width"],
    normals: Float[Tensor, "view height width 3"],
    cameras: Cameras,
    transparent: Float[Tensor, "view height width"],
    residuals: Float[Tensor, "view 4 height width"],
    generated: Bool[Tensor, "view"],
    config: MiniConfig,
) -> tuple[Gaussians, Float[Tensor, "view height width"]]:
    """One Gaussian per pixel, in (view, row, column) order, and the depth that placed them.

    With all residuals zero they are those of `sceneexpander.models.pixel_aligned`, opacities times 1 - ``transparent``.
    Cameras and normals receive no gradient from here.
    """
    log_scale, opacity_logit, offset = residuals[:, :2], residuals[:, 2], residuals[:, 3]
    learned = log_scale.clamp(0, _LOG_SCALE_LIMIT).exp().movedim(1, -1)
    splat_depth = snap_to_surfaces(depth) * (_OFFSET_LIMIT * torch.tanh(offset)).exp()
    analytic = pixel_aligned(
        images=images,
        depth=splat_depth,
        depth_conf=depth_conf,
        cameras=cameras,
        normals=normals,
        generated=generated,
        scale_factors=functional.pad(learned, (0, 1), value=1.0),
        rule=SplatRule(std_px=config.splat_std_px, max_stretch=config.max_stretch, thickness=config.splat_thickness),
    )
    base_logit = torch.logit((analytic.opacities * (1 - transparent.flatten())).clamp(*_OPACITY_RANGE))
    gaussians = replace(
        analytic,
        opacities=torch.sigmoid(base_logit + opacity_logit.flatten()),
    )
    return gaussians, splat_depth


def snap_to_surfaces(depth: Float[Tensor, "view height width"]) -> Float[Tensor, "view height width"]:
    """Depth without in-between values at the edges of objects: a pixel between two surfaces joins the nearer one in log depth.

    Such values come from smoothing and upsampling; a Gaussian placed there floats between the surfaces. A few rounds of 3x3
    neighbourhoods turn a blurred step of several pixels into a sharp one; smooth surfaces stay as they are.
    """
    log_depth = depth.log()[:, None]
    for _ in range(_SNAP_ROUNDS):
        far = functional.max_pool2d(log_depth, 3, stride=1, padding=1)
        near = -functional.max_pool2d(-log_depth, 3, stride=1, padding=1)
        joined = torch.where(log_depth - near < far - log_depth, near, far)
        log_depth = torch.where(far - near > _SNAP_STEP, joined, log_depth)
    return log_depth[:, 0].exp()


@torch.no_grad()
def covered_by_others(
    depth: Float[Tensor, "view height width"],
    confident: Float[Tensor, "view height width"],
    cameras: Cameras,
    posed: Bool[Tensor, "view"],
    *,
    most_views: int,
) -> Float[Tensor, "view height width"]:
    """1 where a pixel's Gaussian must give way to what other views see, 0 where it stays.

    It gives way if it is a guess and another view confidently sees the same space (its surface, or free space there), or, guess or not,
    if at least two more views look through it than see it: floaters at the edges of objects. A guess behind another view's confident
    surface is hidden from that view and stays. A view without a pose covers nothing, and gives way to everything that a posed view sees.
    """
    views, height, width = depth.shape
    out = torch.zeros_like(depth)
    if views == 1:
        return out
    log_depth = depth.log()
    content = torch.stack([log_depth, confident], dim=1)
    points = cameras.unproject(depth).flatten(1, 2)
    centres = cameras.centres
    tolerance = torch.tensor(SAME_SURFACE).log()
    for view in range(views):
        candidates = posed.clone()
        candidates[view] = False
        others = torch.nonzero(candidates)[:, 0]
        if not len(others):
            continue
        distance = (centres[others] - centres[view]).square().sum(-1)
        others = others[distance.argsort()[:most_views]]
        seen, found = cameras[others].look_up(points[view], content[others])
        log_z, in_frame = found.depth.log(), found.in_frame
        sees = in_frame & (log_z < seen[:, 0] + tolerance)
        if bool(posed[view]):
            covered = (seen[:, 1] * sees).amax(0).view(height, width) * (1 - confident[view])
            through = (in_frame & (log_z < seen[:, 0] - tolerance)).sum(0)
            agrees = (in_frame & ((log_z - seen[:, 0]).abs() <= tolerance)).sum(0)
            # Two witnesses, not one: a single inserted view with wrong depth must not carve the captured scene.
            contradicted = (through > agrees + 1).view(height, width)
            out[view] = torch.maximum(covered, contradicted.to(depth.dtype))
        else:
            out[view] = sees.any(0).view(height, width).to(depth.dtype)
    return out
