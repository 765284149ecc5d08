"""Resume points of a running adaptation.

A checkpoint holds everything the next step depends on (all random draws are derived from the seed and the step number), so a
resumed run gives the same bits as an unbroken one on a CPU. It names the run it belongs to; a checkpoint of another run is ignored.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from sceneexpander.artifacts.store import load_fields, load_resume_point, save_artifact
from sceneexpander.files import directory_being_written
from sceneexpander.typed import decode

SCHEMA = "adaptation-checkpoint/3"


@dataclass(frozen=True, slots=True, kw_only=True)
class Checkpoint:
    """State after ``step`` finished steps. ``buckets`` is that of `WeightLedger.state`."""

    run_key: str  # hash of everything that determines the run
    step: int
    buckets: list[tuple[tuple[str, ...], dict[str, Tensor]]]
    records: list[dict[str, Any]]
    looks: list[dict[str, Any]]

    def save(self, folder: Path) -> None:
        """Replace the checkpoint in ``folder`` atomically."""
        facts = {
            "run_key": self.run_key,
            "step": self.step,
            "names": [names for names, _ in self.buckets],
            "records": self.records,
            "looks": self.looks,
        }
        tensors = {f"{i}/{key}": value for i, (_, parts) in enumerate(self.buckets) for key, value in parts.items()}
        with directory_being_written(folder) as scratch:
            save_artifact(scratch, SCHEMA, facts, tensors)

    @classmethod
    def load(cls, folder: Path, run_key: str) -> Checkpoint | None:
        """The checkpoint of this very run, or None if there is none (damaged ones are reported and ignored)."""

        def build(facts: dict[str, Any], tensors: dict[str, Tensor]) -> Checkpoint:
            all_names = decode(tuple[tuple[str, ...], ...], facts.pop("names"), where="names")
            parts: list[dict[str, Tensor]] = [{} for _ in all_names]
            for key, value in tensors.items():
                index, _, name = key.partition("/")
                parts[int(index)][name] = value
            buckets = list(zip(all_names, parts, strict=True))
            return cls(**load_fields(cls, facts, {}, folder, given=("buckets",)), buckets=buckets)

        return load_resume_point(folder, SCHEMA, run_key, build)
