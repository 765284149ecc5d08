"""How far the inserted view agrees with what the captured views saw, point by point (beyond the paper).

A point is looked up in every captured view. Where one of them sees that very place, the inserted view is only as good as its
agreement with the captured depth; where none does, nothing contradicts it and its own confidence decides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.geometry.camera import unproject_to_world
from sceneexpander.geometry.gaussians import Gaussians, rgb_from_sh
from sceneexpander.geometry.lookup import seen_at
from sceneexpander.models.protocol import Prediction
from sceneexpander.splatting import render

SAME_SURFACE = 0.04  # log-depth difference that still counts as the same surface
SAME_COLOUR = 0.1  # mean absolute RGB difference, the same way
LOST = 0.3  # of its opacity is what a Gaussian keeps whose view has no camera
_HIDDEN = 3 * SAME_SURFACE  # a point further behind what a view sees is hidden from it


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """Of points with captured depth maps.

    ``weight`` is 1 where nothing contradicts the point and falls to 0 with the log-depth difference to the best agreeing view;
    ``seen``: some captured view has the point in frame and not hidden; ``conflict``: the signed log ratio (point / captured depth) in the
    view that agrees best, negative in front; 0 where not seen.
    """

    weight: Float[Tensor, "*point"]
    seen: Bool[Tensor, "*point"]
    conflict: Float[Tensor, "*point"]


@torch.no_grad()
def agreement(
    points_world: Float[Tensor, "*point 3"],
    captured_depth: Float[Tensor, "view height width"],
    captured_world_from_cam: Float[Tensor, "view 4 4"],
    captured_intrinsics_px: Float[Tensor, "view 3 3"],
) -> Agreement:
    """Compare points with the captured views' depth maps, all in one frame and scale."""
    points = points_world.reshape(-1, 3)
    there, z, in_frame = seen_at(
        points, captured_depth[:, None], captured_world_from_cam, captured_intrinsics_px, "nearest"
    )
    ratio = torch.where(in_frame, (z / there[:, 0].clamp(min=1e-6)).log(), torch.inf)
    # Behind what a view sees, the point is hidden from it: no evidence either way.
    visible = in_frame & (ratio < _HIDDEN)
    distance = torch.where(visible, ratio.abs(), torch.inf)
    nearest, view = distance.min(0)
    seen = nearest.isfinite()
    conflict = torch.where(seen, ratio.gather(0, view[None])[0], 0.0)
    weight = torch.where(seen, torch.exp(-((conflict / SAME_SURFACE) ** 2) / 2), 1.0)
    shape = points_world.shape[:-1]
    return Agreement(weight=weight.view(shape), seen=seen.view(shape), conflict=conflict.view(shape))


def confidence_weight(confidence: Float[Tensor, "*batch height width"]) -> Float[Tensor, "*batch height width"]:
    """A confidence (> 1, larger is surer) as a weight in [0, 1): 1 - 1 / confidence."""
    return 1 - 1 / confidence.clamp(min=1)


@torch.no_grad()
def inserted_weights(
    prediction: Prediction, anchored_depth: Float[Tensor, "captured height width"]
) -> Float[Tensor, "1 height width"]:
    """Weights of the inserted view's pixels with mean 1: agreement with the captured views x the model's own confidence.

    Args:
        prediction: of some captured views, then the inserted one.
        anchored_depth: of those captured views.
    """
    count = len(anchored_depth)
    if prediction.depth is None:
        raise ValueError("the weights need the depth head")
    poses, intrinsics = prediction.world_from_cam, prediction.intrinsics_px
    points = unproject_to_world(prediction.depth[count:], intrinsics[count:], poses[count:])[0]
    weight = agreement(points, anchored_depth, poses[:count], intrinsics[:count]).weight
    if prediction.depth_conf is not None:
        weight = weight * confidence_weight(prediction.depth_conf[count])
    return (weight / weight.mean().clamp(min=1e-6))[None]


def trusted(reconstruction: Reconstruction, images: Float[Tensor, "view 3 height width"]) -> Reconstruction:
    """The same reconstruction with generated Gaussians as opaque as the captured views let them be, see `trust_factors`."""
    gaussians, generated = reconstruction.gaussians, reconstruction.generated
    cameras = reconstruction.world_from_cam, reconstruction.intrinsics_px
    factors = trust_factors(gaussians, reconstruction.depth, *cameras, generated, reconstruction.posed, images)
    if factors is None:
        return reconstruction
    return replace(reconstruction, gaussians=replace(gaussians, opacities=gaussians.opacities * factors))


