"""Geometry-perturbation augmentation: identity, global affine, blockwise affine with feathered seams, global then block.

A warp is a sampling grid: for every output pixel, where in the input it looks (normalised coordinates of ``grid_sample`` with
``align_corners=False``, i.e. -1 and 1 are the outer edges of the image).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.adaptation.config import AugmentConfig
from sceneexpander.geometry.lookup import warp_known, warp_maps
from sceneexpander.geometry.priors import Priors


class Mode(StrEnum):
    """The four variants of the paper."""

    IDENTITY = "identity"
    GLOBAL = "global"
    BLOCK = "block"
    GLOBAL_AND_BLOCK = "global_and_block"


def draw_mode(config: AugmentConfig, generator: torch.Generator) -> Mode:
    """One of the four modes with the configured probabilities."""
    edges = torch.tensor([config.identity, config.global_affine, config.blockwise], dtype=torch.float64).cumsum(0)
    place = int((torch.rand((), generator=generator, dtype=torch.float64) >= edges).sum())
    return (Mode.IDENTITY, Mode.GLOBAL, Mode.BLOCK, Mode.GLOBAL_AND_BLOCK)[place]


def _uniform(count: int, limit: float, generator: torch.Generator) -> Float[Tensor, "count"]:
    return (torch.rand(count, generator=generator) * 2 - 1) * limit


def random_affine(
    config: AugmentConfig, count: int, strength: float, aspect: float, generator: torch.Generator
) -> Float[Tensor, "count 2 3"]:
    """Affine maps in units of half the image height (so a rotation is one for any aspect ratio), input from output.

    Args:
        aspect: width / height.
    """
    angle = _uniform(count, math.radians(config.rotation_deg) * strength, generator)
    scale = torch.exp(_uniform(count, config.scale * strength, generator))
    shear = torch.tan(_uniform(count, math.radians(config.shear_deg) * strength, generator))
    shift_x = _uniform(count, 2 * config.translation * strength * aspect, generator)
    shift_y = _uniform(count, 2 * config.translation * strength, generator)
    cos, sin = torch.cos(angle) * scale, torch.sin(angle) * scale
    row_x = torch.stack([cos, cos * shear - sin, shift_x], -1)
    row_y = torch.stack([sin, sin * shear + cos, shift_y], -1)
    return torch.stack([row_x, row_y], -2)


def identity_grid(height: int, width: int) -> Float[Tensor, "height width 2"]:
    """The grid that samples every pixel at its own centre."""
    y = (torch.arange(height) + 0.5) / height * 2 - 1
    x = (torch.arange(width) + 0.5) / width * 2 - 1
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)


def _apply_affine(
    affine: Float[Tensor, "2 3"], grid: Float[Tensor, "height width 2"], centre: Float[Tensor, "2"], aspect: float
) -> Float[Tensor, "height width 2"]:
    """Move grid points by an affine map about ``centre`` (normalised); the map acts in isotropic units."""
    unit = torch.tensor([aspect, 1.0])
    local = (grid - centre) * unit
    moved = local @ affine[:, :2].T + affine[:, 2]
    return moved / unit + centre


def _block_weights(length: int, blocks: int, feather: float) -> Float[Tensor, "blocks length"]:
    """Weights of each block along one axis: a partition of unity with smooth (raised-cosine) seams."""
    position = (torch.arange(length) + 0.5) / length * blocks
    width = max(feather, 1e-6)
    # Each inner seam is a smooth step centred on the border between two blocks.
    steps = [torch.ones(length)]
    for border in range(1, blocks):
        t = ((position - border) / (2 * width) + 0.5).clamp(0, 1)
        steps.append(t * t * (3 - 2 * t))
    steps.append(torch.zeros(length))
    return torch.stack([steps[i] - steps[i + 1] for i in range(blocks)])


def warp_grid(
    mode: Mode, config: AugmentConfig, height: int, width: int, generator: torch.Generator
) -> Float[Tensor, "height width 2"]:
    """Sampling grid of one randomly drawn warp of the given mode."""
    aspect = width / height
    grid = identity_grid(height, width)
    centre = torch.zeros(2)
    if mode in (Mode.GLOBAL, Mode.GLOBAL_AND_BLOCK):
        affine = random_affine(config, 1, 1.0, aspect, generator)[0]
        grid = _apply_affine(affine, grid, centre, aspect)
    if mode in (Mode.BLOCK, Mode.GLOBAL_AND_BLOCK):
        grid = _block_warp(grid, config, height, width, generator)
    return grid


def _block_warp(
    grid: Float[Tensor, "height width 2"], config: AugmentConfig, height: int, width: int, generator: torch.Generator
) -> Float[Tensor, "height width 2"]:
    """Move each block of the output by its own affine map about its centre; displacements are blended across the seams."""
    count = config.grid
    aspect = width / height
    affines = random_affine(config, count * count, config.block_strength, aspect, generator)
    steps = (2 * torch.arange(count) + 1) / count - 1
    centres = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1).flatten(0, 1)
    # A block moves a point p to A (p - c) + t + c. That is affine in p, so the blend of all blocks' displacements is the blend of
    # their matrices: six numbers per pixel instead of one grid per block. Units: `affines` are isotropic, the grid is not.
    unit = torch.tensor([aspect, 1.0])
    linear = affines[:, :, :2] * unit / unit[:, None] - torch.eye(2)
    constant = affines[:, :, 2] / unit - (linear @ centres[..., None])[..., 0]
    numbers = torch.cat([linear.flatten(1), constant], dim=1).view(count, count, 6)
    rows = _block_weights(height, count, config.feather)
    columns = _block_weights(width, count, config.feather)
    field = torch.einsum("rh,cw,rck->hwk", rows, columns, numbers)
    x, y = grid.unbind(-1)
    offset_x = field[..., 0] * x + field[..., 1] * y + field[..., 4]
    offset_y = field[..., 2] * x + field[..., 3] * y + field[..., 5]
    return grid + torch.stack([offset_x, offset_y], dim=-1)


def draw_warp(
    config: AugmentConfig, height: int, width: int, generator: torch.Generator
) -> Float[Tensor, "height width 2"] | None:
    """The sampling grid of one random perturbation; None in identity mode."""
    mode = draw_mode(config, generator)
    return None if mode is Mode.IDENTITY else warp_grid(mode, config, height, width, generator)


def warp_priors(priors: Priors, grids: Sequence[Float[Tensor, "height width 2"] | None]) -> Priors:
    """Priors of views whose pictures were warped: depth and evidence move with the pixels, cameras stay.

    One grid per view, the last views may have none. A pixel without a depth stays one, and so does what is blended with it.
    """
    depth = None if priors.depth is None else priors.depth.clone()
    evidence = None if priors.evidence is None else priors.evidence.clone()
    for view, grid in enumerate(grids):
        if grid is None:
            continue
        if depth is not None:
            moved, known = warp_known(depth[view], depth[view] > 0, grid)
            depth[view] = torch.where(known, moved, 0.0)
        if evidence is not None:
            evidence[view] = warp_maps(evidence[view], grid)
    return replace(priors, depth=depth, evidence=evidence)
