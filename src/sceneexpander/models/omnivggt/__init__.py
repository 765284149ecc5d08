"""OmniVGGT: a feed-forward reconstructor that takes any subset of cameras and depth maps."""

from sceneexpander.models.omnivggt.config import OmniVGGTConfig
from sceneexpander.models.omnivggt.model import OmniVGGT

__all__ = ["OmniVGGT", "OmniVGGTConfig"]
