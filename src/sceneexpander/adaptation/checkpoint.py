"""Resume points of a running adaptation.

A checkpoint holds everything the next step depends on (all random draws are derived from the seed and the step number), so a
resumed run gives the same bits as an unbroken one on a CPU. It names the run it belongs to; a checkpoint of another run is ignored.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sceneexpander.artifacts.store import ArtifactError, directory_being_written, load_artifact, save_artifact

SCHEMA = "adaptation-checkpoint/1"
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Checkpoint:
    """State after ``step`` finished steps."""

    run_key: str  # hash of everything that determines the run
    step: int
    student: dict[str, Tensor]
    teacher: dict[str, Tensor]
    first_moment: dict[str, Tensor]
    second_moment: dict[str, Tensor]
    optimiser_steps: dict[str, int]
    records: list[dict[str, Any]]

    def save(self, folder: Path) -> None:
        """Replace the checkpoint in ``folder`` atomically."""
        tensors: dict[str, Tensor] = {}
        for part in ("student", "teacher", "first_moment", "second_moment"):
            tensors |= {f"{part}/{name}": value for name, value in getattr(self, part).items()}
        facts = {
            "run_key": self.run_key,
            "step": self.step,
            "optimiser_steps": self.optimiser_steps,
            "records": self.records,
        }
        with directory_being_written(folder) as scratch:
            save_artifact(scratch, SCHEMA, facts, tensors)

    @classmethod
    def load(cls, folder: Path, run_key: str) -> Checkpoint | None:
        """The checkpoint of this very run, or None if there is none (damaged ones are reported and ignored)."""
        if not folder.exists():
            return None
        try:
            facts, tensors = load_artifact(folder, SCHEMA)
        except ArtifactError as error:
            _log.warning("ignoring a damaged checkpoint: %s", error.line())
            return None
        if facts["run_key"] != run_key:
            _log.warning("ignoring a checkpoint of another run in %s", folder)
            return None
        parts: dict[str, dict[str, Tensor]] = {p: {} for p in ("student", "teacher", "first_moment", "second_moment")}
        for key, value in tensors.items():
            part, _, name = key.partition("/")
            parts[part][name] = value
        return cls(
            run_key=run_key,
            step=facts["step"],
            optimiser_steps=facts["optimiser_steps"],
            records=facts["records"],
            **parts,
        )


def optimiser_state(
    optimiser: torch.optim.Optimizer, names: dict[Tensor, str]
) -> tuple[dict[str, Tensor], dict[str, Tensor], dict[str, int]]:
    """(first moments, second moments, step counts) by parameter name; parameters never stepped are absent."""
    first: dict[str, Tensor] = {}
    second: dict[str, Tensor] = {}
    steps: dict[str, int] = {}
    for parameter, state in optimiser.state.items():
        name = names[parameter]
        first[name], second[name], steps[name] = state["exp_avg"], state["exp_avg_sq"], int(state["step"])
    return first, second, steps


def restore_optimiser(optimiser: torch.optim.Optimizer, parameters: dict[str, Tensor], saved: Checkpoint) -> None:
    """Put a checkpoint's AdamW state back."""
    for name, steps in saved.optimiser_steps.items():
        parameter = parameters[name]
        optimiser.state[parameter] = {
            "step": torch.tensor(float(steps)),
            "exp_avg": saved.first_moment[name].to(parameter.device).clone(),
            "exp_avg_sq": saved.second_moment[name].to(parameter.device).clone(),
        }
