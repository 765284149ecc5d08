"""WorldMirror's trunk: image encoder, prior tokens, alternating attention (worldmirror spec 3 to 5)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneexpander.models.layers.rope import grid_rope
from sceneexpander.models.layers.trunk import AlternatingTrunk, per_view_tokens
from sceneexpander.models.layers.vit import DinoEncoder, normalise_rgb
from sceneexpander.models.worldmirror.config import WorldMirrorConfig
from sceneexpander.models.worldmirror.priors import DepthEmbed, NormalisedPriors, vector_encoder


@dataclass(frozen=True, slots=True, kw_only=True)
class TrunkFeatures:
    """What the heads read: token sets of several depths, and the sizes that belong to them."""

    collected: list[Float[Tensor, "batch view token dim2"]]
    specials: int  # tokens in front of the patches
    grid: tuple[int, int]  # rows, columns of patches
    size: tuple[int, int]  # height, width of the images

    @property
    def camera_tokens(self) -> Float[Tensor, "batch view dim2"]:
        """Token 0 of the deepest set."""
        return self.collected[-1][:, :, 0]

    def flat(self) -> list[Float[Tensor, "batch_view token dim2"]]:
        """The sets with views flattened into the batch."""
        return [tokens.flatten(0, 1) for tokens in self.collected]


class VisualGeometryTransformer(AlternatingTrunk):
    """Images and normalised priors -> `TrunkFeatures`."""

    def __init__(self, config: WorldMirrorConfig) -> None:
        super().__init__(config.dim, depth=config.trunk_depth, heads=config.trunk_heads, collect=config.collect)
        self.config = config
        self.patch_embed = DinoEncoder(
            config.dim,
            depth=config.encoder_depth,
            heads=config.encoder_heads,
            image_size=config.image_size,
            patch=config.patch,
            registers=config.registers,
        )
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
        config = self.config
        batch, views, _, height, width = images.shape
        grid = (height // config.patch, width // config.patch)
        patches = self.patch_embed(normalise_rgb(images).flatten(0, 1), checkpoint=checkpoint)
        tokens = self.tokens(torch.unflatten(patches, 0, (batch, views)), priors or NormalisedPriors())
        rope = grid_rope(*grid, specials=config.specials, head_dim=self.head_dim, base=config.rope_base, like=tokens)
        collected = self.alternate(tokens, rope, checkpoint=checkpoint)
        return TrunkFeatures(collected=collected, specials=config.specials, grid=grid, size=(height, width))

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
