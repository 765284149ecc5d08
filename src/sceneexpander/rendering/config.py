"""How a reconstruction is shown."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.errors import UserError


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderConfig:
    """Settings of the navigation video.

    Attributes:
        frames: frames of the whole tour, at least 2.
        fps: frames per second of the videos.
        scale: video size relative to the stored images.
        stills: frames that are also kept as pictures, evenly spread.
        background: grey behind the scene, in [0, 1].
        antialiased: compensate opacities for the rasteriser's blur.
    """

    frames: int = 96
    fps: int = 24
    scale: float = 1.0
    stills: int = 6
    background: float = 0.08
    antialiased: bool = False

    def __post_init__(self) -> None:
        for name, low in (("frames", 2), ("fps", 1), ("stills", 1)):
            if getattr(self, name) < low:
                raise UserError(f"must be >= {low}, is {getattr(self, name)}", where=f"render.{name}")
        if not 0 < self.scale <= 8:
            raise UserError(f"must be within (0, 8], is {self.scale}", where="render.scale")
        if not 0 <= self.background <= 1:
            raise UserError(f"must be within [0, 1], is {self.background}", where="render.background")
