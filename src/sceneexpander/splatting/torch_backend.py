"""The rasteriser in plain torch: fallback where there is no compiler, and oracle (any floating dtype, any device).

Pairs (Gaussian, pixel) are listed without gradients, in depth order per pixel, and kept exactly where the image formation
keeps them; then the kept pairs are blended with gradients. Rows of the image go in bands that bound the number of pairs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneexpander.geometry.rigid import rotation_from_quat_wxyz
from sceneexpander.splatting.scene import RasterScene
from sceneexpander.splatting.settings import (
    JACOBIAN_MARGIN,
    MIN_ALPHA,
    MIN_COMPENSATION,
    MIN_DETERMINANT,
    MIN_TRANSMITTANCE,
)

BYTES_PER_PAIR = 160  # of the temporaries while pairs are listed


@dataclass(frozen=True, slots=True)
class _Ellipses:
    """Visible Gaussians on one image, in depth order."""

    index: Int[Tensor, "visible"]  # into the scene's Gaussians
    mean2d: Float[Tensor, "visible 2"]
    conic: Float[Tensor, "visible 3"]  # (a, b, c): sigma = a dx^2 / 2 + b dx dy + c dy^2 / 2
    opacity: Float[Tensor, "visible"]
    planes: Float[Tensor, "visible channel"]
    half_size: Float[Tensor, "visible 2"]  # of the box around alpha >= 1/255, pixels


def rasterise_torch(scene: RasterScene) -> tuple[Tensor, Tensor, Tensor]:
    """(planes (C,channels,H,W), alpha (C,H,W), radius_px (C,N)), differentiable by autograd."""
    views = [_render_view(scene, view) for view in range(scene.views)]
    if not views:
        empty = scene.means.new_zeros
        size = (0, scene.height, scene.width)
        return empty(0, scene.channels, *size[1:]), empty(size), empty(0, scene.count)
    planes, alpha, radius_px = zip(*views, strict=True)
    return torch.stack(planes), torch.stack(alpha), torch.stack(radius_px)


def sh_basis(directions: Float[Tensor, "*batch 3"], coefficients: int) -> Float[Tensor, "*batch coefficient"]:
    """Real spherical harmonics of unit directions, degrees 0 to 3, in the usual 3DGS order and signs."""
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, 0.28209479177387814)]
    if coefficients > 1:
        basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if coefficients > 4:
        xx, yy, zz = x * x, y * y, z * z
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if coefficients > 9:
        basis += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, -1)


def shade(
    means: Float[Tensor, "gaussian 3"],
    sh: Float[Tensor, "gaussian coefficient 3"],
    cam_from_world: Float[Tensor, "4 4"],
) -> Float[Tensor, "gaussian 3"]:
    """RGB = max(0.5 + SH(direction from the camera), 0)."""
    position = -(cam_from_world[:3, :3].T @ cam_from_world[:3, 3])
    directions = torch.nn.functional.normalize(means - position, dim=-1, eps=torch.finfo(means.dtype).tiny)
    return ((sh_basis(directions, sh.shape[1])[..., None] * sh).sum(-2) + 0.5).clamp(min=0)


def _render_view(scene: RasterScene, view: int) -> tuple[Tensor, Tensor, Tensor]:
    ellipses = _project(scene, view)
    pixels = scene.height * scene.width
    image = scene.means.new_zeros(pixels, scene.channels)
    log_left = scene.means.new_zeros(pixels)
    radius_px = scene.means.new_zeros(scene.count)
    radius_px[ellipses.index] = ellipses.half_size.detach().amax(-1)
    boxes = _boxes(ellipses, scene.height, scene.width)
    for row0, row1 in _bands(boxes, scene):
        gaussian, pixel = _kept_pairs(ellipses, boxes, row0, row1, scene)
        alpha = _alpha(ellipses, gaussian, pixel, scene)[0]
        log_keep = torch.log1p(-alpha.double())
        weight = alpha * _exclusive_transmittance(log_keep, pixel).to(alpha.dtype)
        image = image.index_add(0, pixel, weight[:, None] * ellipses.planes[gaussian])
        log_left = log_left.index_add(0, pixel, log_keep.to(log_left.dtype))
    planes = image.T.reshape(scene.channels, scene.height, scene.width)
    return planes, -torch.expm1(log_left).reshape(scene.height, scene.width), radius_px


def _project(scene: RasterScene, view: int) -> _Ellipses:
    """Project all Gaussians; those that no pixel can see are dropped. EWA splatting, conventions of gsplat."""
    settings, k = scene.settings, scene.intrinsics_px[view].detach()
    cam_from_world = scene.cam_from_world[view]
    fx, fy, cx, cy = (float(v) for v in (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
    points = scene.means @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    z = points[:, 2]
    seen = (z > settings.near) & (z < settings.far)
    safe = torch.where(seen[:, None], points, points.new_tensor([0.0, 0.0, 1.0]))
    x, y, z = safe.unbind(-1)

    x_ratio, y_ratio = x / z, y / z
    margin_x, margin_y = JACOBIAN_MARGIN * scene.width, JACOBIAN_MARGIN * scene.height
    clamped_x = x_ratio.clamp(-(cx + margin_x) / fx, (scene.width - cx + margin_x) / fx)
    clamped_y = y_ratio.clamp(-(cy + margin_y) / fy, (scene.height - cy + margin_y) / fy)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [torch.stack([fx / z, zero, -fx * clamped_x / z], -1), torch.stack([zero, fy / z, -fy * clamped_y / z], -1)], -2
    )
    shape = rotation_from_quat_wxyz(scene.quat_wxyz) * scene.scales[:, None, :]
    v = jacobian @ (cam_from_world[:3, :3] @ shape)  # covariance = v v^T
    xx, xy, yy = (v[:, 0] ** 2).sum(-1), (v[:, 0] * v[:, 1]).sum(-1), (v[:, 1] ** 2).sum(-1)
    # |v0 x v1|^2 cannot turn negative, xx * yy - xy^2 can.
    det_before = (torch.linalg.cross(v[:, 0], v[:, 1]) ** 2).sum(-1)
    blur = settings.eps2d
    det = det_before + blur * (xx + yy) + blur * blur
    seen = seen & (det > MIN_DETERMINANT)
    det = torch.where(seen, det, torch.ones_like(det))

    opacity = scene.opacities
    if settings.antialiased:
        # Clamped before the root: its slope is infinite at 0.
        opacity = opacity * (det_before / det).clamp(min=MIN_COMPENSATION**2).sqrt()
    seen = seen & (opacity >= MIN_ALPHA)
    index = seen.nonzero()[:, 0]
    index = index[torch.argsort(scene_depth_key(z.detach()[index]), stable=True)]

    mean2d = torch.stack([fx * x_ratio + cx, fy * y_ratio + cy], -1)
    if scene.screen_offsets is not None:
        mean2d = mean2d + scene.screen_offsets[view]
    conic = torch.stack([(yy + blur) / det, -xy / det, (xx + blur) / det], -1)
    extent = 2 * torch.log(255 * opacity[index]) + 1e-4  # the margin absorbs rounding
    half_size = torch.sqrt(extent[:, None] * (torch.stack([xx, yy], -1)[index] + blur))
    colours = shade(scene.means, scene.colours, cam_from_world) if scene.colours.ndim == 3 else scene.colours
    planes = [colours]
    if scene.with_depth:
        planes.append(z[:, None])
    if scene.features is not None:
        planes.append(scene.features[view])
    return _Ellipses(
        index=index,
        mean2d=mean2d[index],
        conic=conic[index],
        opacity=opacity[index],
        planes=torch.cat(planes, -1)[index],
        half_size=half_size.detach(),
    )


def scene_depth_key(z: Float[Tensor, "gaussian"]) -> Float[Tensor, "gaussian"]:
    """What Gaussians are ordered by: camera z as float32, whatever the dtype of the scene."""
    return z.float()


def _boxes(ellipses: _Ellipses, height: int, width: int) -> Int[Tensor, "visible 4"]:
    """(x0, x1, y0, y1) in pixels, ends exclusive; may be empty."""
    low = (ellipses.mean2d - ellipses.half_size - 0.5).detach().ceil()
    high = (ellipses.mean2d + ellipses.half_size + 0.5).detach().floor()
    x0, x1 = low[:, 0].clamp(0, width), high[:, 0].clamp(0, width)
    y0, y1 = low[:, 1].clamp(0, height), high[:, 1].clamp(0, height)
    return torch.stack([x0, x1.maximum(x0), y0, y1.maximum(y0)], -1).long()


def _bands(boxes: Int[Tensor, "visible 4"], scene: RasterScene) -> list[tuple[int, int]]:
    """Runs of image rows whose boxes hold at most the budgeted number of pixels (at least one row each)."""
    width = boxes[:, 1] - boxes[:, 0]
    change = boxes.new_zeros(scene.height + 1)
    change.index_add_(0, boxes[:, 2], width)
    change.index_add_(0, boxes[:, 3], -width)
    per_row = change.cumsum(0)[:-1].tolist()
    budget = scene.settings.band_bytes // BYTES_PER_PAIR
    bands, start, held = [], 0, 0
    for row, pairs in enumerate(per_row):
        if row > start and held + pairs > budget:
            bands.append((start, row))
            start, held = row, 0
        held += pairs
    return [*bands, (start, scene.height)]


@torch.no_grad()
def _kept_pairs(
    ellipses: _Ellipses, boxes: Int[Tensor, "visible 4"], row0: int, row1: int, scene: RasterScene
) -> tuple[Int[Tensor, "pair"], Int[Tensor, "pair"]]:
    """(index into the ellipses, pixel) of the pairs that contribute in rows [row0, row1): by pixel, then by depth."""
    x0, x1, y0, y1 = boxes.unbind(-1)
    y0, y1 = y0.clamp(row0, row1), y1.clamp(row0, row1)
    width = x1 - x0
    area = width * (y1 - y0)
    gaussian = torch.repeat_interleave(area)
    within = torch.arange(len(gaussian), device=area.device) - (area.cumsum(0) - area)[gaussian]
    across = width[gaussian]
    row = torch.div(within, across, rounding_mode="floor")
    pixel = (y0[gaussian] + row) * scene.width + x0[gaussian] + within - row * across
    alpha, contributes = _alpha(ellipses, gaussian, pixel, scene)
    gaussian, pixel, alpha = gaussian[contributes], pixel[contributes], alpha[contributes]
    pixel, by_pixel = torch.sort(pixel, stable=True)
    gaussian, alpha = gaussian[by_pixel], alpha[by_pixel]
    log_keep = torch.log1p(-alpha.double())
    after = _log_before(log_keep, pixel) + log_keep
    kept = after > math.log(
        MIN_TRANSMITTANCE
    )  # monotonic along a pixel, so everything behind a stop is dropped as well
    return gaussian[kept], pixel[kept]


def _alpha(
    ellipses: _Ellipses, gaussian: Int[Tensor, "pair"], pixel: Int[Tensor, "pair"], scene: RasterScene
) -> tuple[Float[Tensor, "pair"], Bool[Tensor, "pair"]]:
    """(capped alpha, whether the pair is drawn at all)."""
    mean2d, conic = ellipses.mean2d[gaussian], ellipses.conic[gaussian]
    row = torch.div(pixel, scene.width, rounding_mode="floor")
    dx = (pixel - row * scene.width).to(mean2d.dtype) + 0.5 - mean2d[:, 0]
    dy = row.to(mean2d.dtype) + 0.5 - mean2d[:, 1]
    sigma = 0.5 * (conic[:, 0] * dx * dx + conic[:, 2] * dy * dy) + conic[:, 1] * dx * dy
    alpha = (ellipses.opacity[gaussian] * torch.exp(-sigma)).clamp(max=scene.settings.max_alpha)
    return alpha, (sigma >= 0) & (alpha >= MIN_ALPHA)


def _log_before(log_keep: Float[Tensor, "pair"], pixel: Int[Tensor, "pair"]) -> Float[Tensor, "pair"]:
    """Sum of ``log_keep`` (float64) over the earlier pairs of the same pixel; pairs are sorted by pixel."""
    running = log_keep.cumsum(0) - log_keep
    starts = torch.ones_like(pixel, dtype=torch.bool)
    starts[1:] = pixel[1:] != pixel[:-1]
    segment = starts.cumsum(0) - 1
    return running - running[starts][segment]


def _exclusive_transmittance(log_keep: Float[Tensor, "pair"], pixel: Int[Tensor, "pair"]) -> Float[Tensor, "pair"]:
    """What is left of the light in front of each pair, float64."""
    return torch.exp(_log_before(log_keep, pixel))
