"""The whole of OmniVGGT: a batched core and the reconstructor that everything else here talks to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sceneexpander.geometry.priors import Priors
from sceneexpander.models.derived import with_depth
from sceneexpander.models.layers.camera_head import FOV_START, CameraHeadNames
from sceneexpander.models.layers.dpt import DptHead
from sceneexpander.models.layers.family import BackboneModel
from sceneexpander.models.layers.init import initialise_backbone
from sceneexpander.models.layers.outputs import (
    Cameras,
    Map,
    VectorMap,
    cameras_from_vector,
    check_views,
    depth_and_conf,
    points_and_conf,
)
from sceneexpander.models.omnivggt.config import OmniVGGTConfig
from sceneexpander.models.omnivggt.priors import BatchPriors, batch_priors, encode_priors
from sceneexpander.models.omnivggt.transformer import Aggregator
from sceneexpander.models.protocol import ALL_HEADS, Head, Prediction

CAMERA_NAMES = CameraHeadNames(
    init_token="empty_pose_tokens",  # noqa: S106 - a parameter name
    embed="embed_pose",
    modulation="poseLN_modulation",
    blocks="trunk",
    out_norm="trunk_norm",
    predictor="pose_branch",
)
FOV_LIMITS_RAD = (0.05, 3.0)  # of `OmniVGGT.predict`: the head can answer 0, an infinite focal length
FROM_DEPTH = frozenset({Head.DEPTH, Head.NORMALS, Head.GAUSSIANS})


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchPrediction:
    """Outputs for B scenes of S views; fields of heads that were not asked for are None."""

    cameras: Cameras
    iterates: list[Float[Tensor, "batch view 9"]]  # camera vectors after every refinement step
    depth: Map | None = None
    depth_conf: Map | None = None
    points: VectorMap | None = None
    points_conf: Map | None = None


class OmniVGGT(BackboneModel):
    """The feed-forward reconstructor of omnivggt spec 2; parameter names are those of the public checkpoint.

    It has heads for cameras, depth and points. `predict` derives the rest: normals from the depth map, with its confidence
    (they can be no surer than what they are made of), and Gaussians by the rule of `sceneexpander.models.pixel_aligned`.
    """

    name = "omnivggt"
    config: OmniVGGTConfig

    def __init__(self, config: OmniVGGTConfig, *, checkpoint_activations: bool = False) -> None:
        super().__init__(config, checkpoint_activations=checkpoint_activations)
        width = 2 * config.dim
        self.aggregator = Aggregator(config)
        self.camera_head = self._new_camera_head(CAMERA_NAMES)
        self.point_head = DptHead(width, 4, config.dpt)
        self.depth_head = DptHead(width, 2, config.dpt)

    def initialise(self, generator: torch.Generator) -> None:
        """Draw every parameter anew, as WorldMirror does; cameras start without any effect."""
        trunk = self.aggregator
        tokens = (trunk.camera_token, trunk.register_token, trunk.depth_placeholder)
        initialise_backbone(self, trunk.patch_embed, self.camera_head, tokens, generator=generator)
        for parameter in trunk.camera_adapters.parameters():
            nn.init.zeros_(parameter)

    def predict(
        self,
        images: Float[Tensor, "view 3 height width"],
        priors: Priors | None = None,
        *,
        heads: frozenset[Head] = ALL_HEADS,
        generated: Bool[Tensor, "view"] | None = None,
    ) -> Prediction:
        """See `Reconstructor.predict`. The camera head always runs; `Priors.evidence` is not read.

        Poses without intrinsics are completed with the fields of view that a first pass without priors predicts, because the
        network takes cameras whole; for the rest see `batch_priors`. Predicted fields of view are kept within
        [0.05, 3] rad, as everything downstream needs a finite focal length.
        """
        check_views(images)
        if priors is not None and priors.world_from_cam is not None and priors.intrinsics_px is None:
            first = self._whole_cameras(self(images[None], heads=frozenset()).cameras, images)
            priors = replace(priors, intrinsics_px=first.intrinsics_px[0].detach())
        batch = self(images[None], batch_priors(priors, images), heads=heads)
        cameras = self._whole_cameras(batch.cameras, images)
        poses, intrinsics = cameras.world_from_cam[0], cameras.intrinsics_px[0]
        prediction = Prediction(camera_vector=cameras.vector[0], world_from_cam=poses, intrinsics_px=intrinsics)
        if batch.points is not None and batch.points_conf is not None:
            prediction = replace(prediction, points=batch.points[0], points_conf=batch.points_conf[0])
        if batch.depth is None or batch.depth_conf is None:
            return prediction
        depth, conf = batch.depth[0], batch.depth_conf[0]
        return with_depth(prediction, depth, conf, images=images, heads=heads, generated=generated)

    def forward(
        self,
        images: Float[Tensor, "batch view 3 height width"],
        priors: BatchPriors | None = None,
        *,
        heads: frozenset[Head] = ALL_HEADS,
    ) -> BatchPrediction:
        """Reconstruct B scenes of S views each (omnivggt spec 2). Normals and Gaussians need the depth head, nothing more.

        Args:
            images: RGB in [0, 1]; sides must be multiples of ``size_multiple``.
            priors: what is known about the views.
            heads: outputs that somebody needs; no other dense head runs.

        Raises:
            ValueError: for a size that is not a multiple of the patch side.
        """
        encoded = encode_priors(priors, images.shape[-2], images.shape[-1])
        features = self.aggregator(images, encoded, checkpoint=self.checkpoint_activations)
        iterates = self.camera_head(features.camera_tokens, checkpoint=self.checkpoint_activations)
        depth = depth_conf = points = points_conf = None
        if heads & FROM_DEPTH:
            depth, depth_conf = depth_and_conf(self._dense(self.depth_head, features))
        if Head.POINTS in heads:
            points, points_conf = points_and_conf(self._dense(self.point_head, features))
        return BatchPrediction(
            cameras=cameras_from_vector(iterates[-1], features.size),
            iterates=iterates,
            depth=depth,
            depth_conf=depth_conf,
            points=points,
            points_conf=points_conf,
        )

    @staticmethod
    def _whole_cameras(cameras: Cameras, images: Float[Tensor, "view 3 height width"]) -> Cameras:
        """The same cameras with fields of view that have a finite focal length."""
        vector = cameras.vector
        vector = torch.cat([vector[..., :FOV_START], vector[..., FOV_START:].clamp(*FOV_LIMITS_RAD)], dim=-1)
        return cameras_from_vector(vector, (images.shape[-2], images.shape[-1]))
