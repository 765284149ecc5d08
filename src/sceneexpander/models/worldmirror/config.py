"""Every size of WorldMirror, as one value."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from sceneexpander.models.layers.backbone import BackboneConfig
from sceneexpander.models.layers.dpt import DptConfig
from sceneexpander.models.protocol import ALL_HEADS, Head


@dataclass(frozen=True, slots=True, kw_only=True)
class GaussianConfig:
    """Gaussian parameters and their merge (worldmirror spec 8)."""

    hidden: int = 256  # width of the per-pixel convolutions
    max_scale: float = 0.3  # scene units
    merge: bool = True
    voxel_size: float = 0.002  # scene units
    confidence_filter: bool = False  # keep the most confident share before merging
    keep_share: float = 0.7
    max_kept: int = 5_000_000

    def __post_init__(self) -> None:
        if self.voxel_size <= 0:
            raise ValueError(f"voxel_size must be above 0, got {self.voxel_size}")
        if not 0 < self.keep_share <= 1:
            raise ValueError(f"keep_share must be in (0, 1], got {self.keep_share}")


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldMirrorConfig(BackboneConfig):
    """Sizes and switches. The defaults are those of the released checkpoint (worldmirror spec 1.1).

    ``prior_prompting`` adds a pose and a ray token to every view. ``heads`` are the heads that exist.
    """

    prior_prompting: bool = True
    gaussian_dpt: DptConfig = field(default_factory=DptConfig)
    gaussian: GaussianConfig = field(default_factory=GaussianConfig)
    heads: frozenset[Head] = ALL_HEADS

    def __post_init__(self) -> None:
        # Not super(): a class with slots is made twice, and super() would mean the first one.
        BackboneConfig.__post_init__(self)
        if len(self.collect) != len(self.gaussian_dpt.factors):
            raise ValueError(f"{len(self.collect)} collected blocks do not match the Gaussian head's levels")
        if Head.CAMERA not in self.heads:
            raise ValueError("the camera head cannot be left out: predictions are made of cameras")

    @classmethod
    def large(cls) -> WorldMirrorConfig:
        """The released configuration: 1544 tensors, 1,263,337,002 parameters."""
        return cls()

    @classmethod
    def mid(cls) -> WorldMirrorConfig:
        """A sixth of the released size (198.6 M parameters), for timings on a CPU; nobody publishes weights for it."""
        return cls(dim=384, encoder_depth=12, encoder_heads=6, trunk_depth=8, trunk_heads=6, collect=(1, 3, 5, 7))

    @classmethod
    def tiny(cls) -> WorldMirrorConfig:
        """A complete but very small configuration (0.6 M parameters) for dry runs; nobody publishes weights for it."""
        sizes = cls.tiny_sizes()
        return replace(sizes, gaussian_dpt=sizes.dpt)

    @property
    def specials(self) -> int:
        """Tokens of a view in front of its patches: camera, registers and, with prior prompting, pose and ray."""
        return 1 + self.registers + (2 if self.prior_prompting else 0)
