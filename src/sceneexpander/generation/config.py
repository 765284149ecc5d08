"""How the picture beyond the captured boundary is obtained, and which one is taken."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from sceneexpander.errors import UserError
from sceneexpander.ingest.config import FITS, Fit
from sceneexpander.ranges import Range, check_ranges

AUTO = "auto"


@dataclass(frozen=True, slots=True, kw_only=True)
class GeneratorConfig:
    """What the settings of all back-ends share. Which type the section has is decided by ``backend``: `BACKENDS` lists them.

    Attributes:
        backend: name of the back-end.
    """

    backend: str

    def named_file(self, round_number: int) -> Path | None:
        """The file outside of the scene folder that a round's picture depends on; None if there is none, or none is named."""
        return None

    @classmethod
    def family(cls) -> tuple[str, Mapping[str, type]]:
        """The key that tells the members apart, and the members by its value; see `sceneexpander.typed`."""
        from sceneexpander.generation.backends import BACKENDS

        return "backend", {name: backend.config for name, backend in BACKENDS.items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceConfig(GeneratorConfig):
    """What the settings of all back-ends that make pictures on request share.

    Attributes:
        candidates: how many pictures are asked for, one request each.
        take: another number asks for new pictures; those made before stay in the cache, and come back with their number.
        max_requests: most requests of one run of the stage, repeated ones included.
        max_cost_usd: most that one run of the stage may cost; None: no limit.
        max_scene_requests: most requests for a scene: all rounds, all runs; None: no limit.
        max_scene_cost_usd: most that these may cost; None: no limit.
        price_usd: of one picture, as the service's price list says; None: not known.
        attempts: how often a request is sent that fails for a passing reason.
        timeout_s: how long an answer may take.
        max_references: most views that are shown to the generator.
        reference_side_px: long side of the pictures that are shown to it.
    """

    candidates: Annotated[int, Range(1, 100)]
    take: Annotated[int, Range(0, 10**6)]
    max_requests: Annotated[int, Range(1, 10_000)]
    max_cost_usd: Annotated[float, Range(0, 1e6)] | None
    max_scene_requests: Annotated[int, Range(1, 10**6)] | None = None
    max_scene_cost_usd: Annotated[float, Range(0, 1e6)] | None = None
    price_usd: Annotated[float, Range(0, 1e6)] | None
    attempts: Annotated[int, Range(1, 20)]
    timeout_s: Annotated[float, Range(0, 86_400, low_open=True)]
    max_references: Annotated[int, Range(1, 16)]
    reference_side_px: Annotated[int, Range(64, 4096)]

    def __post_init__(self) -> None:
        check_ranges(self)
        for name in ("max_cost_usd", "max_scene_cost_usd"):
            if getattr(self, name) is not None and self.price_usd is None:
                problem = f"is not known, so generator.{name} cannot be kept"
                raise UserError(problem, where="generator.price_usd", fix="set it to what one picture costs")


@dataclass(frozen=True, slots=True, kw_only=True)
class ChoiceConfig:
    """Which candidate is inserted.

    Attributes:
        candidate: ``auto`` (the one that goes best with the scene), its number on the contact sheet, or a picture file of your own;
            ``{round}`` in a file's name becomes the round's number.
        fit: how it is brought to the captured ratio: ``crop`` or ``pad`` (letterbox on grey).
    """

    candidate: Annotated[int, Range(0, 1000)] | str = AUTO
    fit: Fit = "crop"

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.candidate == "":
            raise UserError("is empty", where="choose.candidate", fix="use auto, a number from 0, or a file")
        if self.fit not in FITS:
            raise UserError(f"is {self.fit!r}", where="choose.fit", fix=f"use one of: {', '.join(FITS)}")

    def named_file(self, round_number: int) -> Path | None:
        """The user's own picture; None where a candidate is taken."""
        own = isinstance(self.candidate, str) and self.candidate != AUTO
        return picture_path(str(self.candidate), round_number) if own else None


def picture_path(given: str, round_number: int) -> Path:
    """A path as a user writes it: ``{round}`` filled unless that is in the file's own name, ``~`` written out."""
    named = given if os.path.isfile(given) else given.replace("{round}", str(round_number))
    return Path(os.path.expanduser(named))  # unlike Path's own, no error for a "~name" that is nobody's home
