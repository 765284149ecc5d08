"""gsplat's own torch reference on the CPU (pip install gsplat==1.5.3); its functions are only called.

What it has only as CUDA code (tile intersection, pixel lists) and what it takes from nerfacc is replaced by vectorised functions.
"""

from __future__ import annotations

import sys
import types
from collections.abc import Callable

import torch
from splat_scene import Scene
from torch import Tensor

TILE = 16


def install_nerfacc_stand_in() -> None:
    """The two segment functions that gsplat's accumulation imports from nerfacc: float64 log cumsum and index_add."""

    def render_weight_from_alpha(
        alphas: Tensor, *, ray_indices: Tensor, n_rays: int, **_: object
    ) -> tuple[Tensor, Tensor]:
        log_keep = torch.log1p(-alphas.double())
        running = log_keep.cumsum(0) - log_keep
        starts = torch.ones_like(ray_indices, dtype=torch.bool)
        starts[1:] = ray_indices[1:] != ray_indices[:-1]
        before = running - running[starts][starts.cumsum(0) - 1]
        transmittance = torch.exp(before).to(alphas.dtype)
        return alphas * transmittance, transmittance

    def accumulate_along_rays(
        weights: Tensor, values: Tensor | None = None, ray_indices: Tensor | None = None, n_rays: int | None = None
    ) -> Tensor:
        assert ray_indices is not None
        assert n_rays is not None
        source = weights[:, None] if values is None else weights[:, None] * values
        return source.new_zeros(n_rays, source.shape[1]).index_add(0, ray_indices, source)

    module = types.ModuleType("nerfacc")
    module.render_weight_from_alpha = render_weight_from_alpha  # type: ignore[attr-defined]
    module.accumulate_along_rays = accumulate_along_rays  # type: ignore[attr-defined]
    sys.modules.setdefault("nerfacc", module)


@torch.no_grad()
def tile_lists(means2d: Tensor, radii: Tensor, depths: Tensor, tiles_x: int, tiles_y: int) -> tuple[Tensor, Tensor]:
    """(sort keys, Gaussians) of all tile intersections by tile, then depth."""
    limit = torch.tensor([tiles_x, tiles_y])
    low = ((means2d - radii) / TILE).floor().clamp(min=0).minimum(limit).long()
    high = ((means2d + radii) / TILE).ceil().clamp(min=0).minimum(limit).long()
    size = torch.where((radii > 0).all(-1, keepdim=True), high - low, 0).clamp(min=0)
    area = size.prod(-1)
    gaussian = torch.repeat_interleave(area)
    within = torch.arange(len(gaussian)) - (area.cumsum(0) - area)[gaussian]
    row = torch.div(within, size[gaussian, 0], rounding_mode="floor")
    tile = (low[gaussian, 1] + row) * tiles_x + low[gaussian, 0] + within - row * size[gaussian, 0]
    key, order = torch.sort(tile << 32 | depths.view(torch.int32)[gaussian].long(), stable=True)
    return key, gaussian[order]


@torch.no_grad()
def pixel_lists(
    scene: Scene, means2d: Tensor, conics: Tensor, opacities: Tensor, offsets: Tensor, flat: Tensor
) -> tuple[Tensor, Tensor]:
    """(Gaussian, pixel) of all contributing pairs, per tile in blocks of 512 Gaussians."""
    tiles_x = (scene.width + TILE - 1) // TILE
    ends = [*offsets.flatten().tolist(), len(flat)]
    gaussians, pixels = [], []
    for tile in range(len(ends) - 1):
        x0, y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
        x = torch.arange(x0, min(x0 + TILE, scene.width))
        y = torch.arange(y0, min(y0 + TILE, scene.height))
        py, px = (t.reshape(-1, 1) for t in torch.meshgrid(y, x, indexing="ij"))
        left = torch.ones(len(px), 1)
        masks = []
        for start in range(ends[tile], ends[tile + 1], 512):
            ids = flat[start : min(start + 512, ends[tile + 1])]
            dx, dy = px + 0.5 - means2d[ids, 0], py + 0.5 - means2d[ids, 1]
            a, b, c = conics[ids].unbind(-1)
            sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
            alpha = (opacities[ids] * torch.exp(-sigma)).clamp(max=0.999)
            seen = (sigma >= 0) & (alpha >= 1 / 255)
            after = left * torch.cumprod(torch.where(seen, 1 - alpha, 1.0), 1)
            masks.append(seen & (after > 1e-4))
            left = after[:, -1:]
            if bool((left <= 1e-4).all()):
                break
        if masks:
            pixel, nth = torch.cat(masks, 1).nonzero().unbind(-1)
            gaussians.append(flat[ends[tile] + nth])
            pixels.append((py * scene.width + px).flatten()[pixel])
    return torch.cat(gaussians), torch.cat(pixels)


def draw_gsplat(
    scene: Scene, leaves: list[Tensor], lists: tuple[Tensor, Tensor] | None, *, antialiased: bool
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
    """(image, alpha, index lists), height and width first; given lists are not recomputed.

    ``antialiased`` compensates opacities for the blur on the screen, as gsplat's mode of that name does.
    """
    install_nerfacc_stand_in()
    from gsplat.cuda import _torch_impl as reference

    means, quats, scales, opacities, colours = leaves
    tiles_x, tiles_y = (scene.width + TILE - 1) // TILE, (scene.height + TILE - 1) // TILE
    covars, _ = reference._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    radii, means2d, depths, conics, kept = reference._fully_fused_projection(
        means,
        covars,
        scene.viewmat[None],
        scene.intrinsics[None],
        scene.width,
        scene.height,
        calc_compensations=antialiased,
    )
    if antialiased:
        opacities = opacities * kept[0]
    if lists is None:
        keys, flat = tile_lists(means2d[0], radii[0], depths[0], tiles_x, tiles_y)
        offsets = reference._isect_offset_encode(keys, 1, tiles_x, tiles_y)
        lists = pixel_lists(scene, means2d[0], conics[0], opacities, offsets, flat)
    gaussian, pixel = lists
    image, alpha = reference.accumulate(
        means2d,
        conics,
        opacities[None],
        colours[None],
        gaussian,
        pixel,
        torch.zeros_like(gaussian),
        scene.width,
        scene.height,
    )
    return image[0], alpha[0, ..., 0], lists


def run_gsplat(
    scene: Scene, lists: tuple[Tensor, Tensor] | None, *, antialiased: bool
) -> Callable[[], tuple[Tensor, list[Tensor], tuple[Tensor, Tensor]]]:
    """A function that renders and returns (image, leaves, index lists), see `draw_gsplat`."""

    def forward() -> tuple[Tensor, list[Tensor], tuple[Tensor, Tensor]]:
        leaves = scene.leaves()
        image, _, held = draw_gsplat(scene, leaves, lists, antialiased=antialiased)
        return image, leaves, held

    return forward
