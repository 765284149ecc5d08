"""How the picture beyond the captured boundary is obtained."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from sceneexpander.errors import UserError
from sceneexpander.ingest.config import FITS, Fit
from sceneexpander.ranges import Range, check_ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class GeneratorConfig:
    """Settings of `generate_inserted_view`.

    Attributes:
        backend: name of the back-end, see `sceneexpander.generation.backends`.
        file: the picture that the back-end ``file`` takes; ``{round}`` in it becomes the round's number.
        candidate: which candidate is inserted, counted from 0 in the order of the contact sheet.
        fit: how a candidate is brought to the captured ratio: ``crop`` or ``pad`` (letterbox on grey).
    """

    backend: str = "replay"
    file: str | None = None
    candidate: Annotated[int, Range(0, 1000)] = 0
    fit: Fit = "crop"

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.fit not in FITS:
            raise UserError(f"is {self.fit!r}", where="generator.fit", fix=f"use one of: {', '.join(FITS)}")
