"""Every size of OmniVGGT, as one value."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.models.layers.backbone import BackboneConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class OmniVGGTConfig(BackboneConfig):
    """Sizes. The defaults are those of the released checkpoint (omnivggt spec 1)."""

    @classmethod
    def large(cls) -> OmniVGGTConfig:
        """The released configuration: 1505 tensors, 1,217,494,552 parameters."""
        return cls()

    @classmethod
    def tiny(cls) -> OmniVGGTConfig:
        """A complete but very small configuration for dry runs; nobody publishes weights for it."""
        return cls.tiny_sizes()
