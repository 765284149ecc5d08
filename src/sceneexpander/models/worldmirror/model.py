"""The whole of WorldMirror: a batched core and the reconstructor that everything else here talks to."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.geometry.gaussians import GaussianCounts, Gaussians
from sceneexpander.geometry.priors import Priors
from sceneexpander.models.layers.activations import confidence, unit_vector
from sceneexpander.models.layers.backbone import TrunkFeatures
from sceneexpander.models.layers.dpt import DptHead
from sceneexpander.models.layers.family import BackboneModel
from sceneexpander.models.layers.outputs import (
    Cameras,
    Map,
    VectorMap,
    cameras_from_vector,
    channels_last,
    check_views,
    depth_and_conf,
    points_and_conf,
)
from sceneexpander.models.protocol import ALL_HEADS, Head, Prediction
from sceneexpander.models.worldmirror.config import WorldMirrorConfig
from sceneexpander.models.worldmirror.gaussians import (
    GaussianDptHead,
    GaussianParameters,
    PixelGaussians,
    activate_gaussians,
    most_confident,
    unproject_integer_pixels,
)
from sceneexpander.models.worldmirror.init import initialise
from sceneexpander.models.worldmirror.merge import leave_unmerged, merge_voxels
from sceneexpander.models.worldmirror.priors import BatchPriors, NormalisedPriors, normalise_priors
from sceneexpander.models.worldmirror.transformer import VisualGeometryTransformer


@dataclass(frozen=True, slots=True, kw_only=True)
class GaussianOutput:
    """What the Gaussian head gives: its own depth, one Gaussian per pixel, and one merged set per scene."""

    depth: Map
    conf: Map
    pixels: PixelGaussians
    merged: list[Gaussians]
    counts: list[GaussianCounts]


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchPrediction:
    """Outputs for B scenes of S views; fields of heads that were not asked for (or do not exist) are None."""

    cameras: Cameras
    depth: Map | None = None
    depth_conf: Map | None = None
    points: VectorMap | None = None
    points_conf: Map | None = None
    normals: VectorMap | None = None
    normals_conf: Map | None = None
    gaussians: GaussianOutput | None = None


class WorldMirror(BackboneModel):
    """The feed-forward reconstructor of worldmirror spec 1; parameter names are those of the public checkpoint."""

    name = "worldmirror"
    trunk_prefixes = ("visual_geometry_transformer.",)
    config: WorldMirrorConfig

    def __init__(self, config: WorldMirrorConfig, *, checkpoint_activations: bool = False) -> None:
        super().__init__(config, checkpoint_activations=checkpoint_activations)
        width = 2 * config.dim
        self.visual_geometry_transformer = VisualGeometryTransformer(config)
        self.cam_head = self._new_camera_head()
        if Head.POINTS in config.heads:
            self.pts_head = DptHead(width, 4, config.dpt)
        if Head.DEPTH in config.heads:
            self.depth_head = DptHead(width, 2, config.dpt)
        if Head.NORMALS in config.heads:
            self.norm_head = DptHead(width, 4, config.dpt)
        if Head.GAUSSIANS in config.heads:
            self.gs_head = GaussianDptHead(width, config.gaussian_dpt)
            self.gs_renderer = GaussianParameters(config.gaussian_dpt.features // 2, config.gaussian.hidden)

    def initialise(self, generator: torch.Generator) -> None:
        """Draw every parameter anew (worldmirror spec 12.3)."""
        initialise(self, generator=generator)

    def predict(
        self,
        images: Float[Tensor, "view 3 height width"],
        priors: Priors | None = None,
        *,
        heads: frozenset[Head] = ALL_HEADS,
        generated: Bool[Tensor, "view"] | None = None,
    ) -> Prediction:
        """See `Reconstructor.predict`. The camera head always runs; `Priors.evidence` is not read."""
        check_views(images)
        batch_generated = None if generated is None else generated[None]
        batch = self(images[None], batch_priors(priors), heads=heads, generated=batch_generated)
        return _first_scene(batch)

    def forward(
        self,
        images: Float[Tensor, "batch view 3 height width"],
        priors: BatchPriors | None = None,
        *,
        heads: frozenset[Head] = ALL_HEADS,
        generated: Bool[Tensor, "batch view"] | None = None,
    ) -> BatchPrediction:
        """Reconstruct B scenes of S views each (worldmirror spec 1). Heads that the model lacks are skipped.

        Args:
            images: RGB in [0, 1]; sides must be multiples of ``size_multiple``.
            priors: what is known about the views.
            heads: outputs to compute; no other dense head runs.
            generated: which views are generated.

        Raises:
            ValueError: for a size that is not a multiple of the patch side.
        """
        features = self.encode(images, self.normalise(priors, images))
        # As in the official code: under autocast the heads stay in float32. Their outputs are exponentials of what they compute.
        with torch.autocast(images.device.type, enabled=False):
            return self.decode(features, images, heads=heads, generated=generated)

    def normalise(
        self, priors: BatchPriors | None, images: Float[Tensor, "batch view 3 height width"]
    ) -> NormalisedPriors | None:
        """Priors as the trunk reads them, or None where there are none or the model takes none."""
        if priors is None or not self.config.prior_prompting:
            return None
        return normalise_priors(priors, images.shape[-2], images.shape[-1])

    def encode(
        self, images: Float[Tensor, "batch view 3 height width"], priors: NormalisedPriors | None = None
    ) -> TrunkFeatures:
        """The trunk alone."""
        return self.visual_geometry_transformer(images, priors, checkpoint=self.checkpoint_activations)

    def decode(
        self,
        features: TrunkFeatures,
        images: Float[Tensor, "batch view 3 height width"],
        *,
        heads: frozenset[Head] = ALL_HEADS,
        generated: Bool[Tensor, "batch view"] | None = None,
    ) -> BatchPrediction:
        """The heads alone, on the trunk's output."""
        wanted = heads & self.config.heads
        cameras = self.cameras(features)
        depth = depth_conf = points = points_conf = normals = normals_conf = gaussians = None
        if Head.DEPTH in wanted:
            raw = self._dense(self.depth_head, features)
            depth, depth_conf = depth_and_conf(raw)
        if Head.POINTS in wanted:
            raw = self._dense(self.pts_head, features)
            points, points_conf = points_and_conf(raw)
        if Head.NORMALS in wanted:
            raw = self._dense(self.norm_head, features)
            normals, normals_conf = unit_vector(channels_last(raw[:, :, :3])), confidence(raw[:, :, 3])
        if Head.GAUSSIANS in wanted:
            gaussians = self.gaussians(features, images, cameras, generated)
        return BatchPrediction(
            cameras=cameras,
            depth=depth,
            depth_conf=depth_conf,
            points=points,
            points_conf=points_conf,
            normals=normals,
            normals_conf=normals_conf,
            gaussians=gaussians,
        )

    def cameras(self, features: TrunkFeatures) -> Cameras:
        """Cameras of all views (worldmirror spec 6)."""
        vector = self.cam_head(features.camera_tokens, checkpoint=self.checkpoint_activations)[-1]
        return cameras_from_vector(vector, features.size)

    def gaussians(
        self,
        features: TrunkFeatures,
        images: Float[Tensor, "batch view 3 height width"],
        cameras: Cameras,
        generated: Bool[Tensor, "batch view"] | None = None,
    ) -> GaussianOutput:
        """Per-pixel Gaussians placed by the head's own depth and the (detached) cameras, then merged (worldmirror spec 8)."""
        config = self.config.gaussian
        batch, views, _, height, width = images.shape
        depth_raw, channels = self.gs_head.with_features(
            features.flat(),
            images.flatten(0, 1),
            specials=features.specials,
            grid=features.grid,
            parameters=self.gs_renderer,
            checkpoint=self.checkpoint_activations,
        )
        depth_raw = torch.unflatten(depth_raw, 0, (batch, views))
        depth, conf = depth_and_conf(depth_raw)
        means = unproject_integer_pixels(depth, cameras.intrinsics_px.detach(), cameras.world_from_cam.detach())
        pixels = activate_gaussians(torch.unflatten(channels, 0, (batch, views)), images, means, config)
        source = torch.arange(views, device=images.device).repeat_interleave(height * width).expand(batch, -1)
        if config.confidence_filter:
            kept = most_confident(conf.detach(), config)
            pixels, source = pixels.select(kept), source.gather(1, kept)
        if generated is None:
            generated = torch.zeros(batch, views, dtype=torch.bool, device=images.device)
        by_generation = generated.gather(1, source)
        merged = [
            merge_voxels(pixels, b, voxel_size=config.voxel_size, source_view=source[b], generated=by_generation[b])
            if config.merge
            else leave_unmerged(pixels, b, source_view=source[b], generated=by_generation[b])
            for b in range(batch)
        ]
        made, left = conf[0].numel(), pixels.means.shape[1]
        counts = [
            GaussianCounts(made=made, filtered=made - left, merged=left - len(scene), kept=len(scene))
            for scene in merged
        ]
        return GaussianOutput(depth=depth, conf=conf, pixels=pixels, merged=merged, counts=counts)


def batch_priors(priors: Priors | None) -> BatchPriors | None:
    """Priors of one scene as a batch of one."""
    if priors is None:
        return None

    def lift(value: Tensor | None) -> Tensor | None:
        return None if value is None else value[None]

    return BatchPriors(
        world_from_cam=lift(priors.world_from_cam),
        depth=lift(priors.depth),
        intrinsics_px=lift(priors.intrinsics_px),
        posed=lift(priors.posed),
    )


def _first_scene(batch: BatchPrediction) -> Prediction:
    def first(value: Tensor | None) -> Tensor | None:
        return None if value is None else value[0]

    splats = batch.gaussians
    return Prediction(
        camera_vector=batch.cameras.vector[0],
        world_from_cam=batch.cameras.world_from_cam[0],
        intrinsics_px=batch.cameras.intrinsics_px[0],
        depth=first(batch.depth),
        depth_conf=first(batch.depth_conf),
        normals=first(batch.normals),
        normals_conf=first(batch.normals_conf),
        points=first(batch.points),
        points_conf=first(batch.points_conf),
        gaussian_depth=None if splats is None else splats.depth[0],
        gaussians=None if splats is None else splats.merged[0],
        gaussian_counts=None if splats is None else splats.counts[0],
    )
