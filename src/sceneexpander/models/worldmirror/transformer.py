"""WorldMirror's trunk: image encoder, prior tokens, alternating attention (worldmirror spec 3 to 5)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneexpander.models.layers.backbone import ImageTrunk, TrunkFeatures
from sceneexpander.models.layers.trunk import per_view_tokens
from sceneexpander.models.worldmirror.config import WorldMirrorConfig
from sceneexpander.models.worldmirror.priors import DepthEmbed, NormalisedPriors, vector_encoder


class VisualGeometryTransformer(ImageTrunk):
    """Images and normalised priors -> `TrunkFeatures`."""

    config: WorldMirrorConfig

    def __init__(self, config: WorldMirrorConfig) -> None:
        super().__init__(config, mask_token=True)
        self.cam_token = nn.Parameter(torch.zeros(1, 2, 1, config.dim))
        self.reg_token = nn.Parameter(torch.zeros(1, 2, config.registers, config.dim))
        if config.prior_prompting:
            self.pose_embed = vector_encoder(7, config.dim)
            self.ray_embed = vector_encoder(4, config.dim)
            self.depth_embed = DepthEmbed(config.patch, config.dim)

    def forward(
        self,
        images: Float[Tensor, "batch view 3 height width"],
        priors: NormalisedPriors | None = None,
        *,
        checkpoint: bool = False,
    ) -> TrunkFeatures:
        """Encode B scenes of S views. Without prior prompting in the configuration, priors are ignored.

        Args:
            images: RGB in [0, 1], sides multiples of the patch side.
            priors: from `normalise_priors`.
            checkpoint: recompute each block in the backward pass.
        """
        patches = self.patch_tokens(images, checkpoint=checkpoint)
        tokens = self.tokens(patches, priors or NormalisedPriors())
        return self.features(tokens, (images.shape[-2], images.shape[-1]), checkpoint=checkpoint)

    def tokens(
        self, patches: Float[Tensor, "batch view patch dim"], priors: NormalisedPriors
    ) -> Float[Tensor, "batch view token dim"]:
        """``[camera | registers | pose | ray | patches (+ depth)]`` of every view."""
        batch, views = patches.shape[:2]
        parts = [per_view_tokens(self.cam_token, batch, views), per_view_tokens(self.reg_token, batch, views)]
        if self.config.prior_prompting:
            # A prior that is off is a zero token, not a missing one.
            off = patches.new_zeros(batch, views, 1, patches.shape[-1])
            pose = off if priors.pose is None else self.pose_embed(priors.pose)[:, :, None]
            if priors.posed is not None:
                pose = torch.where(priors.posed[:, :, None, None], pose, off)
            ray = off if priors.ray is None else self.ray_embed(priors.ray)[:, :, None]
            parts += [pose, ray]
            if priors.depth is not None:
                patches = patches + self.depth_embed(priors.depth)
        dtype = torch.promote_types(patches.dtype, self.cam_token.dtype)
        return torch.cat([part.to(dtype) for part in [*parts, patches]], dim=2)
