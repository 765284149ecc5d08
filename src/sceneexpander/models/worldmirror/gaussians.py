"""From dense features to per-pixel Gaussians (worldmirror spec 8)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneexpander.geometry.gaussians import sh_from_rgb
from sceneexpander.geometry.rigid import transform_points
from sceneexpander.models.layers.block import run_checkpointed
from sceneexpander.models.layers.dpt import DptConfig, DptHead
from sceneexpander.models.worldmirror.config import GaussianConfig

CHANNELS = (4, 3, 1, 3, 1)  # quaternion wxyz, scales, opacity, residual SH, merge weight


@dataclass(frozen=True, slots=True, kw_only=True)
class PixelGaussians:
    """One Gaussian per pixel of B scenes, in (view, row, column) order; activated values, world frame."""

    means: Float[Tensor, "batch gaussian 3"]
    quats: Float[Tensor, "batch gaussian 4"]  # wxyz, unit
    scales: Float[Tensor, "batch gaussian 3"]
    opacities: Float[Tensor, "batch gaussian"]
    sh: Float[Tensor, "batch gaussian 1 3"]
    residual_sh: Float[Tensor, "batch gaussian 1 3"]  # what `sh` adds to the pixel's own colour
    weights: Float[Tensor, "batch gaussian"]  # weight in the merge, in (0, 1)

    def select(self, index: Tensor) -> PixelGaussians:
        """The Gaussians at ``index`` (batch, kept)."""
        rows = torch.arange(index.shape[0], device=index.device)[:, None]
        return PixelGaussians(**{f.name: getattr(self, f.name)[rows, index] for f in fields(self)})


class GaussianDptHead(DptHead):
    """A depth head that also returns its features, with the image mixed in, for the Gaussian parameters."""

    def __init__(self, dim: int, config: DptConfig) -> None:
        super().__init__(dim, 2, config)
        self.input_merger = nn.Sequential(nn.Conv2d(3, config.features // 2, 7, padding=3), nn.ReLU())

    def with_features(
        self,
        collected: Sequence[Float[Tensor, "batch token dim"]],
        images: Float[Tensor, "batch 3 height width"],
        *,
        specials: int,
        grid: tuple[int, int],
        parameters: nn.Module,
        checkpoint: bool = False,
    ) -> tuple[Float[Tensor, "batch 2 height width"], Float[Tensor, "batch 12 height width"]]:
        """(raw depth and confidence, raw Gaussian channels), chunk by chunk so that features never exist for all views.

        Args:
            collected: as in `DptHead.forward`.
            images: RGB in [0, 1], not normalised.
            specials: tokens in front of the patches.
            grid: rows and columns of patches.
            parameters: module from features to Gaussian channels.
            checkpoint: recompute each chunk in the backward pass.
        """

        def chunk_outputs(levels: list[Tensor], rgb: Tensor) -> tuple[Tensor, Tensor]:
            features = self.features(levels, specials, grid, (rgb.shape[-2], rgb.shape[-1]))
            return self.predict(features), parameters(features + self.input_merger(rgb))

        outputs = [
            run_checkpointed(chunk_outputs, [tokens[c] for tokens in collected], images[c], enabled=checkpoint)
            for c in self.chunks(images.shape[0])
        ]
        return torch.cat([depth for depth, _ in outputs]), torch.cat([raw for _, raw in outputs])


class GaussianParameters(nn.Module):
    """Features -> the 12 raw Gaussian channels of every pixel. Named ``gs_renderer`` in the checkpoint."""

    def __init__(self, features: int, hidden: int) -> None:
        super().__init__()
        self.gs_head = nn.Sequential(
            nn.Conv2d(features, hidden, 3, padding=1, bias=False), nn.ReLU(), nn.Conv2d(hidden, sum(CHANNELS), 1)
        )

    def forward(self, features: Float[Tensor, "batch channel height width"]) -> Float[Tensor, "batch 12 height width"]:
        return self.gs_head(features)


def activate_gaussians(
    raw: Float[Tensor, "batch view 12 height width"],
    images: Float[Tensor, "batch view 3 height width"],
    means: Float[Tensor, "batch view height width 3"],
    config: GaussianConfig,
) -> PixelGaussians:
    """Gaussian values from raw channels; colours are the pixels' own plus a residual."""
    channels = raw.permute(0, 1, 3, 4, 2).flatten(1, 3)
    quats, scales, opacities, residual_sh, weights = torch.split(channels, list(CHANNELS), dim=-1)
    rgb = images.permute(0, 1, 3, 4, 2).flatten(1, 3)
    return PixelGaussians(
        means=means.flatten(1, 3),
        quats=quats / (quats.norm(dim=-1, keepdim=True) + 1e-8),
        scales=scales.exp().clamp(max=config.max_scale),
        opacities=opacities[..., 0].sigmoid(),
        sh=(sh_from_rgb(rgb) + residual_sh)[:, :, None],
        residual_sh=residual_sh[:, :, None],
        weights=weights[..., 0].sigmoid(),
    )


def unproject_integer_pixels(
    depth: Float[Tensor, "batch view height width"],
    intrinsics_px: Float[Tensor, "batch view 3 3"],
    world_from_cam: Float[Tensor, "batch view 4 4"],
) -> Float[Tensor, "batch view height width 3"]:
    """World points of a z-depth map whose pixel (row, column) lies at exactly (column, row), half a pixel off its centre.

    The network was trained with this (worldmirror spec 8, "Gotcha"); everything else here uses
    `sceneexpander.geometry.camera.unproject_to_world`.
    """
    height, width = depth.shape[-2:]
    v = torch.arange(height, dtype=depth.dtype, device=depth.device)[:, None]
    u = torch.arange(width, dtype=depth.dtype, device=depth.device)
    fx, fy, cx, cy = (intrinsics_px[..., i, j, None, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    points = torch.stack([(u - cx) * depth / fx, (v - cy) * depth / fy, depth], dim=-1)
    return torch.unflatten(transform_points(world_from_cam, points.flatten(2, 3)), 2, (height, width))


def most_confident(conf: Float[Tensor, "batch view height width"], config: GaussianConfig) -> Tensor:
    """Indices (batch, kept) of the Gaussians that the optional confidence filter keeps (worldmirror spec 8.1)."""
    flat = conf.flatten(1)
    flat = torch.where(flat <= 1e-5, torch.full_like(flat, -math.inf), flat)
    # Rounded before the ceiling: 10 * 0.7 is not quite 7 in binary.
    kept = min(math.ceil(round(flat.shape[1] * config.keep_share, 6)), config.max_kept)
    return flat.topk(kept, dim=1, sorted=False).indices
