"""What a generated picture shows does not stand where the photos see through (beyond the paper).

Of a part in which nothing can be matched, such as a smooth continuation, a model knows the direction and guesses the distance. A guess
that is too near stands in space which the photos look through. They make it fade, and where they show nothing behind it, a hole is left.
Space carving (Kutulakos and Seitz, 2000) says where on its ray such a point may be: not before the photos stop seeing through.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.geometry.agreement import SAME_SURFACE, agreement
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.insertion.contradiction import captured_alpha
from sceneexpander.insertion.protocol import RoundContext, RoundInputs

_STEP = SAME_SURFACE / 2  # of the logarithm of the distance
_FARTHEST = 16.0  # of its distance: what is in free space up to there stays
_FREE = 0.5  # agreement with the photos below which a point in front of what they see stands in free space
_MARGIN = 0.04  # of a photo's longer side: so far beyond its edge it is taken to see what it sees at the edge
_FILLED = 0.5  # alpha of captured Gaussians from which on they show a pixel


@dataclass(frozen=True, slots=True, kw_only=True)
class FreeSpace:
    """Whether generated Gaussians keep out of space that photos look through, see `leave_free_space`."""

    clear: bool = False

    def correct_scene(self, scene: Reconstruction, inputs: RoundInputs, context: RoundContext) -> Reconstruction:
        """See `leave_free_space`."""
        return leave_free_space(scene) if self.clear else scene


@torch.no_grad()
def leave_free_space(reconstruction: Reconstruction) -> Reconstruction:
    """The same reconstruction, its generated Gaussians in free space moved away from their own view's camera, as far as they have to be.

    Moved is what stands in front of what a captured view sees there, or at its edge if it is right beside, and lies in a pixel of its own
    view that captured Gaussians do not fill: elsewhere they show what is behind it. A Gaussian goes along its ray to the first place that
    no captured view contradicts, and grows with its distance, so that its own view shows it as before. The view's depth goes with it.
    Views without a camera stay.
    """
    cameras, generated = reconstruction.cameras, reconstruction.generated
    captured = ~generated & reconstruction.posed
    views = torch.nonzero(generated & reconstruction.posed)[:, 0].tolist()
    if not views or not bool(captured.any()):
        return reconstruction
    seen, seen_from = _with_margin(reconstruction.depth[captured], cameras[captured])
    gaussians, depth = reconstruction.gaussians, reconstruction.depth.clone()
    means, scales = gaussians.means.clone(), gaussians.scales.clone()
    for view in views:
        camera, centre = cameras[view], cameras.centres[view]
        alpha = captured_alpha(gaussians, camera)
        own = torch.nonzero(gaussians.source_view == view)[:, 0]
        there, _ = camera.look_up(means[own], alpha[:, None])
        factors = _to_free_end(means[own], centre, there[0, 0], seen, seen_from)
        means[own] = centre + (means[own] - centre) * factors[:, None]
        scales[own] *= factors[:, None]
        points = camera.unproject(depth[view : view + 1]).reshape(-1, 3)
        depth[view] *= _to_free_end(points, centre, alpha.flatten(), seen, seen_from).view_as(depth[view])
    return replace(reconstruction, depth=depth, gaussians=replace(gaussians, means=means, scales=scales))


def _with_margin(
    depth: Float[Tensor, "view height width"], cameras: Cameras
) -> tuple[Float[Tensor, "view height_and_margins width_and_margins"], Cameras]:
    """Depth maps continued beyond their edges, and their cameras.

    A Gaussian has a size: with its mean just outside of a photo it would reach into the picture, before all that is seen there.
    """
    margin = round(_MARGIN * max(depth.shape[1:]))
    wider = torch.nn.functional.pad(depth[:, None], (margin,) * 4, mode="replicate")[:, 0]
    intrinsics = cameras.intrinsics_px.clone()
    intrinsics[:, :2, 2] += margin
    return wider, Cameras(cameras.world_from_cam, intrinsics, *wider.shape[1:])


def _to_free_end(
    points_world: Float[Tensor, "point 3"],
    centre_world: Float[Tensor, "3"],
    filled: Float[Tensor, "point"],
    captured_depth: Float[Tensor, "view height width"],
    captured: Cameras,
) -> Float[Tensor, "point"]:
    """What to multiply distances from a camera's centre by, for points in free space to leave it; 1 for the others.

    Points in pixels that are ``filled``, and points that are in free space all the way, get 1 as well.
    """
    factors = torch.ones_like(filled)
    found = agreement(points_world, captured_depth, captured)
    left = torch.nonzero((found.weight < _FREE) & (found.conflict < 0) & (filled < _FILLED))[:, 0]
    for step in range(1, int(math.log(_FARTHEST) / _STEP) + 1):
        if len(left) == 0:
            break
        factor = math.exp(step * _STEP)
        tried = centre_world + (points_world[left] - centre_world) * factor
        arrived = agreement(tried, captured_depth, captured).weight >= _FREE
        factors[left[arrived]] = factor
        left = left[~arrived]
    return factors
