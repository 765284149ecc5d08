"""The prepared scene: captured views and what is to be added, round by round."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
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
from sceneexpander.geometry.similarity import Similarity, align_poses

SCHEMA = "scene/1"
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


Matrix4 = tuple[tuple[float, float, float, float], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownCameras:
    """Cameras and depth that came with the photos (all views). Any subset of the views may have them.

    Attributes:
        world_from_cam: in the frame of the first view that has one, in the capture's unit; rows of others are NaN.
        intrinsics_px: of the stored images; rows that are not known are NaN.
        depth: z-depth of the stored images in the capture's unit; 0 where there is none.
        metric: whether that unit is known to be the metre.
        capture_from_world: the rigid motion (4 rows, double precision) from the frame of ``world_from_cam`` to the capture's own world.
    """

    world_from_cam: Float[Tensor, "view 4 4"] | None = None
    intrinsics_px: Float[Tensor, "view 3 3"] | None = None
    depth: Float[Tensor, "view height width"] | None = None
    metric: bool = False
    capture_from_world: Matrix4 | None = None

    def similarity_from(self, world_from_cam: Float[Tensor, "view 4 4"]) -> Similarity | None:
        """The map (double precision) from the frame of a reconstruction to the capture's own world.

        It is found from the cameras that both have, so it holds whatever the reconstruction did with frame and scale; exact where given
        poses were kept.

        Args:
            world_from_cam: estimated poses of all views, the first ones those of this object.

        Returns:
            None if fewer than two views at different places have a known pose: then the capture's scale is not known.
        """
        given = self.world_from_cam
        if given is None or self.capture_from_world is None:
            return None
        posed = torch.isfinite(given).all(-1).all(-1)
        if int(posed.sum()) < 2:
            return None
        own = torch.tensor(self.capture_from_world, dtype=torch.float64)
        try:
            return align_poses(world_from_cam[: len(given)][posed].double(), own @ given[posed].double())
        except ValueError:
            return None

    def tensors(self) -> dict[str, Tensor]:
        """What is given, by name."""
        values = {name: getattr(self, name) for name in ("world_from_cam", "intrinsics_px", "depth")}
        return {name: value for name, value in values.items() if value is not None}

    def facts(self) -> dict[str, object]:
        """What is not a tensor."""
        return {"metric": self.metric, "capture_from_world": self.capture_from_world}

    def save(self, folder: Path) -> None:
        """Write into a (scratch) folder."""
        save_artifact(folder, KNOWN_SCHEMA, self.facts(), self.tensors())

    @classmethod
    def load(cls, folder: Path) -> KnownCameras:
        """Read what `save` wrote. Raises `ArtifactError` if it is missing or damaged."""
        facts, tensors = load_artifact(folder, KNOWN_SCHEMA)
        read = read_typed(_KnownFacts, facts, folder / FACTS_NAME)
        given = {"metric": read.metric, "capture_from_world": read.capture_from_world}
        return cls(**load_fields(cls, given, tensors, folder))


@dataclass(frozen=True, slots=True, kw_only=True)
class _KnownFacts:
    metric: bool
    capture_from_world: Matrix4 | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Made by ``prepare``; read by every later stage. ``notes`` say what was noticed about the user's files."""

    name: str
    views: ViewSet
    rounds: tuple[RoundSpec, ...]
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
        """Write into a (scratch) folder."""
        self.views.save(folder / "views")
        tensors: dict[str, Tensor] = {}
        if self.known is not None:
            tensors = {f"known.{name}": value for name, value in self.known.tensors().items()}
        known = KnownCameras() if self.known is None else self.known
        facts = {"name": self.name, "rounds": self.rounds, "notes": self.notes, **known.facts()}
        save_artifact(folder, SCHEMA, facts, tensors)

    @classmethod
    def load(cls, folder: Path) -> Scene:
        """Read what `save` wrote. Raises `ArtifactError` if it is missing or damaged."""
        facts, tensors = load_artifact(folder, SCHEMA)
        read = read_typed(_Facts, facts, folder / FACTS_NAME)
        known = None
        if tensors:
            given = {"metric": read.metric, "capture_from_world": read.capture_from_world}
            known = KnownCameras(**load_fields(KnownCameras, given, tensors, folder, prefix="known."))
        return cls(
            name=read.name, views=ViewSet.load(folder / "views"), rounds=read.rounds, known=known, notes=read.notes
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Facts:
    """What is not a tensor or an artefact of its own."""

    name: str
    rounds: tuple[RoundSpec, ...]
    metric: bool
    notes: tuple[str, ...]
    capture_from_world: Matrix4 | None = None
