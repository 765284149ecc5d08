"""What an export says about itself: where it comes from, what of it was generated and by what, and how its numbers are meant."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import version

from sceneexpander.artifacts.inserted import Provenance

WORLD = (
    "right-handed world, OpenCV camera axes (x right, y down, z forward); world_from_cam maps points of the camera to the world; "
    "intrinsics in pixels with the origin at the top-left corner of the top-left pixel; depth is z-depth"
)
_TOLD = 300  # letters of a prompt


@dataclass(frozen=True, slots=True, kw_only=True)
class GeneratedView:
    """A view that nobody photographed. ``provenance``: how its picture was made; None: not recorded."""

    view: str
    round: int
    sha256: str
    provenance: Provenance | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Statement:
    """Goes with every export.

    Attributes:
        scene: its name.
        round: number of the last insertion.
        method: what made the reconstruction.
        part: ``all``, ``generated`` or ``captured``: what of the scene is in the export.
        gaussians: number of them in the export.
        generated_gaussians: how many of these come from generated views.
        generated_views: these views.
        unposed_views: views without a camera of their own; no camera is exported for them.
        metric: whether lengths are metres; False: their unit is the scene's own.
        software: what wrote it.
        convention: of coordinates, as the scene has them; a format with axes of its own says so in its file.
    """

    scene: str
    round: int
    method: str
    part: str
    gaussians: int
    generated_gaussians: int
    generated_views: tuple[GeneratedView, ...]
    unposed_views: tuple[str, ...] = ()
    metric: bool = False
    software: str = f"sceneexpander {version('sceneexpander')}"
    convention: str = WORLD

    @property
    def has_generated(self) -> bool:
        """Whether anything of the export was generated."""
        return self.generated_gaussians > 0 or (bool(self.generated_views) and self.part != "captured")

    def sentence(self) -> str:
        """For people, in one line."""
        if not self.has_generated:
            return "Nothing in this file was generated: all of it was reconstructed from photos."
        share = 100 * self.generated_gaussians / max(self.gaussians, 1)
        return (
            f"Contains AI-generated content: {self.generated_gaussians} of {self.gaussians} Gaussians ({share:.1f} %) come from "
            f"{len(self.generated_views)} generated view(s) and show what nobody photographed."
        )

    def lines(self) -> tuple[str, ...]:
        """The same with its sources, a line each, for headers."""
        made = [f"{self.software}: scene {self.scene}, round {self.round}, method {self.method}, part {self.part}"]
        made += [self.sentence()]
        for view in self.generated_views if self.has_generated else ():
            how = view.provenance
            line = f"generated view {view.view} (round {view.round}, sha256 {view.sha256})"
            if how is not None:
                line += f", by {how.backend} {how.source}, {how.digital_source_type or 'source type not known'}"
                line += f", prompt: {how.prompt[:_TOLD]}"
            made.append(line)
        return (*made, f"unit: {'metre' if self.metric else 'of the scene, not metric'}; {self.convention}")
