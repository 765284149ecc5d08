"""How far points agree with what views saw: in place by their depth maps, in colour by their pictures.

A point is looked up in every view. Where one of them sees that very place, its depth and colour say whether the point is there; where
none does, there is no evidence either way.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.geometry.cameras import Cameras

SAME_SURFACE = 0.04  # log-depth difference that still counts as the same surface
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
    captured: Cameras,
) -> Agreement:
    """Compare points with the captured views' depth maps, all in one frame and scale."""
    there, found = captured.look_up(points_world.reshape(-1, 3), captured_depth[:, None], "nearest")
    ratio = torch.where(found.in_frame, (found.depth / there[:, 0].clamp(min=1e-6)).log(), torch.inf)
    # Behind what a view sees, the point is hidden from it: no evidence either way.
    visible = found.in_frame & (ratio < _HIDDEN)
    distance = torch.where(visible, ratio.abs(), torch.inf)
    nearest, view = distance.min(0)
    seen = nearest.isfinite()
    conflict = torch.where(seen, ratio.gather(0, view[None])[0], 0.0)
    weight = torch.where(seen, torch.exp(-((conflict / SAME_SURFACE) ** 2) / 2), 1.0)
    shape = points_world.shape[:-1]
    return Agreement(weight=weight.view(shape), seen=seen.view(shape), conflict=conflict.view(shape))


@torch.no_grad()
def colour_difference(
    points_world: Float[Tensor, "point 3"],
    colours: Float[Tensor, "point 3"],
    captured_images: Float[Tensor, "view 3 height width"],
    captured_depth: Float[Tensor, "view height width"],
    captured: Cameras,
) -> Float[Tensor, "point"]:
    """Mean absolute RGB difference of points to the captured view that fits best of those that see them; 0 where none does."""
    content = torch.cat([captured_images, captured_depth[:, None]], dim=1)
    there, found = captured.look_up(points_world, content)
    visible = found.in_frame & ((found.depth / there[:, 3].clamp(min=1e-6)).log() < _HIDDEN)
    off = (there[:, :3] - colours.T).abs().mean(1)
    best = torch.where(visible, off, torch.inf).amin(0)
    return torch.where(best.isfinite(), best, 0.0)
