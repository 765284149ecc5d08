"""Numbers about one reconstruction: one row per scene, round, method and seed. What they are called and mean: `sceneexpander.catalogue`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import StrEnum
from pathlib import Path

from sceneexpander.artifacts.store import ArtifactError, read_json, read_typed, write_json_atomic

SCHEMA = "metrics/2"
UNAVAILABLE_SCHEMA = "metrics-unavailable/1"


class Fit(StrEnum):
    """What was done to a reconstruction's Gaussians after they were predicted: only rows with the same can be compared.

    ``FITTED``: fitted for seconds to the pictures that they were made from (`sceneexpander.photometric.refine`). ``OPTIMISED``: the
    same for minutes and with densification (`sceneexpander.optimisation.optimise`).
    """

    PREDICTED = "as predicted"
    FITTED = "fitted"
    OPTIMISED = "optimised"

    @property
    def mark(self) -> str:
        """What stands behind a method's name; methods that optimise say so by their names."""
        return " + fit" if self is Fit.FITTED else ""


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewMetrics:
    """What was measured of one view, by the names of the catalogue. What is not defined there is left out."""

    view_id: str
    generated: bool
    posed: bool
    values: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_finite(self.values, self.view_id)


@dataclass(frozen=True, slots=True, kw_only=True)
class MetricsRow:
    """One method's result on one scene: ``values`` by the names of the catalogue. What is not known or not applicable is left out.

    Of a method that was run several times with other seeds, the numbers are means over the ``repeats`` and ``spread`` holds their standard
    deviations (n - 1) by name; ``views`` are those of the first run.

    Numbers of captured views are means over those with a pose, numbers of the inserted view are of the one inserted in this round.
    A view without a pose stands at a placeholder and shows little but its own Gaussians: it is in ``views`` and in no mean. Where no
    captured view has a pose (``views_captured_posed`` is 0), the means are over all of them. Unless ``fit`` says as predicted, the
    numbers at the method's own cameras are those of pictures that its Gaussians were fitted to.
    """

    scene: str
    round: int
    method: str
    model: str
    weights_sha256: str
    seed: int
    values: Mapping[str, float]
    fit: Fit = Fit.PREDICTED
    repeats: int = 1
    spread: Mapping[str, float] = field(default_factory=dict)
    views: tuple[ViewMetrics, ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_finite(self.values, self.method)
        _check_finite(self.spread, f"{self.method}'s spread")

    def value(self, name: str) -> float | None:
        """A number by name; None if it is not known."""
        return float(self.repeats) if name == "repeats" else self.values.get(name)

    def numbers(self) -> dict[str, float]:
        """All known numbers by name; how far repeated runs lie apart as ``spread_...``."""
        spread = {f"spread_{name}": value for name, value in self.spread.items()}
        return {**self.values, "repeats": float(self.repeats), **spread}

    def save(self, path: Path) -> None:
        """Write as a JSON file, atomically."""
        plain = {f.name: getattr(self, f.name) for f in fields(self)}
        write_json_atomic(path, {**plain, "schema": SCHEMA})

    @classmethod
    def load(cls, path: Path) -> MetricsRow:
        """Read what `save` wrote. Raises `ArtifactError` for another schema or a damaged file."""
        content = read_json(path)
        if not isinstance(content, dict) or content.pop("schema", None) != SCHEMA:
            raise ArtifactError(f"is not of schema {SCHEMA!r}", where=path, fix="rerun the evaluation")
        return read_typed(cls, content, path, fix="rerun the evaluation")


def _check_finite(values: Mapping[str, float], what: str) -> None:
    for name, value in values.items():
        if not math.isfinite(value):
            raise ValueError(f"{name} of {what} is {value}; leave out what is not known")


@dataclass(frozen=True, slots=True, kw_only=True)
class UnavailableRow:
    """The row of a method that could not be run: tables show ``reason`` where the numbers would be."""

    scene: str
    round: int
    method: str
    model: str
    seed: int
    reason: str

    def save(self, path: Path) -> None:
        """Write as a JSON file, atomically."""
        write_json_atomic(path, {**{f.name: getattr(self, f.name) for f in fields(self)}, "schema": UNAVAILABLE_SCHEMA})


Row = MetricsRow | UnavailableRow


def load_row(path: Path) -> Row:
    """Either kind of row. Raises `ArtifactError` for another schema or a damaged file."""
    content = read_json(path)
    if not isinstance(content, dict) or content.pop("schema", None) != UNAVAILABLE_SCHEMA:
        return MetricsRow.load(path)
    return read_typed(UnavailableRow, content, path, fix="rerun the evaluation")
