"""What was found out about the cameras of a set of views, view by view, in words and numbers for people."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sceneexpander.artifacts.store import FACTS_NAME, load_artifact, read_typed, save_artifact

SCHEMA = "cameras/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewCamera:
    """One view's camera and the evidence for it.

    Attributes:
        view_id: as in the view set.
        name: the original file's.
        generated: whether the picture was generated.
        posed: whether its pose is an estimate that passed every test; False: it stands at a placeholder and explains nothing.
        rough: posed, but at a loose threshold.
        reason: why it is not posed or only roughly; empty otherwise.
        warnings: what a person should know although the view is used ("mirrored", "cropped", "overlay"); empty mostly.
        focal_ratio: focal length over the long side of the stored picture.
        focal_source: where the focal length came from, one word.
        distortion: (k1, k2) found and taken out.
        inliers: observations of triangulated points; 0 without.
        error_px: mean reprojection error in stored pixels; None without any.
    """

    view_id: str
    name: str
    generated: bool
    posed: bool
    rough: bool
    reason: str
    warnings: tuple[str, ...]
    focal_ratio: float
    focal_source: str
    distortion: tuple[float, float]
    inliers: int
    error_px: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraReport:
    """All views of one reconstruction. ``notes`` are about the set as a whole. Written by the stages that estimate cameras."""

    views: tuple[ViewCamera, ...]
    notes: tuple[str, ...]

    @property
    def posed(self) -> int:
        """Number of views with a pose."""
        return sum(view.posed for view in self.views)

    def summary(self) -> str:
        """One line: "4 of 5 photos used, 1 of them roughly: c.jpg left out (its matches agree with no camera)"."""
        out = [f"{view.name} left out ({view.reason})" for view in self.views if not view.posed]
        kind = "views" if any(view.generated for view in self.views) else "photos"
        rough = sum(view.posed and view.rough for view in self.views)
        how = "" if not rough else ", all of them roughly" if rough == self.posed else f", {rough} of them roughly"
        return f"{self.posed} of {len(self.views)} {kind} used{how}" + (f": {'; '.join(out)}" if out else "")

    def problems(self) -> tuple[str, ...]:
        """A line for everything that is not as it should be: views left out or rough, warnings, notes."""
        lost = [f"{view.name}: left out, {view.reason}" for view in self.views if not view.posed]
        return (*lost, *self.remarks())

    def remarks(self) -> tuple[str, ...]:
        """What `summary` does not say: views that are only roughly right, a line for each reason, warnings, notes."""
        rough: dict[str, list[str]] = {}
        for view in self.views:
            if view.posed and view.reason:
                rough.setdefault(view.reason, []).append(view.name)
        lines = [f"{', '.join(names)}: roughly placed, {reason}" for reason, names in rough.items()]
        lines += [f"{view.name}: {warning}" for view in self.views for warning in view.warnings]
        return (*lines, *self.notes)

    def save(self, folder: Path) -> None:
        """Write into an existing or new (scratch) folder."""
        folder.mkdir(parents=True, exist_ok=True)
        save_artifact(folder, SCHEMA, {"views": self.views, "notes": self.notes}, {})

    @classmethod
    def load(cls, folder: Path) -> CameraReport:
        """Read what `save` wrote. Raises `ArtifactError` if it is missing or damaged."""
        facts, _ = load_artifact(folder, SCHEMA)
        return read_typed(cls, facts, folder / FACTS_NAME)
