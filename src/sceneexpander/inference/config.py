"""How the reconstructors of others are run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from sceneexpander.errors import UserError
from sceneexpander.ranges import Range, check_ranges

NEEDS_CHECKPOINT = "needs the public checkpoint"


@dataclass(frozen=True, slots=True, kw_only=True)
class RivalConfig:
    """How another reconstructor is run.

    ``weights`` are a .safetensors path or a hub id with revision; without them the method's row says that they are needed.
    ``priors``: what it is told besides the pictures, nothing or the geometric front-end's cameras and depth.
    """

    variant: str = "default"
    weights: str | None = None
    allow_download: bool = False
    priors: Literal["none", "front_end"] = "none"
    long_side_px: Annotated[int, Range(1, 4096)] = 518  # of the pictures it is given

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class RivalsConfig:
    """One section per reconstructor, under the name of its method."""

    omnivggt: RivalConfig
    ttt3r: RivalConfig

    def __post_init__(self) -> None:
        if self.ttt3r.priors != "none":
            raise UserError("reads no priors", where="ttt3r", fix="use priors=none")

    def of(self, method: str) -> RivalConfig:
        """The section of a method."""
        section: RivalConfig = getattr(self, method)
        return section
