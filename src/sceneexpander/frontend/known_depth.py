"""Depth that came with the pictures in the place of matched depth."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.geometry.priors import EVIDENCE_CHANNELS

_NEAR = 0.1  # of the depth: agreement of two estimates
_LEAST_AGREEING = 0.3  # of the pixels whose matched depth is confident; chance gives about half of that
_LEAST_PIXELS = 100
# What a measured pixel's evidence says; channels that are not named keep what matching found.
_MEASURED = {"confident": 1.0, "agreeing": 1.0, "cost": 0.0, "ambiguity": 0.0, "plane": 0.0, "gap": 0.0, "sparse": 0.0}


def merge_known_depth(
    depth: Float[Tensor, "view height width"],
    evidence: Float[Tensor, "view channel height width"],
    known: Float[Tensor, "view height width"],
    *,
    unit: float | None,
) -> tuple[Float[Tensor, "view height width"], Float[Tensor, "view channel height width"], str]:
    """Matched depth and its evidence with measured depth where there is some.

    Args:
        depth: matched.
        evidence: channels as `EVIDENCE_CHANNELS`.
        known: measured, in the unit of the known poses; 0 where there is none.
        unit: length of that unit in the unit of ``depth``; None if no pose says it: then the median ratio is taken.

    Returns:
        (depth, evidence, what to say of it): as they were if the measured depth contradicts what is matched with confidence.
    """
    measured = known > 0
    sure = measured & (evidence[:, EVIDENCE_CHANNELS.index("confident")] > 0.5) & (depth > 0)
    compared = int(sure.sum())
    if unit is None:
        both = sure if compared >= _LEAST_PIXELS else measured & (depth > 0)
        if not bool(both.any()):
            return depth, evidence, ""
        unit = float((depth[both] / known[both]).median())
    scaled = known * unit
    if compared >= _LEAST_PIXELS:
        share = float(((scaled[sure] / depth[sure]).log().abs() < _NEAR).float().mean())
        if share < _LEAST_AGREEING:
            note = (
                f"the given depth contradicts the pictures: {share:.0%} of {compared} matched pixels are within {_NEAR:.0%} of it,"
                f" less than {_LEAST_AGREEING:.0%}; not used"
            )
            return depth, evidence, note
    told = evidence.clone()
    for name, value in _MEASURED.items():
        channel = EVIDENCE_CHANNELS.index(name)
        told[:, channel] = torch.where(measured, torch.full_like(scaled, value), told[:, channel])
    return torch.where(measured, scaled, depth), told, ""
