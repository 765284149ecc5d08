"""What a method's scene shows of photos that nothing was made from. Apart from the photos themselves: this needs no torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sceneexpander.artifacts.store import ArtifactError, check_inside, load_artifact, load_fields, save_artifact

SCHEMA = "held-out-seen/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOutSeen:
    """What a method's scene shows at the cameras that were found in it for held-out photos.

    Attributes:
        pictures: file in the artefact's folder by view id, at the stored size; photos without a camera have none.
    """

    pictures: dict[str, str]

    def save(self, folder: Path) -> None:
        """Write the facts beside the pictures."""
        save_artifact(folder, SCHEMA, {"pictures": self.pictures}, {})

    @classmethod
    def load(cls, folder: Path) -> HeldOutSeen:
        """Read what `save` wrote. Raises `ArtifactError` if it or one of its pictures is missing or damaged."""
        facts, tensors = load_artifact(folder, SCHEMA)
        seen = cls(**load_fields(cls, facts, tensors, folder))
        for name in seen.pictures.values():
            check_inside(name, folder)
            if not (folder / name).is_file():
                raise ArtifactError("is missing", where=folder / name, fix="rerun the evaluation")
        return seen
