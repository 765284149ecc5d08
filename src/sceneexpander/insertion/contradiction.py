"""What photos contradict in generated views fades, in the scene and in the fit (beyond the paper).

A generated Gaussian is looked up in every captured view. Where one of them sees that very place, it is only as good as its agreement with
the photo there, in depth and colour; where none does, nothing contradicts it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.geometry.agreement import agreement, colour_difference
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians, rgb_from_sh
from sceneexpander.insertion.protocol import RoundContext, RoundInputs
from sceneexpander.splatting import render

SAME_COLOUR = 0.1  # mean absolute RGB difference that still counts as the same surface
LOST = 0.3  # of its opacity is what a Gaussian keeps whose view has no camera


@dataclass(frozen=True, slots=True, kw_only=True)
class Contradiction:
    """Doubt about generated views. The fit weighs their pixels by `pixel_trust` where it is on."""

    fade: bool = False  # generated Gaussians fade where captured views contradict them

    def correct_scene(self, scene: Reconstruction, inputs: RoundInputs, context: RoundContext) -> Reconstruction:
        """See `fade_contradicted`."""
        return fade_contradicted(scene, inputs.views.images) if self.fade else scene


def fade_contradicted(reconstruction: Reconstruction, images: Float[Tensor, "view 3 height width"]) -> Reconstruction:
    """The same reconstruction with generated Gaussians as opaque as the captured views let them be, see `opacity_factors`."""
    gaussians, generated = reconstruction.gaussians, reconstruction.generated
    posed = reconstruction.posed
    factors = opacity_factors(gaussians, reconstruction.depth, reconstruction.cameras, generated, posed, images)
    if factors is None:
        return reconstruction
    return replace(reconstruction, gaussians=replace(gaussians, opacities=gaussians.opacities * factors))


@torch.no_grad()
def opacity_factors(
    gaussians: Gaussians,
    depth: Float[Tensor, "view height width"],
    cameras: Cameras,
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
    colours = rgb_from_sh(gaussians.sh[made, 0])
    agrees = _agrees(gaussians.means[made], colours, images[captured], depth[captured], cameras[captured])
    filled = filled_by_captured(gaussians, cameras, generated)
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
    cameras = reconstruction.cameras
    trust, captured = torch.ones_like(depth), ~generated & reconstruction.posed
    if not bool(captured.any()):
        return trust
    for view in torch.nonzero(generated)[:, 0].tolist():
        points = cameras[view].unproject(depth[view : view + 1]).reshape(-1, 3)
        colours = images[view].flatten(1).T
        agrees = _agrees(points, colours, images[captured], depth[captured], cameras[captured])
        trust[view] = agrees.view_as(depth[view])
    return trust


def _agrees(
    points_world: Float[Tensor, "point 3"],
    colours: Float[Tensor, "point 3"],
    captured_images: Float[Tensor, "view 3 height width"],
    captured_depth: Float[Tensor, "view height width"],
    captured: Cameras,
) -> Float[Tensor, "point"]:
    """1 where nothing contradicts a coloured point, falling to 0 as captured views see another place or colour there."""
    found = agreement(points_world, captured_depth, captured)
    off = colour_difference(points_world, colours, captured_images, captured_depth, captured)
    return found.weight * torch.where(found.seen, torch.exp(-((off / SAME_COLOUR) ** 2) / 2), 1.0)


@torch.no_grad()
def filled_by_captured(
    gaussians: Gaussians, cameras: Cameras, generated: Bool[Tensor, "view"]
) -> Float[Tensor, "gaussian"]:
    """For every Gaussian of a generated view: how far captured Gaussians alone fill its pixel, seen from that view. 0 for the others."""
    filled = torch.zeros_like(gaussians.opacities)
    for view in torch.nonzero(generated)[:, 0].tolist():
        alpha = captured_alpha(gaussians, cameras[view])
        own = gaussians.source_view == view
        there, found = cameras[view].look_up(gaussians.means[own], alpha[:, None])
        filled[own] = torch.where(found.in_frame[0], there[0, 0], 0.0).clamp(0, 1)
    return filled


def captured_alpha(gaussians: Gaussians, camera: Cameras) -> Float[Tensor, "camera height width"]:
    """How opaque captured Gaussians alone are."""
    return render(gaussians.select(~gaussians.generated), camera).alpha
