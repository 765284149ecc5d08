"""What the corrections of a round's inputs changed of the given estimate and picture, written down (beyond the paper)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from sceneexpander.insertion.realign import RealignReport


class Estimate(StrEnum):
    """Where a round's cameras and depths come from: all views together, or the captured ones as before the insertion."""

    JOINT = "joint"
    HELD = "held"


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectionsReport:
    """Attributes:
    estimate: the one that was taken.
    joint_error: mean squared error of the captured photos as the joint estimate shows them; None: the two were not compared.
    held_error: the same of the held one.
    refinement: of the inserted camera; None: it was not refined.
    gains: on the inserted picture's colours (RGB); None: it is as it was given.
    """

    estimate: Estimate = Estimate.JOINT
    joint_error: float | None = None
    held_error: float | None = None
    refinement: RealignReport | None = None
    gains: tuple[float, float, float] | None = None
