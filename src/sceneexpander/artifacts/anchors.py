"""What the frozen model says about the captured views: the targets of anchor distillation."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.store import load_artifact, load_fields, refusing, save_artifact

SCHEMA = "anchors/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class Anchors:
    """Eq. (anchor_ref): predictions of the frozen model for all n captured views together, without augmentation.

    World frame and scale are those of that one prediction, whose first view defines the frame.
    """

    weights_sha256: str
    view_ids: tuple[str, ...]
    camera_vector: Float[Tensor, "view 9"]
    depth: Float[Tensor, "view height width"]
    depth_conf: Float[Tensor, "view height width"]
    normals: Float[Tensor, "view height width 3"]
    normals_conf: Float[Tensor, "view height width"]

    def __post_init__(self) -> None:
        for name in _TENSORS:
            value = getattr(self, name)
            if value.shape[0] != len(self.view_ids):
                raise ValueError(f"Anchors.{name} has {value.shape[0]} views, expected {len(self.view_ids)}")
            if not torch.isfinite(value).all():
                raise ValueError(f"Anchors.{name} holds non-finite values")

    def save(self, folder: Path) -> None:
        """Write into a (scratch) folder."""
        facts = {"weights_sha256": self.weights_sha256, "view_ids": self.view_ids}
        save_artifact(folder, SCHEMA, facts, {name: getattr(self, name) for name in _TENSORS})

    @classmethod
    def load(cls, folder: Path) -> Anchors:
        """Read what `save` wrote. Raises `ArtifactError` if it is missing or damaged."""
        facts, tensors = load_artifact(folder, SCHEMA)
        with refusing(folder):
            return cls(**load_fields(cls, facts, tensors, folder))


_TENSORS = tuple(f.name for f in fields(Anchors) if f.name not in {"weights_sha256", "view_ids"})
