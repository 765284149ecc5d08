"""A reconstruction on disk: cameras, depth, normals and Gaussians of a set of views, all in one gauge."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.artifacts.store import load_artifact, load_fields, refusing, save_artifact
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import ROWS, GaussianCounts, Gaussians

SCHEMA = "reconstruction/1"
_VIEW_TENSORS = ("camera_vector", "world_from_cam", "intrinsics_px", "depth", "depth_conf", "normals", "normals_conf")


@dataclass(frozen=True, slots=True, kw_only=True)
class Reconstruction:
    """S views of H x W pixels. World frame: approximately the first view's camera (OpenCV axes), scene units.

    ``posed`` tells which cameras were really estimated (False: a placeholder was used), ``counts`` what became of the Gaussians that
    the model made (None: not recorded).
    """

    method: str
    model: str
    weights_sha256: str
    view_ids: tuple[str, ...]
    generated: Bool[Tensor, "view"]
    posed: Bool[Tensor, "view"]
    camera_vector: Float[Tensor, "view 9"]
    world_from_cam: Float[Tensor, "view 4 4"]
    intrinsics_px: Float[Tensor, "view 3 3"]
    depth: Float[Tensor, "view height width"]
    depth_conf: Float[Tensor, "view height width"]
    normals: Float[Tensor, "view height width 3"]
    normals_conf: Float[Tensor, "view height width"]
    gaussians: Gaussians
    counts: GaussianCounts | None = None

    def __post_init__(self) -> None:
        for name in _VIEW_TENSORS:
            value = getattr(self, name)
            if value.shape[0] != len(self.view_ids):
                raise ValueError(f"Reconstruction.{name} has {value.shape[0]} views, expected {len(self.view_ids)}")
            if not torch.isfinite(value).all():
                view = int((~torch.isfinite(value.flatten(1)).all(1)).nonzero()[0])
                raise ValueError(f"Reconstruction.{name} is not finite in view {view} ({self.view_ids[view]})")
        if not bool((self.depth > 0).all()):
            raise ValueError("Reconstruction.depth must be positive everywhere")

    @property
    def cameras(self) -> Cameras:
        """Of all views."""
        height, width = (int(side) for side in self.depth.shape[1:])
        return Cameras(self.world_from_cam, self.intrinsics_px, height, width)

    def save(self, folder: Path) -> None:
        """Write into a (scratch) folder."""
        tensors = {name: getattr(self, name) for name in (*_VIEW_TENSORS, "generated", "posed")}
        tensors |= {f"gaussians.{name}": getattr(self.gaussians, name) for name in ROWS}
        facts = {name: getattr(self, name) for name in ("method", "model", "weights_sha256", "view_ids")}
        facts["antialiased"] = self.gaussians.antialiased
        facts["counts"] = None if self.counts is None else asdict(self.counts)
        save_artifact(folder, SCHEMA, facts, tensors)

    @classmethod
    def load(cls, folder: Path) -> Reconstruction:
        """Read what `save` wrote. Raises `ArtifactError` for a damaged or invalid artefact."""
        facts, tensors = load_artifact(folder, SCHEMA)
        with refusing(folder):
            meant = {"antialiased": facts.pop("antialiased")} if "antialiased" in facts else {}
            gaussians = Gaussians(**load_fields(Gaussians, meant, tensors, folder, prefix="gaussians."))
            facts_and_views = load_fields(cls, facts, tensors, folder, given=("gaussians",))
            return cls(**facts_and_views, gaussians=gaussians)
