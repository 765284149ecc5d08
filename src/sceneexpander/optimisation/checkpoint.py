"""Resume points of a running optimisation: tensors, the step, and the run that they belong to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from sceneexpander.artifacts.store import load_fields, load_resume_point, save_artifact
from sceneexpander.files import directory_being_written

SCHEMA = "optimisation-checkpoint/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimisationCheckpoint:
    """State after ``step`` finished steps. All random draws follow from seed and step number, so nothing else is needed."""

    run_key: str  # what determines the run
    step: int
    losses: list[float]
    splats: dict[str, Tensor]
    density: dict[str, Tensor]
    cameras: dict[str, Tensor]

    def save(self, folder: Path) -> None:
        """Replace the checkpoint in ``folder`` atomically."""
        tensors: dict[str, Tensor] = {}
        for part in ("splats", "density", "cameras"):
            tensors |= {f"{part}/{name}": value for name, value in getattr(self, part).items()}
        facts = {"run_key": self.run_key, "step": self.step, "losses": self.losses}
        with directory_being_written(folder) as scratch:
            save_artifact(scratch, SCHEMA, facts, tensors)

    @classmethod
    def load(cls, folder: Path, run_key: str) -> OptimisationCheckpoint | None:
        """The checkpoint of this very run, or None if there is none (damaged ones are reported and ignored)."""

        def build(facts: dict[str, Any], tensors: dict[str, Tensor]) -> OptimisationCheckpoint:
            parts: dict[str, Any] = {"splats": {}, "density": {}, "cameras": {}}
            for key, value in tensors.items():
                part, _, name = key.partition("/")
                parts[part][name] = value
            return cls(**load_fields(cls, facts, {}, folder, given=tuple(parts)), **parts)

        return load_resume_point(folder, SCHEMA, run_key, build)
