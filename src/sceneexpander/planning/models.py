"""The models that can be planned, by name: built from their configurations, without weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sceneexpander.errors import UserError, did_you_mean
from sceneexpander.geometry.priors import EVIDENCE_CHANNELS
from sceneexpander.models.mini import Mini, MiniConfig
from sceneexpander.models.mini.config import OUTPUT_STRIDE
from sceneexpander.models.mini.inputs import (
    COARSE_CHANNELS,
    FINE_CHANNELS,
    MeasuredPriors,
    PreparedViews,
    WorkingViews,
    working_size,
)
from sceneexpander.models.mini.pairs import CROSS_VIEW_CHANNELS, PairGeometry
from sceneexpander.models.protocol import ALL_HEADS, Head, Reconstructor
from sceneexpander.models.worldmirror import WorldMirror, WorldMirrorConfig
from sceneexpander.typed import shorten


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedModel:
    """How to make a model and its prepared input, see `PlanRequest`; and the heads that can be planned."""

    build: Callable[[], Reconstructor]
    prepared: Callable[[Reconstructor, Tensor], object] | None
    heads: frozenset[Head]
    multiple: int  # of the image sides


def planned_model(name: str) -> PlannedModel:
    """A model by ``name`` or ``name/variant``.

    Raises:
        UserError: there is none of that name.
    """
    variants: dict[str, Callable[[], WorldMirrorConfig]] = {
        "worldmirror": WorldMirrorConfig.large,
        "worldmirror/large": WorldMirrorConfig.large,
        "worldmirror/mid": WorldMirrorConfig.mid,
        "worldmirror/tiny": WorldMirrorConfig.tiny,
    }
    if name in ("mini", "mini/default"):
        # How Gaussians of the embedded model give way to one another depends on values, which a plan does not have.
        return PlannedModel(
            build=Mini, prepared=_mini_input, heads=ALL_HEADS - {Head.GAUSSIANS}, multiple=Mini.size_multiple
        )
    if name not in variants:
        raise UserError(
            f"unknown model {shorten(name)!r}", where="model", fix=did_you_mean(shorten(name), [*variants, "mini"])
        )
    config = variants[name]()
    # How many Gaussians a merge leaves depends on values as well; without it none is lost.
    config = replace(config, gaussian=replace(config.gaussian, merge=False))
    return PlannedModel(build=lambda: WorldMirror(config), prepared=None, heads=ALL_HEADS, multiple=config.patch)


def _mini_input(model: Reconstructor, images: Tensor) -> PreparedViews:
    """What `Mini.prepare` would give, as far as shapes go."""
    config = model.config if isinstance(model, Mini) else MiniConfig()
    views, _, height, width = images.shape
    rows, columns = working_size(height, width, config.work_px)
    out = (rows // OUTPUT_STRIDE, columns // OUTPUT_STRIDE)
    poses, intrinsics = torch.zeros(views, 4, 4), torch.zeros(views, 3, 3)
    priors = MeasuredPriors(
        world_from_cam=poses,
        intrinsics_px=intrinsics,
        depth=torch.zeros(views, height, width),
        known=None,
        confident=torch.zeros(views, height, width),
        posed=torch.zeros(views, dtype=torch.bool),
        log_depth_fine=torch.zeros(views, rows, columns),
        confident_fine=torch.zeros(views, rows, columns),
        coarse=torch.zeros(views, COARSE_CHANNELS - CROSS_VIEW_CHANNELS, *out),
        base_normals=torch.zeros(views, *out, 3),
        pairs=_KeptPairs(views, out, torch.zeros(views, len(EVIDENCE_CHANNELS), height, width)),
        views=tuple(range(views)),
    )
    working = WorkingViews(
        fine=torch.zeros(views, FINE_CHANNELS, rows, columns), coarse=torch.zeros(views, COARSE_CHANNELS, *out)
    )
    return PreparedViews(images=images, priors=priors, scale=1.0, working=working)


class _KeptPairs(PairGeometry):
    """The memory of all pairs' comparisons, and of the priors that they were made from."""

    def __init__(self, views: int, size: tuple[int, int], evidence: Tensor) -> None:
        points = views * (views - 1) * size[0] * size[1]
        self.kept = torch.zeros(points, 5), torch.zeros(points, dtype=torch.bool), evidence
