"""A plan of the scene as an SVG: cameras and points from above."""

from __future__ import annotations

import math
from html import escape

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction

_SIDE = 320.0  # drawing units
_MARGIN = 18.0
_POINTS = 900
_CONE = 0.09  # length of a camera's sight lines, share of the drawing


def camera_map(reconstruction: Reconstruction) -> str:
    """SVG text: x of the first view's frame to the right, its viewing direction up; generated parts in their own class."""
    gaussians = reconstruction.gaussians
    step = max(1, len(gaussians) // _POINTS)
    solid = gaussians.opacities[::step] > 0.3
    points = gaussians.means[::step][solid][:, [0, 2]].to(torch.float64)
    generated = gaussians.generated[::step][solid]
    centres = reconstruction.world_from_cam[:, [0, 2], 3].to(torch.float64)
    low, high = _extent(points, centres)
    scale = (_SIDE - 2 * _MARGIN) / max(float((high - low).max()), 1e-9)
    middle = (low + high) / 2

    def place(point: Float[Tensor, "2"]) -> tuple[float, float]:
        offset = (point - middle) * scale
        return _SIDE / 2 + float(offset[0]), _SIDE / 2 - float(offset[1])

    parts = [f'<svg class="map" viewBox="0 0 {_SIDE:g} {_SIDE:g}" role="img" aria-label="cameras from above">']
    inside = ((points >= low) & (points <= high)).all(1)
    for point, new in zip(points[inside], generated[inside], strict=True):
        x, y = place(point)
        parts.append(f'<circle class="{"new" if new else "old"}" cx="{x:.1f}" cy="{y:.1f}" r="1.1"/>')
    for index, view in enumerate(reconstruction.view_ids):
        x, y = place(centres[index])
        kind = "new" if bool(reconstruction.generated[index]) else "old"
        parts.append(
            f'<polygon class="cam {kind}" points="{_cone(reconstruction, index, x, y)}"><title>{escape(view)}</title></polygon>'
        )
    return "".join([*parts, "</svg>"])


def _extent(
    points: Float[Tensor, "point 2"], centres: Float[Tensor, "view 2"]
) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
    """Box around the cameras and the bulk of the points: a few far ones must not shrink the rest to a dot."""
    if len(points) == 0:
        return centres.min(0).values - 0.5, centres.max(0).values + 0.5
    bulk = torch.stack([points.quantile(0.03, dim=0), points.quantile(0.97, dim=0)])
    everything = torch.cat([bulk, centres])
    return everything.min(0).values, everything.max(0).values


def _cone(reconstruction: Reconstruction, index: int, x: float, y: float) -> str:
    forward = reconstruction.world_from_cam[index, [0, 2], 2]
    heading = math.atan2(float(forward[1]), float(forward[0]))
    half = math.atan(float(reconstruction.intrinsics_px[index, 0, 2] / reconstruction.intrinsics_px[index, 0, 0]))
    length = _SIDE * _CONE
    corners = [(x, y)]
    corners += [(x + length * math.cos(heading + s * half), y - length * math.sin(heading + s * half)) for s in (-1, 1)]
    return " ".join(f"{px:.1f},{py:.1f}" for px, py in corners)
