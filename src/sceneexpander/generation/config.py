"""How the picture beyond the captured boundary is obtained."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.errors import UserError
from sceneexpander.ingest.config import FITS, Fit


@dataclass(frozen=True, slots=True, kw_only=True)
class GeneratorConfig:
    """Settings of `generate_inserted_view`.

    Attributes:
        backend: name of the back-end, see `sceneexpander.generation.backends`.
        file: the picture that the back-end ``file`` takes; ``{round}`` in it becomes the round's number.
        count: how many candidates to ask for; back-ends with stored pictures deliver all that they have.
        candidate: which candidate is inserted, counted from 0 in the order of the contact sheet.
        fit: how a candidate is brought to the captured ratio: ``crop`` or ``pad`` (letterbox on grey).
    """

    backend: str = "replay"
    file: str | None = None
    count: int = 1
    candidate: int = 0
    fit: Fit = "crop"

    def __post_init__(self) -> None:
        if self.count < 1:
            raise UserError(f"must be at least 1, is {self.count}", where="generator.count")
        if self.candidate < 0:
            raise UserError(f"must not be negative, is {self.candidate}", where="generator.candidate")
        if self.fit not in FITS:
            raise UserError(f"is {self.fit!r}", where="generator.fit", fix=f"use one of: {', '.join(FITS)}")
