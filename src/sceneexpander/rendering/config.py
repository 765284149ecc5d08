"""How a reconstruction is shown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from sceneexpander.errors import UserError
from sceneexpander.exports.formats import check_formats
from sceneexpander.ranges import Range, Share, check_ranges

_Place = Annotated[float, Range(-1e9, 1e9)]
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

    eye: tuple[_Place, _Place, _Place]
    target: tuple[_Place, _Place, _Place]

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.eye == self.target:
            raise UserError(f"is {self.eye} like the eye, must be another place", where="target")


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
        exports: formats that the scene is also written in, to ``exports/`` (`sceneexpander.exports.FORMATS`).
        spz: write the Gaussians as ``gaussians.spz`` too, a tenth of the PLY, without provenance.
    """

    path: Path = "tour"
    keyframes: tuple[ViewKey | EyeKey, ...] = ()
    orbit_deg: Annotated[float, Range(0, 360, low_open=True)] = 60.0
    spiral_turns: Annotated[float, Range(0, 20, low_open=True)] = 2.0
    spiral_radius: Annotated[float, Range(0, 1, low_open=True)] = 0.15
    frames: Annotated[int, Range(2, 100_000)] = 96
    fps: Annotated[int, Range(1, 240)] = 24
    crf: Annotated[int, Range(0, 51)] = 18
    scale: Annotated[float, Range(0, 8, low_open=True)] = 1.0
    stills: Annotated[int, Range(1, 1000)] = 6
    background: Share = 0.08
    spz: bool = False
    exports: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_ranges(self)
        check_formats(self.exports, where="render.exports")
        if self.path == "keyframes" and len(self.keyframes) < 2:
            raise UserError(f"path keyframes needs at least two, has {len(self.keyframes)}", where="render.keyframes")
