"""One training sample: pictures, exact truth, and what the dense base really made of them. Stored compactly."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from sceneexpander.errors import UserError
from sceneexpander.files import complete_file
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.priors import EVIDENCE_CHANNELS, Priors
from sceneexpander.geometry.rigid import rigid_inverse

_SCHEMA = "mini-sample-1"
_HIDDEN_BEHIND = 0.05  # log depth behind another view's surface at which a point counts as hidden


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """N input views with priors, then optional held-out views that only rendering losses see.

    True cameras and prior cameras share the world frame (the first view's camera) up to the errors put into the priors.
    ``log_depth`` is in the scale of the priors: where a wrong focal length stretched the prior geometry, truth is stretched
    by the same factor, because no method can know better.
    """

    images: Float[Tensor, "all 3 height width"]  # RGB in [0, 1]; inputs first, then held-out views
    log_depth: Float[Tensor, "all height width"]  # +inf where there is no surface
    normals: Float[Tensor, "all height width 3"]  # 0 where there is no surface
    world_from_cam: Float[Tensor, "all 4 4"]
    intrinsics_px: Float[Tensor, "all 3 3"]
    prior_world_from_cam: Float[Tensor, "view 4 4"]
    prior_intrinsics_px: Float[Tensor, "view 3 3"]
    prior_log_depth: Float[Tensor, "view height width"]
    sparse_log_depth: Float[Tensor, "view height width"]  # interpolation of the sparse points, the trivial baseline
    evidence: Float[Tensor, "view channel height width"]
    posed: Bool[Tensor, "view"]
    wrong_focal: bool  # or estimated cameras: the prior's frame and the true one differ by more than pose noise
    kind: str
    seed: int

    @property
    def inputs(self) -> int:
        """Number of input views."""
        return len(self.prior_log_depth)

    @property
    def input_images(self) -> Float[Tensor, "view 3 height width"]:
        """Pictures of the input views."""
        return self.images[: self.inputs]

    @property
    def valid(self) -> Bool[Tensor, "all height width"]:
        """Where there is a surface."""
        return self.log_depth.isfinite()

    def priors_confident(self) -> Bool[Tensor, "view height width"]:
        """Pixels that the base is confident of."""
        return self.evidence[:, EVIDENCE_CHANNELS.index("confident")] > 0.5

    def priors(self) -> Priors:
        """What the geometric front-end says about the input views."""
        return Priors(
            world_from_cam=self.prior_world_from_cam,
            intrinsics_px=self.prior_intrinsics_px,
            depth=self.prior_log_depth.exp(),
            evidence=self.evidence,
            posed=self.posed,
        )

    def with_first_view(self, view: int) -> Sample:
        """The same sample in the frame of an input view, which becomes the first; the others keep their order."""
        order = [view, *(other for other in range(self.inputs) if other != view)]
        return self.select_inputs(order)

    def select_inputs(self, views: list[int]) -> Sample:
        """Some of the input views, in the given order, and all held-out views; the first one defines the world."""
        inputs = torch.tensor(views)
        everything = torch.cat([inputs, torch.arange(self.inputs, len(self.images))])
        truth = self.world_from_cam[everything]
        prior = self.prior_world_from_cam[inputs]
        return replace(
            self,
            **{name: getattr(self, name)[everything] for name in ("images", "log_depth", "normals", "intrinsics_px")},
            **{
                name: getattr(self, name)[inputs]
                for name in ("prior_intrinsics_px", "prior_log_depth", "sparse_log_depth", "evidence", "posed")
            },
            world_from_cam=rigid_inverse(truth[:1]) @ truth,
            prior_world_from_cam=rigid_inverse(prior[:1]) @ prior,
        )

    def visible_from(self, view: int, others: Sequence[int]) -> Bool[Tensor, "height width"]:
        """Pixels of a view whose true surface at least one of the other views sees, by true cameras and depth."""
        height, width = self.log_depth.shape[-2:]
        valid = self.valid[view]
        depth = torch.where(valid, self.log_depth[view], 0.0).exp()
        cameras = Cameras(self.world_from_cam, self.intrinsics_px, height, width)
        points = cameras[view].unproject(depth[None])
        chosen = torch.tensor(list(others))
        surface = torch.where(self.valid[chosen], self.log_depth[chosen], 20.0)[:, None]
        seen, found = cameras[chosen].look_up(points.reshape(-1, 3), surface)
        visible = found.in_frame & (found.depth.log() < seen[:, 0] + _HIDDEN_BEHIND)
        return visible.any(0).view(height, width) & valid

    def halved(self) -> Sample:
        """The sample at half the resolution (all sizes used here are multiples of 28)."""

        def pooled(maps: Tensor) -> Tensor:
            return avg_pool2d(maps, 2)

        normals = pooled(self.normals.movedim(-1, 1)).movedim(1, -1)
        half = self.intrinsics_px.new_tensor([0.5, 0.5, 1.0])[:, None]
        return replace(
            self,
            images=pooled(self.images),
            log_depth=pooled(self.log_depth[:, None])[:, 0],
            normals=normalize(normals, dim=-1),
            intrinsics_px=self.intrinsics_px * half,
            prior_intrinsics_px=self.prior_intrinsics_px * half,
            prior_log_depth=pooled(self.prior_log_depth[:, None])[:, 0],
            sparse_log_depth=pooled(self.sparse_log_depth[:, None])[:, 0],
            evidence=pooled(self.evidence),
        )

    def save(self, path: Path) -> None:
        """Write atomically; about 25 bytes per pixel."""
        tensors = {f.name: getattr(self, f.name) for f in fields(self) if isinstance(getattr(self, f.name), Tensor)}
        tensors["images"] = (tensors["images"] * 255).round().to(torch.uint8)
        tensors["normals"] = (tensors["normals"] * 127).round().to(torch.int8)
        for name in ("log_depth", "prior_log_depth", "sparse_log_depth", "evidence"):
            tensors[name] = tensors[name].half()
        facts = {"schema": _SCHEMA, "wrong_focal": self.wrong_focal, "kind": self.kind, "seed": self.seed}
        contiguous = {name: value.contiguous() for name, value in tensors.items()}
        with complete_file(path) as scratch:
            save_file(contiguous, scratch, metadata={"sample": json.dumps(facts)})

    @classmethod
    def load(cls, path: Path) -> Sample:
        """Read what `save` wrote.

        Raises:
            UserError: the file is not a sample of this version.
        """
        try:
            with safe_open(path, framework="pt") as file:
                facts = json.loads((file.metadata() or {}).get("sample", "{}"))
                if facts.pop("schema", None) != _SCHEMA:
                    raise UserError(f"is not a {_SCHEMA} file", where=str(path), fix="delete it; it is made again")
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict
        except (OSError, SafetensorError) as error:
            raise UserError(
                f"cannot be read as a sample: {error}", where=str(path), fix="delete it; it is made again"
            ) from error
        tensors["images"] = tensors["images"].float() / 255
        normals = tensors["normals"].float() / 127
        tensors["normals"] = normals / normals.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        for name in ("log_depth", "prior_log_depth", "sparse_log_depth", "evidence"):
            tensors[name] = tensors[name].float()
        return cls(**tensors, **facts)
