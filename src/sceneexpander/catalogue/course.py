"""What is measured while a round runs: steps and looks of the adaptation, time and memory.

Names are those of the log (`StepRecord`, `Look`) and of the stages' statistics.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from sceneexpander.catalogue.metrics import Better, Group, Metric, Scope, Shown, Views

_STEP = Scope(views=Views.NONE)

# The objective of a step is two metrics: a step that also sees the inserted view has more terms to pay for.
OBJECTIVES = {
    True: Metric(
        name="loss_with_inserted",
        group=Group.LOSS,
        title="Objective of steps with the inserted view",
        scope=_STEP,
        better="lower",
    ),
    False: Metric(
        name="loss_without_inserted",
        group=Group.LOSS,
        title="Objective of steps without it",
        scope=_STEP,
        better="lower",
    ),
}


def _term(name: str, title: str, better: Better = "lower") -> Metric:
    return Metric(name=name, group=Group.LOSS, title=title, scope=_STEP, better=better)


STEPS = (
    _term("anchor_camera", "Cameras of captured views"),
    _term("anchor_depth", "Depth of captured views"),
    _term("anchor_normal", "Normals of captured views"),
    _term("anchor_gaussian", "Gaussians of captured views"),
    _term("gen_camera", "Inserted camera"),
    _term("gen_depth", "Inserted depth"),
    _term("gen_normal", "Inserted normals"),
    _term("drift", "Regulariser of the weights", ""),
    _term("gradient_norm", "Norm of the gradient", ""),
)
INSERTED_TERMS = ("gen_camera", "gen_depth", "gen_normal")  # not there on steps that do not see the inserted view

DRIFT_ALL = Metric(
    name="all_modules",
    group=Group.DRIFT,
    title="Weights moved",
    scope=_STEP,
    digits=3,
    meaning="Norm of the change of all weights since the round began.",
    shown=Shown.PAGE,
)
# What a look at a running adaptation measures; the drift is the norm over all modules.
LOOKS = (
    Metric(
        name="captured_psnr",
        group=Group.LOOK,
        title="Captured PSNR",
        scope=Scope(views=Views.CAPTURED),
        unit="dB",
        better="higher",
        meaning="Preservation: a few captured views rendered at the model's own cameras, against the photos.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="inserted_psnr",
        group=Group.LOOK,
        title="Inserted PSNR",
        scope=Scope(views=Views.INSERTED),
        unit="dB",
        better="higher",
        meaning="Expansion: the picture above it against the inserted one.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="captured_depth_change",
        group=Group.LOOK,
        title="Captured depth moved",
        scope=Scope(views=Views.CAPTURED),
        unit="%",
        digits=1,
        better="lower",
        meaning="Depth of the captured views against what the model believed before the insertion: mean absolute log ratio.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="head_disagreement",
        group=Group.LOOK,
        title="Heads disagree",
        scope=Scope(views=Views.NONE),
        unit="%",
        digits=1,
        better="lower",
        meaning="Depth that the model tells against the depth at which it puts its Gaussians: mean absolute log ratio.",
        shown=Shown.PAGE,
    ),
    DRIFT_ALL,
)

PEAK_MEMORY = Metric(
    name="peak_rss_mb",
    group=Group.COST,
    title="Peak memory",
    scope=_STEP,
    unit="MB",
    digits=0,
    better="lower",
)
WALL_TIME = Metric(
    name="wall_s",
    group=Group.COST,
    title="Time of all its stages",
    scope=_STEP,
    unit="s",
    digits=1,
    better="lower",
)
COURSE = (*OBJECTIVES.values(), *STEPS, *LOOKS, WALL_TIME, PEAK_MEMORY)


def drift_of_all(drift: Mapping[str, float]) -> float:
    """Norm of the change of all weights: modules share none, so their norms add up, squared."""
    return math.hypot(*drift.values())
