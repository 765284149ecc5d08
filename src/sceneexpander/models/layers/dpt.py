"""Dense prediction head: collected tokens of several depths -> one map at image resolution (worldmirror spec 7, ttt3r spec 6)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor, nn

from sceneexpander.models.layers.block import run_checkpointed

UV_GAIN = 0.1
UV_BASE = 100.0


@dataclass(frozen=True, slots=True, kw_only=True)
class DptConfig:
    """Sizes of a dense head.

    ``factors`` is the resolution of each level over the patch grid, finest first: an integer above 1 is a transposed
    convolution, 1 no layer, 0.5 a strided convolution. ``out_channels`` has one width per level. ``rectified_skip``: the skip
    path of the residual units carries relu(x), as in every released VGGT-style head. ``uv_embedding`` adds fixed positions to
    the maps. ``input_norm`` normalises the tokens. ``crop_doubled`` doubles every fused map and crops it to the next finer
    level, instead of resizing it to that level: the same unless a side is odd. ``coarse_unit`` gives the coarsest fusion the
    merging unit that some checkpoints carry and nobody reads. ``views_per_chunk`` bounds the memory and changes no number.
    """

    features: int = 256
    out_channels: tuple[int, ...] = (256, 512, 1024, 1024)
    hidden: int = 32
    factors: tuple[float, ...] = (4, 2, 1, 0.5)
    rectified_skip: bool = True
    uv_embedding: bool = True
    input_norm: bool = True
    crop_doubled: bool = False
    coarse_unit: bool = False
    views_per_chunk: int = 8

    def __post_init__(self) -> None:
        if len(self.factors) != len(self.out_channels):
            raise ValueError(f"{len(self.out_channels)} level widths for {len(self.factors)} levels")
        if self.uv_embedding and any(c % 4 for c in (*self.out_channels, self.features // 2)):
            raise ValueError(
                f"level widths {self.out_channels} and features/2 of {self.features} must be divisible by 4"
            )
        if self.views_per_chunk < 1:
            raise ValueError(f"views_per_chunk is {self.views_per_chunk}, must be at least 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class DptNames:
    """Parameter names of the parts; ``{index}`` counts levels from 0, ``{number}`` from 1. Defaults: the VGGT family."""

    project: str = "projects.{index}"
    resize: str = "resize_layers.{index}"
    level: str = "scratch.layer{number}_rn"
    level_alias: str | None = None  # second name of the same parameters
    fusion: str = "scratch.refinenet{number}"
    features: str = "scratch.output_conv1"
    hidden: str = "scratch.output_conv2.0"
    output: str = "scratch.output_conv2.2"


def _add(root: nn.Module, name: str, part: nn.Module) -> None:
    """Register ``part`` under a dotted name, with plain modules on the way."""
    *parents, last = name.split(".")
    for parent in parents:
        if not hasattr(root, parent):
            root.add_module(parent, nn.Module())
        root = root.get_submodule(parent)
    root.add_module(last, part)


@lru_cache(maxsize=128)
def _uv_terms(half_channels: int, length: int, span: float) -> NDArray[np.float32]:
    """[sin, cos] of one image axis, (half_channels, length); see `add_uv_embedding`."""
    quarter = half_channels // 2
    edge = span * (length - 1) / length
    coordinate = np.linspace(-edge, edge, length, dtype=np.float32).astype(np.float64)
    frequency = UV_BASE ** (-np.arange(quarter, dtype=np.float64) / quarter)
    angle = frequency[:, None] * coordinate
    return (np.concatenate([np.sin(angle), np.cos(angle)]).astype(np.float32) * np.float32(UV_GAIN)).astype(np.float32)


def add_uv_embedding(
    maps: Float[Tensor, "batch channel height width"], aspect: float
) -> Float[Tensor, "batch channel height width"]:
    """Add ``0.1 [sin(u w), cos(u w), sin(v w), cos(v w)]``, u the column and v the row coordinate (worldmirror spec 7).

    The grid spans the rectangle of the image's ``aspect`` (width / height) inscribed in the unit circle. The first half of the
    channels depends on the column only and the second on the row only, so no full-size table is ever made.
    """
    half = maps.shape[1] // 2
    diagonal = math.sqrt(aspect * aspect + 1)
    height, width = maps.shape[-2:]
    columns = torch.tensor(_uv_terms(half, width, aspect / diagonal), device=maps.device, dtype=maps.dtype)
    rows = torch.tensor(_uv_terms(half, height, 1 / diagonal), device=maps.device, dtype=maps.dtype)
    return torch.cat([maps[:, :half] + columns[:, None, :], maps[:, half:] + rows[:, :, None]], dim=1)


def resize_aligned(
    maps: Float[Tensor, "batch channel height width"], size: tuple[int, int]
) -> Float[Tensor, "batch channel new_height new_width"]:
    """Bilinear resize with aligned corners, as everywhere in the decoder."""
    if maps.shape[-2:] == size:
        return maps
    return F.interpolate(maps, size=size, mode="bilinear", align_corners=True)


class ResidualUnit(nn.Module):
    """``skip + conv2(relu(conv1(relu(x))))``, where skip is relu(x) if ``rectified_skip``, else x."""

    def __init__(self, features: int, *, rectified_skip: bool) -> None:
        super().__init__()
        self.rectified_skip = rectified_skip
        self.conv1 = nn.Conv2d(features, features, 3, padding=1)
        self.conv2 = nn.Conv2d(features, features, 3, padding=1)

    def forward(self, maps: Float[Tensor, "batch channel height width"]) -> Float[Tensor, "batch channel height width"]:
        active = F.relu(maps)
        return (active if self.rectified_skip else maps) + self.conv2(F.relu(self.conv1(active)))


class FusionBlock(nn.Module):
    """Merge a finer level into the running map, refine, project, upsample. The coarsest block has no level to merge."""

    def __init__(self, features: int, *, merges: bool, rectified_skip: bool) -> None:
        super().__init__()
        self.out_conv = nn.Conv2d(features, features, 1)
        if merges:
            self.resConfUnit1 = ResidualUnit(features, rectified_skip=rectified_skip)
        self.resConfUnit2 = ResidualUnit(features, rectified_skip=rectified_skip)

    def forward(self, running: Tensor, level: Tensor | None, size: tuple[int, int]) -> Tensor:
        if level is not None:
            running = running + self.resConfUnit1(level)
        # The released code projects after the upsampling. A 1x1 convolution commutes with it (the weights of an interpolation
        # sum to one), and costs a quarter this way round.
        return resize_aligned(self.out_conv(self.resConfUnit2(running)), size)


class DptHead(nn.Module):
    """Tokens of several trunk depths -> ``outputs`` raw channels per pixel.

    Args:
        dim: width of the collected tokens; one for each level if they differ (then without ``input_norm``).
        outputs: channels of the map.
        config: sizes.
        names: parameter names.
    """

    def __init__(
        self, dim: int | Sequence[int], outputs: int, config: DptConfig, *, names: DptNames | None = None
    ) -> None:
        super().__init__()
        self.config = config
        self.views_per_chunk = config.views_per_chunk
        self.names = names = DptNames() if names is None else names
        features, levels = config.features, len(config.factors)
        dims = (dim,) * levels if isinstance(dim, int) else tuple(dim)
        if config.input_norm and len(set(dims)) > 1:
            raise ValueError(f"one normalisation cannot serve tokens of widths {dims}")
        self.norm = nn.LayerNorm(dims[0], eps=1e-5) if config.input_norm else nn.Identity()
        for j, (inner, width) in enumerate(zip(dims, config.out_channels, strict=True)):
            self._add(names.project, nn.Conv2d(inner, width, 1), j)
        for j, (width, factor) in enumerate(zip(config.out_channels, config.factors, strict=True)):
            self._add(names.resize, _resize_layer(width, factor), j)
        for j, width in enumerate(config.out_channels):
            level = nn.Conv2d(width, features, 3, padding=1, bias=False)
            self._add(names.level, level, j)
            if names.level_alias is not None:
                self._add(names.level_alias, level, j)
            merges = config.coarse_unit or j < levels - 1
            self._add(names.fusion, FusionBlock(features, merges=merges, rectified_skip=config.rectified_skip), j)
        _add(self, names.features, nn.Conv2d(features, features // 2, 3, padding=1))
        _add(self, names.hidden, nn.Conv2d(features // 2, config.hidden, 3, padding=1))
        _add(self, names.output, nn.Conv2d(config.hidden, outputs, 1))

    def _add(self, name: str, part: nn.Module, index: int) -> None:
        _add(self, name.format(index=index, number=index + 1), part)

    def part(self, name: str, index: int) -> nn.Module:
        """The part of level ``index`` under one of the names of `DptNames`."""
        return self.get_submodule(name.format(index=index, number=index + 1))

    def forward(
        self,
        collected: Sequence[Float[Tensor, "batch token dim"]],
        *,
        specials: int,
        grid: tuple[int, int],
        size: tuple[int, int],
        checkpoint: bool = False,
    ) -> Float[Tensor, "batch channel height width"]:
        """The map before any activation.

        Args:
            collected: one token set per level, views flattened into the batch.
            specials: tokens in front of the patches, ignored here.
            grid: rows and columns of patches.
            size: height and width of the image, hence of the map.
            checkpoint: recompute each chunk of views in the backward pass.
        """
        parts = []
        for chunk in self.chunks(collected[0].shape[0]):
            levels = [tokens[chunk] for tokens in collected]
            parts.append(run_checkpointed(self.dense, levels, specials, grid, size, enabled=checkpoint))
        return parts[0] if len(parts) == 1 else torch.cat(parts)

    def dense(
        self, levels: list[Tensor], specials: int, grid: tuple[int, int], size: tuple[int, int]
    ) -> Float[Tensor, "batch channel height width"]:
        """`forward` without chunks."""
        return self.predict(self.features(levels, specials, grid, size))

    def predict(
        self, features: Float[Tensor, "batch half_features height width"]
    ) -> Float[Tensor, "batch channel height width"]:
        """The last two convolutions, from `features` to the raw channels."""
        hidden, output = self.get_submodule(self.names.hidden), self.get_submodule(self.names.output)
        return output(F.relu(hidden(features)))

    def chunks(self, count: int) -> Iterator[slice]:
        """Slices of at most ``views_per_chunk`` views: they bound the memory and change no number."""
        step = self.views_per_chunk
        return (slice(begin, min(begin + step, count)) for begin in range(0, count, step))

    def features(
        self,
        levels: Sequence[Tensor],
        specials: int,
        grid: tuple[int, int],
        size: tuple[int, int],
        skips: Sequence[Tensor | None] | None = None,
    ) -> Float[Tensor, "batch half_features height width"]:
        """The decoder's last feature map at image size, positions included (Z of the specification).

        ``skips``: maps of the fusion width to add to the levels before they are fused, finest first (None: nothing to add).
        """
        aspect = size[1] / size[0]
        maps = []
        for j, tokens in enumerate(levels):
            patches = self.norm(tokens[:, specials:]).transpose(1, 2).unflatten(2, grid)
            projected = self.part(self.names.project, j)(patches)
            if self.config.uv_embedding:
                projected = add_uv_embedding(projected, aspect)
            resized = self.part(self.names.resize, j)(projected)
            level = self.part(self.names.level, j)(resized)
            skip = None if skips is None else skips[j]
            maps.append(level if skip is None else level + skip)
        out = resize_aligned(self.get_submodule(self.names.features)(self._fuse(maps)), size)
        return add_uv_embedding(out, aspect) if self.config.uv_embedding else out

    def _fuse(self, maps: list[Tensor]) -> Tensor:
        """Coarse to fine; the result has twice the resolution of the finest level."""
        running = maps[-1]
        for j in reversed(range(len(maps))):
            level = None if j == len(maps) - 1 else maps[j]
            doubled = (2 * maps[j].shape[-2], 2 * maps[j].shape[-1])
            target = tuple(maps[j - 1].shape[-2:]) if j else doubled
            resized = doubled if self.config.crop_doubled else target
            running = self.part(self.names.fusion, j)(running, level, resized)
            running = running[..., : target[0], : target[1]]
        return running


def _resize_layer(width: int, factor: float) -> nn.Module:
    if factor == 1:
        return nn.Identity()
    if factor == 0.5:
        return nn.Conv2d(width, width, 3, stride=2, padding=1)
    if factor > 1 and float(factor).is_integer():
        return nn.ConvTranspose2d(width, width, int(factor), stride=int(factor))
    raise ValueError(f"a level's resolution factor must be 0.5, 1 or an integer above 1, got {factor}")
