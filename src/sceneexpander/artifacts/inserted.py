"""Generated candidates and the one that was chosen, with everything known about how they came to be."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from sceneexpander.artifacts.store import FACTS_NAME, load_artifact, read_typed, refusing, save_artifact
from sceneexpander.artifacts.views import ViewSet

SCHEMA = "inserted/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class Provenance:
    """How one picture was made. Never holds a secret: keys are read from the environment at call time only."""

    backend: str  # "replay", "file", ...
    prompt: str  # the full text, after the template was filled
    source: str  # file name, or model snapshot
    sha256: str  # of the picture's original bytes
    reference_sha256: tuple[str, ...] = ()  # of the captured pictures that were shown to the generator
    parameters: dict[str, str] = field(default_factory=dict)
    refusal: str | None = None  # why it cannot be used


@dataclass(frozen=True, slots=True, kw_only=True)
class InsertedView:
    """The chosen candidate fitted to the captured views' size; all candidates' provenance in order."""

    round: int
    view: ViewSet  # exactly one view, generated=True
    chosen: int
    provenance: tuple[Provenance, ...]

    def __post_init__(self) -> None:
        if len(self.view) != 1:
            raise ValueError(f"an inserted view is one picture, got {len(self.view)}")
        if not 0 <= self.chosen < len(self.provenance):
            raise ValueError(f"candidate {self.chosen} was chosen from {len(self.provenance)}")

    def save(self, folder: Path) -> None:
        """Write into a (scratch) folder."""
        self.view.save(folder / "view")
        facts = {"round": self.round, "chosen": self.chosen, "provenance": self.provenance}
        save_artifact(folder, SCHEMA, facts, {})

    @classmethod
    def load(cls, folder: Path) -> InsertedView:
        """Read what `save` wrote. Raises `ArtifactError` if it is missing or damaged."""
        facts, _ = load_artifact(folder, SCHEMA)
        read = read_typed(_Facts, facts, folder / FACTS_NAME)
        with refusing(folder):
            return cls(
                round=read.round, view=ViewSet.load(folder / "view"), chosen=read.chosen, provenance=read.provenance
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Facts:
    """Everything of an `InsertedView` but the view, which is an artefact of its own."""

    round: int
    chosen: int
    provenance: tuple[Provenance, ...]
