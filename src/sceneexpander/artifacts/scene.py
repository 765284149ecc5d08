"""The prepared scene: captured views and what is to be added, round by round."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.store import (
    FACTS_NAME,
    ArtifactError,
    load_artifact,
    load_fields,
    read_typed,
    save_artifact,
)
from sceneexpander.artifacts.views import ViewSet

SCHEMA = "scene/2"
ROUND_SCHEMA = "asked-round/1"
KNOWN_SCHEMA = "known-cameras/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundSpec:
    """One sentence of the user. ``motion`` and ``new_object`` are the two fields of the paper's prompt template.

    ``inserted`` is the path, relative to the scene folder, of a recorded or user-given picture, if there is one.
    """

    prompt: str
    motion: str = ""
    new_object: str = ""
    inserted: str | None = None
    inserted_sha256: str | None = None

    def save(self, folder: Path) -> None:
        """Write into a (scratch) folder."""
        save_artifact(folder, ROUND_SCHEMA, {f.name: getattr(self, f.name) for f in fields(self)}, {})

    @classmethod
    def load(cls, folder: Path) -> RoundSpec:
        """Read what `save` wrote. Raises `ArtifactError` if it is missing or damaged."""
        facts, _ = load_artifact(folder, ROUND_SCHEMA)
        return read_typed(cls, facts, folder / FACTS_NAME)


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownCameras:
    """Cameras that came with the photos (all views), in the first view's frame, intrinsics of the stored images."""

    world_from_cam: Float[Tensor, "view 4 4"] | None = None
    intrinsics_px: Float[Tensor, "view 3 3"] | None = None
    metric: bool = False  # True only if translations are known to be metres

    def save(self, folder: Path) -> None:
        """Write into a (scratch) folder."""
        tensors = {name: getattr(self, name) for name in ("world_from_cam", "intrinsics_px")}
        given = {name: value for name, value in tensors.items() if value is not None}
        save_artifact(folder, KNOWN_SCHEMA, {"metric": self.metric}, given)

    @classmethod
    def load(cls, folder: Path) -> KnownCameras:
        """Read what `save` wrote. Raises `ArtifactError` if it is missing or damaged."""
        facts, tensors = load_artifact(folder, KNOWN_SCHEMA)
        read = read_typed(_KnownFacts, facts, folder / FACTS_NAME)
        return cls(**load_fields(cls, {"metric": read.metric}, tensors, folder))


@dataclass(frozen=True, slots=True, kw_only=True)
class _KnownFacts:
    metric: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Made by ``prepare``; read by every later stage. ``notes`` say what was noticed about the user's files.

    Saved without its ``rounds``: each of them is an artefact of its own, so that one more leaves everything else as it is.
    """

    name: str
    views: ViewSet
    rounds: tuple[RoundSpec, ...] = ()
    known: KnownCameras | None = None
    notes: tuple[str, ...] = ()

    def round_spec(self, number: int) -> RoundSpec:
        """The sentence of round ``number`` (from 1). Raises `ArtifactError` if the scene does not define it."""
        if not 1 <= number <= len(self.rounds):
            raise ArtifactError(
                f"round {number} was asked for, the scene defines {len(self.rounds)}",
                where=f"scene {self.name!r}",
                fix="add a prompt for it to the scene's scene.yaml, or take the round out of params.yaml",
            )
        return self.rounds[number - 1]

    def save(self, folder: Path) -> None:
        """Write all but the rounds into a (scratch) folder."""
        self.views.save(folder / "views")
        tensors: dict[str, Tensor] = {}
        if self.known is not None:
            for key in ("world_from_cam", "intrinsics_px"):
                value = getattr(self.known, key)
                if value is not None:
                    tensors[f"known.{key}"] = value
        metric = self.known is not None and self.known.metric
        facts = {"name": self.name, "metric": metric, "notes": self.notes}
        save_artifact(folder, SCHEMA, facts, tensors)

    @classmethod
    def load(cls, folder: Path) -> Scene:
        """Read what `save` wrote: a scene without rounds. Raises `ArtifactError` if it is missing or damaged."""
        facts, tensors = load_artifact(folder, SCHEMA)
        read = read_typed(_Facts, facts, folder / FACTS_NAME)
        known = None
        if tensors:
            known = KnownCameras(**load_fields(KnownCameras, {"metric": read.metric}, tensors, folder, prefix="known."))
        return cls(name=read.name, views=ViewSet.load(folder / "views"), known=known, notes=read.notes)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Facts:
    """What is not a tensor or an artefact of its own."""

    name: str
    metric: bool
    notes: tuple[str, ...]
