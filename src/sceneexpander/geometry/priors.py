"""What is known or estimated about views before a network sees them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# Channels of `Priors.evidence`: how the geometric front-end came to its dense depth, per pixel.
EVIDENCE_CHANNELS = (
    "confident",  # 1 where the depth is probably within 5 % of the truth
    "agreeing",  # number of agreeing other views / (number of views - 1)
    "cost",  # matching cost 1 - ZNCC at the chosen depth, in [0, 1.2]
    "ambiguity",  # share of depth hypotheses nearly as good as the chosen one, in [0, 1]
    "parallax",  # log(1 + pixels of parallax per 10 % of depth)
    "plane",  # inlier score of the plane that filled the pixel, 0 where none did
    "gap",  # log(raw matched depth / final depth), clamped to [-1, 1]
    "sparse",  # log(depth interpolated from sparse points / final depth), clamped to [-1, 1]
    "distance",  # log(1 + pixels to the nearest sparse point)
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Priors:
    """What is known or estimated about S views before the network runs. Every field may be absent.

    The world frame is the first view's camera frame (``world_from_cam[0]`` is the identity) when poses are given.
    ``evidence`` is the geometric front-end's per-pixel description of its dense depth (channels as documented in
    `sceneexpander.frontend`); only models that say so read it. Not differentiated.
    """

    world_from_cam: Float[Tensor, "view 4 4"] | None = None
    intrinsics_px: Float[Tensor, "view 3 3"] | None = None
    depth: Float[Tensor, "view height width"] | None = None  # z-depth in the poses' scale; 0 = missing
    evidence: Float[Tensor, "view channel height width"] | None = None
    posed: Bool[Tensor, "view"] | None = None  # False: the pose is a placeholder, not an estimate

    def select(self, views: Sequence[int] | Tensor) -> Priors:
        """Priors of a subset of the views, in the given order (frame and scale unchanged)."""
        index = torch.as_tensor(views)
        picked = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{name: None if value is None else value[index] for name, value in picked.items()})

    def to(self, device: torch.device | str) -> Priors:
        """The same priors on another device."""
        picked = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{name: None if value is None else value.to(device) for name, value in picked.items()})
