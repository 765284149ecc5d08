"""The Gaussian scene as a value: what reconstructors produce and rasterisers, metrics and exporters read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

SH_DC = 0.28209479177387814  # value of the constant real spherical harmonic
ROWS = ("means", "quat_wxyz", "scales", "opacities", "sh", "source_view", "generated")  # tensors, one row per Gaussian


@dataclass(frozen=True, slots=True, kw_only=True)
class Gaussians:
    """K Gaussians, activated values ready to rasterise (no logits, no log-scales), in the world frame, scene units.

    ``sh`` holds real spherical harmonics, band 0 first: colour = 0.5 + SH(direction), RGB.
    ``source_view`` is the index of the view whose pixel made the Gaussian, ``generated`` whether that view was a generated one.
    ``antialiased`` says how opacities are meant: for rasterisers that compensate them for the screen blur (True), or for those that do
    not (False). Drawn the other way, a scene is too opaque or full of holes at some distances.
    """

    means: Float[Tensor, "gaussian 3"]
    quat_wxyz: Float[Tensor, "gaussian 4"]  # world_from_gaussian; any non-zero length, rasterisers normalise
    scales: Float[Tensor, "gaussian 3"]  # standard deviations, > 0
    opacities: Float[Tensor, "gaussian"]  # in [0, 1]
    sh: Float[Tensor, "gaussian coefficient 3"]
    source_view: Int[Tensor, "gaussian"]
    generated: Bool[Tensor, "gaussian"]
    antialiased: bool = False

    def __post_init__(self) -> None:
        count = self.means.shape[0]
        for name in ROWS:
            value = getattr(self, name)
            if value.shape[0] != count:
                raise ValueError(f"Gaussians.{name} has {value.shape[0]} rows, means have {count}")

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def select(self, keep: Tensor) -> Gaussians:
        """The Gaussians at a boolean mask or index tensor."""
        return replace(self, **{name: getattr(self, name)[keep] for name in ROWS})

    def detach(self) -> Gaussians:
        """The same values outside the autograd graph."""
        return replace(self, **{name: getattr(self, name).detach() for name in ROWS})

    def to(self, device: torch.device | str) -> Gaussians:
        """The same Gaussians on another device."""
        return replace(self, **{name: getattr(self, name).to(device) for name in ROWS})


@dataclass(frozen=True, slots=True, kw_only=True)
class GaussianCounts:
    """What became of the Gaussians that a model made; nothing else is ever dropped: ``made = filtered + merged + kept``."""

    made: int  # one per pixel of every view
    filtered: int = 0  # left out by the model's own confidence filter
    merged: int = 0  # gone into another one of the same voxel
    kept: int

    def __post_init__(self) -> None:
        if min(self.filtered, self.merged, self.kept) < 0 or self.made != self.filtered + self.merged + self.kept:
            raise ValueError(f"{self.made} Gaussians cannot be {self.filtered} + {self.merged} + {self.kept}")

    def line(self) -> str:
        """For people, e.g. "1000 Gaussians made, 300 left out by the confidence filter, 200 merged into others, 500 kept"."""
        told = [f"{self.made} Gaussians made"]
        if self.filtered:
            told.append(f"{self.filtered} left out by the confidence filter")
        if self.merged:
            told.append(f"{self.merged} merged into others of the same voxel")
        return ", ".join([*told, f"{self.kept} kept"])


def concatenate(parts: list[Gaussians]) -> Gaussians:
    """All Gaussians of the parts, in order; the parts' opacities must be meant alike."""
    if not parts:
        raise ValueError("concatenate needs at least one set of Gaussians")
    if len({part.antialiased for part in parts}) > 1:
        raise ValueError("Gaussians for antialiasing rasterisers and others cannot be one scene")
    rows: dict[str, Any] = {name: torch.cat([getattr(p, name) for p in parts]) for name in ROWS}
    return replace(parts[0], **rows)


def sh_from_rgb(rgb: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Band-0 coefficient whose colour is ``rgb`` in every direction."""
    return (rgb - 0.5) / SH_DC


def rgb_from_sh(sh_dc: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Colour of a band-0 coefficient (not clamped)."""
    return sh_dc * SH_DC + 0.5
