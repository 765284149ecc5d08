"""All corrections of a round as one section of the configuration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from importlib.metadata import entry_points
from typing import Any

from sceneexpander.errors import UserError, did_you_mean
from sceneexpander.insertion.camera import Camera
from sceneexpander.insertion.colour import Colour
from sceneexpander.insertion.contradiction import Contradiction
from sceneexpander.insertion.free_space import FreeSpace
from sceneexpander.insertion.gap_filling import GapFilling
from sceneexpander.insertion.head import GaussianHead
from sceneexpander.insertion.protocol import Correction
from sceneexpander.typed import DecodeError, decode_dataclass

ENTRY_POINTS = "sceneexpander.corrections"  # where other packages name theirs


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectionsConfig:
    """What is done around Algorithm 1, beyond the paper. Those that act in the same place (`Correction`) run in this order.

    ``others`` are corrections of other packages, by the name of their entry point (group `ENTRY_POINTS`), with their settings; they run
    last.
    """

    camera: Camera = field(default_factory=Camera)
    colour: Colour = field(default_factory=Colour)
    head: GaussianHead = field(default_factory=GaussianHead)
    free_space: FreeSpace = field(default_factory=FreeSpace)
    gaps: GapFilling = field(default_factory=GapFilling)
    contradiction: Contradiction = field(default_factory=Contradiction)
    others: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _made(self.others)

    def in_order(self) -> tuple[Correction, ...]:
        """The corrections as they run."""
        own = (getattr(self, f.name) for f in fields(self) if f.name != "others")
        return (*own, *_made(self.others))


def _made(sections: Mapping[str, Mapping[str, Any]]) -> list[Correction]:
    """Corrections of other packages with these settings. Raises `UserError` for an unknown name, a wrong setting, or no correction."""
    if not sections:
        return []  # looking through all installed packages takes its time
    brought = {point.name: point for point in entry_points(group=ENTRY_POINTS)}
    made: list[Correction] = []
    for name, settings in sections.items():
        if name not in brought:
            fix = (
                did_you_mean(name, brought) if brought else f"none brings any: they are entry points of {ENTRY_POINTS}"
            )
            raise UserError(f"no installed package brings a correction {name!r}", where="others", fix=fix)
        try:
            correction = decode_dataclass(brought[name].load(), settings, where=name)
        except DecodeError as error:
            raise UserError(f"{error.where} {error.problem}", where="others", fix=error.fix) from None
        if not isinstance(correction, Correction):
            raise UserError(f"{name} has no method of a correction", where="others", fix="see insertion/protocol.py")
        made.append(correction)
    return made
