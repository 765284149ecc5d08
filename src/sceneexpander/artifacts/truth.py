"""What is known of a scene's true cameras and depths."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path

from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.artifacts.store import (
    FACTS_NAME,
    ArtifactError,
    load_artifact,
    load_fields,
    read_typed,
    save_artifact,
)
from sceneexpander.artifacts.views import ViewRecord

SCHEMA = "truth/1"
MEND = "mend or remove the scene's truth/"


@dataclass(frozen=True, slots=True, kw_only=True)
class _TruthFacts:
    views: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewTruth:
    """Truth of one picture, in its original pixels. ``depth`` is 0 where unknown."""

    world_from_cam: Float[Tensor, "4 4"]
    intrinsics_px: Float[Tensor, "3 3"]
    depth: Float[Tensor, "height width"] | None = None
    new_region: Bool[Tensor, "height width"] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneTruth:
    """Truth by the digest of the picture's bytes: a picture that was exchanged has none."""

    views: dict[str, ViewTruth] = field(default_factory=dict)

    def save(self, folder: Path) -> None:
        """Write into a (scratch) folder."""
        tensors = {
            f"{digest}.{f.name}": value
            for digest, view in self.views.items()
            for f in fields(ViewTruth)
            if (value := getattr(view, f.name)) is not None
        }
        save_artifact(folder, SCHEMA, {"views": list(self.views)}, tensors)

    @classmethod
    def load(cls, folder: Path) -> SceneTruth:
        """Read what `save` wrote. Raises `ArtifactError` if it is missing or damaged."""
        facts, tensors = load_artifact(folder, SCHEMA)
        read = read_typed(_TruthFacts, facts, folder / FACTS_NAME)
        views = {
            digest: ViewTruth(**load_fields(ViewTruth, {}, tensors, folder, prefix=f"{digest}."))
            for digest in read.views
        }
        return cls(views=views)

    def of(self, record: ViewRecord) -> ViewTruth | None:
        """Truth of a view, if known."""
        return self.views.get(record.sha256)


def check_size(plane: Tensor, record: ViewRecord) -> None:
    """Raise `ArtifactError` if a map has another size than the picture that it belongs to."""
    rows, columns = plane.shape
    if (rows, columns) != (record.original_height, record.original_width):
        raise ArtifactError(
            f"truth of {rows} x {columns} pixels for a picture of {record.original_height} x {record.original_width}",
            where=record.name,
            fix=MEND,
        )
