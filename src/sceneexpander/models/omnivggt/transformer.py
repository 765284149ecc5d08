"""OmniVGGT's trunk: image encoder, injected cameras and depth, alternating attention (omnivggt spec 3 to 5)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneexpander.models.layers.backbone import ImageTrunk, TrunkFeatures
from sceneexpander.models.layers.trunk import Tokens, per_view_tokens
from sceneexpander.models.layers.vit import PatchConv
from sceneexpander.models.omnivggt.config import OmniVGGTConfig
from sceneexpander.models.omnivggt.priors import EncodedPriors

CAMERA_VECTOR = 9
DEPTH_CHANNELS = 2  # normalised depth, mask


class Aggregator(ImageTrunk):
    """Images and encoded priors -> `TrunkFeatures`.

    Cameras enter at ``trunk_depth + 1`` sites: on the camera token before the first block, and after every frame block.
    """

    config: OmniVGGTConfig

    def __init__(self, config: OmniVGGTConfig) -> None:
        super().__init__(config, mask_token=False)
        dim, sites = config.dim, config.trunk_depth + 1
        self.camera_token = nn.Parameter(torch.zeros(1, 2, 1, dim))
        self.register_token = nn.Parameter(torch.zeros(1, 2, config.registers, dim))
        self.depth_placeholder = nn.Parameter(torch.zeros(1, 1, dim))
        self.pose_embeddings = nn.ModuleList([nn.Linear(CAMERA_VECTOR, dim) for _ in range(sites)])
        self.camera_adapters = nn.ModuleList([nn.Linear(dim, dim) for _ in range(sites)])
        self.depth_patch_embed = PatchConv(config.patch, dim, DEPTH_CHANNELS)

    def forward(
        self,
        images: Float[Tensor, "batch view 3 height width"],
        priors: EncodedPriors | None = None,
        *,
        checkpoint: bool = False,
    ) -> TrunkFeatures:
        """Encode B scenes of S views.

        Args:
            images: RGB in [0, 1], sides multiples of the patch side.
            priors: from `encode_priors`.
            checkpoint: recompute each block in the backward pass.
        """
        priors = priors or EncodedPriors()
        patches = self.patch_tokens(images, checkpoint=checkpoint)
        batch, views = patches.shape[:2]
        cameras = per_view_tokens(self.camera_token, batch, views) + self.injection(0, priors, patches)
        registers = per_view_tokens(self.register_token, batch, views)
        patches = patches + self.depth_tokens(priors, patches)
        tokens = torch.cat([cameras, registers, patches], dim=2)

        def inject(index: int, per_view: Tokens) -> Tokens:
            camera = per_view[:, :, :1] + self.injection(index + 1, priors, per_view)
            return torch.cat([camera, per_view[:, :, 1:]], dim=2)

        size = (images.shape[-2], images.shape[-1])
        return self.features(tokens, size, after_frame=inject, checkpoint=checkpoint)

    def injection(self, site: int, priors: EncodedPriors, like: Tokens) -> Float[Tensor, "batch view 1 dim"]:
        """What a site adds to the camera tokens. Views without a camera get the adapter's bias."""
        embedded = like.new_zeros(like.shape[0], like.shape[1], like.shape[-1])
        if priors.cameras is not None:
            given = self.pose_embeddings[site](priors.cameras).to(embedded.dtype)
            embedded = embedded.index_copy(1, _index(priors.camera_views, like), given)
        return self.camera_adapters[site](embedded)[:, :, None]

    def depth_tokens(self, priors: EncodedPriors, like: Tokens) -> Float[Tensor, "batch view patch dim"]:
        """What is added to the patch tokens: the embedded depth of views that have one, the placeholder elsewhere."""
        tokens = self.depth_placeholder[:, None].expand_as(like)
        if priors.depth is None:
            return tokens
        embedded = self.depth_patch_embed(priors.depth.flatten(0, 1))
        embedded = torch.unflatten(embedded, 0, tuple(priors.depth.shape[:2])).to(tokens.dtype)
        return tokens.index_copy(1, _index(priors.depth_views, like), embedded)


def _index(views: tuple[int, ...], like: Tensor) -> Tensor:
    return torch.tensor(views, dtype=torch.int64, device=like.device)