@torch.no_grad()
def trust_factors(
    gaussians: Gaussians,
    depth: Float[Tensor, "view height width"],
    world_from_cam: Float[Tensor, "view 4 4"],
    intrinsics_px: Float[Tensor, "view 3 3"],
    generated: Bool[Tensor, "view"],
    posed: Bool[Tensor, "view"],
    images: Float[Tensor, "view 3 height width"],
) -> Float[Tensor, "gaussian"] | None:
    """What to multiply opacities by: 1 for captured Gaussians; None if there is nothing to compare.

    A Gaussian of a generated view is left as much of its opacity as its place and its colour agree with the captured views that
    see it: what stands in space that a photo looks through fades, and so does what is painted onto a surface that a photo shows
    in another colour. What no captured view sees stays as it is, and so does what fills a gap between the captured views' own
    Gaussians. It also fades a requested object that stands where the photos show it is not.

    Where the Gaussians of a view without a camera (``posed``) are means nothing, so nothing is compared with them or with it. They
    would stand in front of the photos, so they are made faint (`LOST`); a fit makes of them what the photos can use.
    """
    captured, placed = ~generated & posed, posed[gaussians.source_view]
    made = gaussians.generated & placed
    if not bool(gaussians.generated.any()) or not bool(captured.any()):
        return None
    cameras = world_from_cam[captured], intrinsics_px[captured]
    agrees = _agrees(
        gaussians.means[made], rgb_from_sh(gaussians.sh[made, 0]), images[captured], depth[captured], *cameras
    )
    filled = filled_by_captured(gaussians, world_from_cam, intrinsics_px, generated, *depth.shape[1:])
    factors = torch.where(gaussians.generated & ~placed, LOST, torch.ones_like(gaussians.opacities))
    factors[made] = 1 - filled[made] * (1 - agrees)
    return factors


@torch.no_grad()
def pixel_trust(
    reconstruction: Reconstruction, images: Float[Tensor, "view 3 height width"]
) -> Float[Tensor, "view height width"]:
    """How far to believe each pixel of each picture: 1 in captured views and where no captured view sees what a generated one shows.

    Elsewhere in generated views it falls with the difference to the captured view that agrees best, in place and in colour.
    """
    depth, generated = reconstruction.depth, reconstruction.generated
    poses, intrinsics = reconstruction.world_from_cam, reconstruction.intrinsics_px
    trust, captured = torch.ones_like(depth), ~generated & reconstruction.posed
    if not bool(captured.any()):
        return trust
    cameras = poses[captured], intrinsics[captured]
    for view in torch.nonzero(generated)[:, 0].tolist():
        one = slice(view, view + 1)
        points = unproject_to_world(depth[one], intrinsics[one], poses[one]).reshape(-1, 3)
        colours = images[view].flatten(1).T
        trust[view] = _agrees(points, colours, images[captured], depth[captured], *cameras).view_as(depth[view])
    return trust


def _agrees(
    points_world: Float[Tensor, "point 3"],
    colours: Float[Tensor, "point 3"],
    captured_images: Float[Tensor, "view 3 height width"],
    captured_depth: Float[Tensor, "view height width"],
    captured_world_from_cam: Float[Tensor, "view 4 4"],
    captured_intrinsics_px: Float[Tensor, "view 3 3"],
) -> Float[Tensor, "point"]:
    """1 where nothing contradicts a coloured point, falling to 0 as captured views see another place or colour there."""
    cameras = captured_world_from_cam, captured_intrinsics_px
    found = agreement(points_world, captured_depth, *cameras)
    off = colour_difference(points_world, colours, captured_images, captured_depth, *cameras)
    return found.weight * torch.where(found.seen, torch.exp(-((off / SAME_COLOUR) ** 2) / 2), 1.0)


@torch.no_grad()
def filled_by_captured(
    gaussians: Gaussians, world_from_cam: Tensor, intrinsics_px: Tensor, generated: Tensor, height: int, width: int
) -> Float[Tensor, "gaussian"]:
    """For every Gaussian of a generated view: how far captured Gaussians alone fill its pixel, seen from that view. 0 for the others."""
    taken = gaussians.select(~gaussians.generated)
    filled = torch.zeros_like(gaussians.opacities)
    for view in torch.nonzero(generated)[:, 0].tolist():
        camera = world_from_cam[view][None], intrinsics_px[view][None]
        alpha = render(taken, *camera, height, width).alpha
        own = gaussians.source_view == view
        there, _, in_frame = seen_at(gaussians.means[own], alpha[:, None], *camera, "bilinear")
        filled[own] = torch.where(in_frame[0], there[0, 0], 0.0).clamp(0, 1)
    return filled


@torch.no_grad()
def colour_difference(
    points_world: Float[Tensor, "point 3"],
    colours: Float[Tensor, "point 3"],
    captured_images: Float[Tensor, "view 3 height width"],
    captured_depth: Float[Tensor, "view height width"],
    captured_world_from_cam: Float[Tensor, "view 4 4"],
    captured_intrinsics_px: Float[Tensor, "view 3 3"],
) -> Float[Tensor, "point"]:
    """Mean absolute RGB difference of points to the captured view that fits best of those that see them; 0 where none does."""
    content = torch.cat([captured_images, captured_depth[:, None]], dim=1)
    there, z, in_frame = seen_at(points_world, content, captured_world_from_cam, captured_intrinsics_px, "bilinear")
    visible = in_frame & ((z / there[:, 3].clamp(min=1e-6)).log() < _HIDDEN)
    off = (there[:, :3] - colours.T).abs().mean(1)
    best = torch.where(visible, off, torch.inf).amin(0)
    return torch.where(best.isfinite(), best, 0.0)
