"""What a tracked run holds, independent of where it is kept."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRecord:
    """One scene, round and method under one configuration.

    Attributes:
        key: identity; a run that is already recorded under it is not recorded again.
        name: as shown in lists.
        params: resolved configuration, dotted keys.
        metrics: final numbers.
        curves: (step, value), in ascending order.
        artefacts: files by their path in the run; pictures are shown by the interface as such.
        pictures: by a name for people, (step, file): MLflow shows those of several runs side by side, with a slider for the step.
        tags: facts to filter by.
        started_ms: epoch milliseconds of the work itself (not of the recording), so that repeating the recording gives the same run.
        duration_ms: of the work.
    """

    key: str
    name: str
    params: Mapping[str, str]
    metrics: Mapping[str, float]
    curves: Mapping[str, Sequence[tuple[int, float]]] = field(default_factory=dict)
    artefacts: Mapping[str, Path] = field(default_factory=dict)
    pictures: Mapping[str, Sequence[tuple[int, Path]]] = field(default_factory=dict)
    tags: Mapping[str, str] = field(default_factory=dict)
    started_ms: int = 0
    duration_ms: int = 0


def run_key(*parts: object) -> str:
    """Hash of JSON-ready values that together identify a run."""
    text = json.dumps(parts, sort_keys=True, ensure_ascii=False, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()
