"""What the reconstructors on the common backbone share beyond their layers: construction, initialisation, dense heads."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneexpander.models.layers.backbone import BackboneConfig, TrunkFeatures
from sceneexpander.models.layers.camera_head import CameraHead, CameraHeadNames
from sceneexpander.models.layers.dpt import DptHead
from sceneexpander.models.layers.init import materialise
from sceneexpander.models.layers.outputs import dense_map


class BackboneModel(nn.Module, ABC):
    """Base of WorldMirror and OmniVGGT. Nothing depends on ``train()``/``eval()``: there is no dropout.

    Args:
        config: sizes.
        checkpoint_activations: recompute activations in the backward pass instead of keeping them. Same values, same gradients.
    """

    requires_priors = False

    def __init__(self, config: BackboneConfig, *, checkpoint_activations: bool = False) -> None:
        super().__init__()
        self.config = config
        self.checkpoint_activations = checkpoint_activations
        self.size_multiple = config.patch

    @classmethod
    def create(
        cls, config: BackboneConfig, *, generator: torch.Generator, checkpoint_activations: bool = False
    ) -> Self:
        """A freshly initialised model whose numbers come from ``generator`` alone."""
        with torch.device("meta"):
            model = cls(config, checkpoint_activations=checkpoint_activations)
        materialise(model, device=generator.device)
        model.initialise(generator)
        return model

    def save_memory(self, *, checkpoint_activations: bool, views_per_chunk: int) -> None:
        """See `SavesMemory.save_memory`."""
        self.checkpoint_activations = checkpoint_activations
        set_views_per_chunk(self, views_per_chunk)

    @abstractmethod
    def initialise(self, generator: torch.Generator) -> None:
        """Draw every parameter anew."""

    def _new_camera_head(self, names: CameraHeadNames | None = None) -> CameraHead:
        config = self.config
        return CameraHead(
            2 * config.dim, depth=config.camera_depth, heads=config.camera_heads, steps=config.camera_steps, names=names
        )

    def _dense(self, head: DptHead, features: TrunkFeatures) -> Float[Tensor, "batch view channel height width"]:
        return dense_map(head, features, checkpoint=self.checkpoint_activations)


def set_views_per_chunk(model: nn.Module, count: int) -> None:
    """Let every dense head of a model work on ``count`` views at once; 0: as its configuration says."""
    for module in model.modules():
        if isinstance(module, DptHead):
            module.views_per_chunk = count or module.config.views_per_chunk
