"""Where a camera could go next: motions that show something new beside enough of the scene, with what is covered so far."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

from sceneexpander.artifacts.store import FACTS_NAME, load_artifact, read_typed, save_artifact

SCHEMA = "proposals/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """One motion.

    Attributes:
        motion: in the words that a round takes.
        new: share of the picture that the scene does not show yet.
        direction_deg: where the camera looks then: azimuth to the right of the first view's gaze, elevation above it.
        preview: file beside the facts: what the scene shows of it, unseen parts continued from around.
    """

    motion: str
    new: float
    direction_deg: tuple[float, float]
    preview: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposals:
    """After a round.

    Attributes:
        start: name of the view that motions start from.
        covered: share of all directions from the cameras' middle in which the scene shows something.
        map: file beside the facts: these directions as a panorama, black where nothing is shown; None: no photo has a camera.
        proposals: the best first; empty where no motion is worth it.
    """

    start: str = ""
    covered: float = 0.0
    map: str | None = None
    proposals: tuple[Proposal, ...] = ()

    def save(self, folder: Path) -> None:
        """Write into a (scratch) folder, beside the pictures."""
        save_artifact(folder, SCHEMA, {f.name: getattr(self, f.name) for f in fields(self)}, {})

    @classmethod
    def load(cls, folder: Path) -> Proposals:
        """Read what `save` wrote. Raises `ArtifactError` if it is missing or damaged."""
        facts, _ = load_artifact(folder, SCHEMA)
        return read_typed(cls, facts, folder / FACTS_NAME)
