"""How a reconstruction is shown."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from sceneexpander.errors import UserError

Path = Literal["tour", "orbit", "spiral", "keyframes"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewKey:
    """A key frame at the camera of a view, in the reconstruction's own gauge, with that view's lens."""

    view: str


@dataclass(frozen=True, slots=True, kw_only=True)
class EyeKey:
    """A key frame at a place, upright, with the lens of the inserted view.

    Both points are in the world frame of the unadapted backbone (its ``trajectory.json`` tells where its cameras are); for other
    methods they are brought over by the captured cameras.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]

    def __post_init__(self) -> None:
        if not all(math.isfinite(value) for value in (*self.eye, *self.target)) or self.eye == self.target:
            raise UserError(f"eye {self.eye} and target {self.target} must be two finite places", where="keyframes")


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderConfig:
    """Settings of the navigation video.

    Attributes:
        path: where the camera goes: ``tour`` (from the captured cameras into the inserted view and back), ``orbit`` (around what the
            inserted view looks at), ``spiral`` (about the inserted view), or ``keyframes``.
        keyframes: what the path ``keyframes`` passes, in order and smoothly; at least two.
        orbit_deg: of the orbit: 360 is a whole turn, less a swing of half of it to either side and back.
        spiral_turns: turns of the spiral.
        spiral_radius: widest distance of the spiral from the inserted camera, share of the distance to what it looks at.
        frames: frames of the whole path, at least 2.
        fps: frames per second of the videos.
        crf: constant quality of the videos, 0 (lossless) to 51; 18 looks like the original.
        scale: video size relative to the stored images.
        stills: frames that are also kept as pictures, evenly spread.
        background: grey behind the scene, in [0, 1].
        antialiased: compensate opacities for the rasteriser's blur.
        spz: write the Gaussians as ``gaussians.spz`` too, a tenth of the PLY, without provenance.
    """

    path: Path = "tour"
    keyframes: tuple[ViewKey | EyeKey, ...] = ()
    orbit_deg: float = 60.0
    spiral_turns: float = 2.0
    spiral_radius: float = 0.15
    frames: int = 96
    fps: int = 24
    crf: int = 18
    scale: float = 1.0
    stills: int = 6
    background: float = 0.08
    antialiased: bool = False
    spz: bool = False

    def __post_init__(self) -> None:
        for name, low in (("frames", 2), ("fps", 1), ("stills", 1)):
            if getattr(self, name) < low:
                raise UserError(f"must be >= {low}, is {getattr(self, name)}", where=f"render.{name}")
        for name, over, high in (
            ("scale", 0, 8),
            ("orbit_deg", 0, 360),
            ("spiral_turns", 0, 20),
            ("spiral_radius", 0, 1),
        ):
            if not over < getattr(self, name) <= high:
                raise UserError(f"must be within ({over}, {high}], is {getattr(self, name)}", where=f"render.{name}")
        for name, high in (("background", 1), ("crf", 51)):
            if not 0 <= getattr(self, name) <= high:
                raise UserError(f"must be within [0, {high}], is {getattr(self, name)}", where=f"render.{name}")
        if self.path == "keyframes" and len(self.keyframes) < 2:
            raise UserError(f"path keyframes needs at least two, has {len(self.keyframes)}", where="render.keyframes")
