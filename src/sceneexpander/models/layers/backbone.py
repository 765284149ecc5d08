"""What WorldMirror and OmniVGGT have in common: an image encoder, an alternating trunk, and their sizes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.models.layers.dpt import DptConfig
from sceneexpander.models.layers.rope import grid_rope
from sceneexpander.models.layers.trunk import AlternatingTrunk, Tokens
from sceneexpander.models.layers.vit import DinoEncoder, normalise_rgb


@dataclass(frozen=True, slots=True, kw_only=True)
class BackboneConfig:
    """Sizes of encoder, trunk, camera head and dense heads. The defaults are those of the released checkpoints.

    ``image_size`` is the side of the square that the position table was made for; images may have any size that is a multiple of
    ``patch``.
    """

    image_size: int = 518
    patch: int = 14
    dim: int = 1024
    encoder_depth: int = 24
    encoder_heads: int = 16
    trunk_depth: int = 24
    trunk_heads: int = 16
    registers: int = 4
    rope_base: float = 100.0
    collect: tuple[int, ...] = (4, 11, 17, 23)
    camera_depth: int = 4
    camera_heads: int = 16
    camera_steps: int = 4
    dpt: DptConfig = field(default_factory=DptConfig)

    def __post_init__(self) -> None:
        if len(self.collect) != len(self.dpt.factors):
            raise ValueError(f"{len(self.collect)} collected blocks do not match the dense heads' levels")
        if self.image_size % self.patch:
            raise ValueError(f"image_size {self.image_size} is not a multiple of the patch side {self.patch}")

    @classmethod
    def tiny_sizes(cls) -> Self:
        """Complete but very small (about 0.5 M parameters)."""
        return cls(
            image_size=56,
            dim=32,
            encoder_depth=2,
            encoder_heads=4,
            trunk_depth=4,
            trunk_heads=2,
            collect=(0, 1, 2, 3),
            camera_depth=2,
            camera_heads=4,
            dpt=DptConfig(features=16, out_channels=(8, 12, 16, 20)),
        )

    @property
    def specials(self) -> int:
        """Tokens of a view in front of its patches: camera and registers."""
        return 1 + self.registers


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


class ImageTrunk(AlternatingTrunk):
    """An alternating trunk with its image encoder. Families subclass it and add their tokens and priors.

    Args:
        config: sizes.
        mask_token: see `DinoEncoder`.
    """

    def __init__(self, config: BackboneConfig, *, mask_token: bool) -> None:
        super().__init__(config.dim, depth=config.trunk_depth, heads=config.trunk_heads, collect=config.collect)
        self.config = config
        self.patch_embed = DinoEncoder(
            config.dim,
            depth=config.encoder_depth,
            heads=config.encoder_heads,
            image_size=config.image_size,
            patch=config.patch,
            registers=config.registers,
            mask_token=mask_token,
        )

    def patch_tokens(
        self, images: Float[Tensor, "batch view 3 height width"], *, checkpoint: bool = False
    ) -> Float[Tensor, "batch view patch dim"]:
        """Encode every view on its own.

        Raises:
            ValueError: for a size that is not a multiple of the patch side.
        """
        height, width = images.shape[-2:]
        patch = self.config.patch
        if height % patch or width % patch or not height * width:
            raise ValueError(f"image size {height} x {width} is not a multiple of {patch}")
        patches = self.patch_embed(normalise_rgb(images).flatten(0, 1), checkpoint=checkpoint)
        return torch.unflatten(patches, 0, tuple(images.shape[:2]))

    def features(
        self,
        tokens: Tokens,
        size: tuple[int, int],
        *,
        after_frame: Callable[[int, Tokens], Tokens] | None = None,
        checkpoint: bool = False,
    ) -> TrunkFeatures:
        """Run the trunk.

        Args:
            tokens: special tokens, then patches, of every view.
            size: height and width of the images.
            after_frame: see `AlternatingTrunk.alternate`.
            checkpoint: recompute each block in the backward pass.
        """
        config = self.config
        grid = (size[0] // config.patch, size[1] // config.patch)
        rope = grid_rope(*grid, specials=config.specials, head_dim=self.head_dim, base=config.rope_base, like=tokens)
        collected = self.alternate(tokens, rope, after_frame=after_frame, checkpoint=checkpoint)
        return TrunkFeatures(collected=collected, specials=config.specials, grid=grid, size=size)
