"""The state between rounds: the views so far, what geometry knows of them, and the weights that go with them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor

from sceneexpander.artifacts.scene import KnownCameras
from sceneexpander.artifacts.store import (
    FACTS_NAME,
    RERUN,
    ArtifactError,
    load_artifact,
    load_fields,
    read_typed,
    save_artifact,
    sha256_of_tensors,
)
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.geometry.priors import Priors

PRIORS_SCHEMA = "priors/1"
WEIGHTS_SCHEMA = "weights-change/1"
Loaded = TypeVar("Loaded")


def save_priors(folder: Path, priors: Priors) -> None:
    """Write priors into a (scratch) folder."""
    values = {f.name: getattr(priors, f.name) for f in fields(Priors)}
    save_artifact(folder, PRIORS_SCHEMA, {}, {name: value for name, value in values.items() if value is not None})


def load_priors(folder: Path) -> Priors:
    """Read what `save_priors` wrote."""
    facts, tensors = load_artifact(folder, PRIORS_SCHEMA)
    unknown = tensors.keys() - {f.name for f in fields(Priors)}
    if unknown:
        raise ArtifactError(f"holds unknown tensors {sorted(unknown)[:3]}", where=folder, fix=RERUN)
    return Priors(**load_fields(Priors, facts, tensors, folder))


@dataclass(frozen=True, slots=True, kw_only=True)
class WeightsChange:
    """theta - theta_0 against a base that is named by its hash. An empty change is the base itself, bit for bit.

    Tensors that did not change are left out. The adapted weights are *defined* as base + change, so that every reader gets the
    same bits.
    """

    base_sha256: str
    change: dict[str, Tensor]

    @classmethod
    def between(cls, base: dict[str, Tensor], adapted: dict[str, Tensor]) -> WeightsChange:
        """The change from ``base`` to ``adapted`` (the same names and shapes)."""
        if base.keys() != adapted.keys():
            raise ValueError(f"weights differ in names: {sorted(base.keys() ^ adapted.keys())[:5]}")
        change = {
            name: (adapted[name].detach().cpu() - base[name].detach().cpu())
            for name in base
            if not torch.equal(base[name].detach().cpu(), adapted[name].detach().cpu())
        }
        return cls(base_sha256=sha256_of_tensors(base), change=change)

    def applied_to(self, base: dict[str, Tensor]) -> dict[str, Tensor]:
        """The adapted weights. Raises `ArtifactError` if ``base`` is not the base that the change was made against."""
        found = sha256_of_tensors(base)
        if found != self.base_sha256:
            raise ArtifactError(
                f"the change belongs to base weights {self.base_sha256[:12]}, the loaded ones are {found[:12]}",
                where="adapted weights",
                fix="use the model and weights that the change was made with, or rerun the stage",
            )
        unknown = self.change.keys() - base.keys()
        if unknown:
            raise ArtifactError(f"changes unknown tensors {sorted(unknown)[:3]}", where="adapted weights")
        return {
            name: value + self.change[name].to(value.device) if name in self.change else value
            for name, value in base.items()
        }

    def save(self, folder: Path) -> None:
        """Write into a (scratch) folder."""
        save_artifact(folder, WEIGHTS_SCHEMA, {"base_sha256": self.base_sha256}, self.change)

    @classmethod
    def load(cls, folder: Path) -> WeightsChange:
        """Read what `save` wrote."""
        facts, tensors = load_artifact(folder, WEIGHTS_SCHEMA)
        read = read_typed(_ChangeFacts, facts, folder / FACTS_NAME)
        return cls(base_sha256=read.base_sha256, change=tensors)


@dataclass(frozen=True, slots=True, kw_only=True)
class _ChangeFacts:
    base_sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ExpansionState:
    """Where a round starts: round 0 holds the captured views, round k also the views inserted in rounds 1..k.

    Attributes:
        views: every picture as it was given, which is what other methods take and what results are compared with.
        priors: what geometry knows of them.
        weights: adapted in the rounds so far.
        first_weights: those of round 0, which no insertion has touched; None: ``weights`` are those.
        toned: inserted views whose picture was brought to the photos' tone; None: there are none.
        known: cameras of the first views, the captured ones, that were given and not estimated.
    """

    views: ViewSet
    priors: Priors
    weights: WeightsChange
    first_weights: WeightsChange | None = None
    toned: ViewSet | None = None
    known: KnownCameras | None = None

    @property
    def unadapted(self) -> WeightsChange:
        """The weights before any insertion."""
        return self.weights if self.first_weights is None else self.first_weights

    @property
    def toned_views(self) -> ViewSet:
        """The views as the adaptation takes them: inserted pictures in the photos' tone."""
        return self.views if self.toned is None else self.views.with_pictures_of(self.toned)

    def save(self, folder: Path) -> None:
        """Write into a (scratch) folder."""
        self.views.save(folder / "views")
        save_priors(folder / "priors", self.priors)
        self.weights.save(folder / "weights")
        if self.first_weights is not None:
            self.first_weights.save(folder / "first_weights")
        if self.toned is not None:
            self.toned.save(folder / "toned")
        if self.known is not None:
            self.known.save(folder / "known")

    @classmethod
    def load(cls, folder: Path) -> ExpansionState:
        """Read what `save` wrote."""
        return cls(
            views=ViewSet.load(folder / "views"),
            priors=load_priors(folder / "priors"),
            weights=WeightsChange.load(folder / "weights"),
            first_weights=_if_there(folder / "first_weights", WeightsChange.load),
            toned=_if_there(folder / "toned", ViewSet.load),
            known=_if_there(folder / "known", KnownCameras.load),
        )


def _if_there(folder: Path, load: Callable[[Path], Loaded]) -> Loaded | None:
    return load(folder) if folder.exists() else None
