"""Held-out photos beside the finished cameras of round 0: straightened as the captured ones, and matched with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from sceneexpander.artifacts.held_out import HeldOut, TiePoints
from sceneexpander.artifacts.state import ExpansionState
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.frontend.distortion import Distortion
from sceneexpander.frontend.memory import MatchMemory
from sceneexpander.frontend.sfm_types import SfmConfig
from sceneexpander.frontend.tie_points import match_across
from sceneexpander.geometry.randomness import child_generator
from sceneexpander.reconstruction.cameras import straighten_views
from sceneexpander.reconstruction.optics import optics_of


def match_held_out(
    held_out: HeldOut, state: ExpansionState, config: SfmConfig, *, seed: int, memory: MatchMemory | None = None
) -> HeldOut:
    """The held-out photos with what ties them to the captured ones; as they are where none was held out.

    A photo that has the size and the lens of a captured one is straightened by what the front-end found of that lens.

    Args:
        held_out: as prepared.
        state: round 0, whose views are the captured photos.
        config: of the front-end.
        seed: of the run.
        memory: of round 0; not changed for others.
    """
    if held_out.views is None:
        return held_out
    like = _same_lens(held_out.views, state.views)
    views = straighten_views(held_out.views, _distortion(like, state))
    together = state.views.append(views)
    ids = together.view_ids
    found = match_across(
        together.images,
        config,
        old=len(state.views),
        generator=child_generator(seed, "held_out"),
        feature_images=together.detail_images,
        valid=together.valid,
        memory=memory,
    )
    return replace(
        held_out,
        views=views,
        lens_of=tuple("" if view is None else ids[view] for view in like),
        ties=tuple(
            TiePoints(
                held_out=ids[tie.new],
                captured=ids[tie.old],
                held_out_xy=torch.from_numpy(tie.new_xy),
                captured_xy=torch.from_numpy(tie.old_xy),
            )
            for tie in found
        ),
    )


def _same_lens(views: ViewSet, captured: ViewSet) -> list[int | None]:
    """Per view the first captured one of the same size whose file says the same of its lens."""
    kinds = [(own.original_size, own.lens) for own in optics_of(captured)]
    wanted = [(own.original_size, own.lens) for own in optics_of(views)]
    return [kinds.index(kind) if kind in kinds else None for kind in wanted]


def _distortion(like: Sequence[int | None], state: ExpansionState) -> Distortion | None:
    lenses = state.priors.intrinsics_px
    if lenses is None:
        return None
    k = [(0.0, 0.0) if view is None else state.views.records[view].distortion for view in like]
    return Distortion(
        intrinsics=np.stack([lenses[view or 0].double().cpu().numpy() for view in like]), k=np.array(k, np.float64)
    )
