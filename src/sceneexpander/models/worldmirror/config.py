"""Every size of WorldMirror, as one value."""

from __future__ import annotations

from dataclasses import dataclass, field

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
class WorldMirrorConfig:
    """Sizes and switches. The defaults are those of the released checkpoint (worldmirror spec 1.1).

    ``image_size`` is the side of the square that the position table was made for; images may have any size that is a multiple of
    ``patch``. ``prior_prompting`` adds a pose and a ray token to every view. ``heads`` are the heads that exist.
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
    prior_prompting: bool = True
    camera_depth: int = 4
    camera_heads: int = 16
    camera_steps: int = 4
    dpt: DptConfig = field(default_factory=DptConfig)
    gaussian_dpt: DptConfig = field(default_factory=DptConfig)
    gaussian: GaussianConfig = field(default_factory=GaussianConfig)
    heads: frozenset[Head] = ALL_HEADS

    def __post_init__(self) -> None:
        levels = {len(self.collect), len(self.dpt.factors), len(self.gaussian_dpt.factors)}
        if len(levels) != 1:
            raise ValueError(f"{len(self.collect)} collected blocks do not match the dense heads' levels")
        if self.image_size % self.patch:
            raise ValueError(f"image_size {self.image_size} is not a multiple of the patch side {self.patch}")
        if Head.CAMERA not in self.heads:
            raise ValueError("the camera head cannot be left out: predictions are made of cameras")

    @classmethod
    def large(cls) -> WorldMirrorConfig:
        """The released configuration: 1544 tensors, 1,263,337,002 parameters."""
        return cls()

    @classmethod
    def tiny(cls) -> WorldMirrorConfig:
        """A complete but very small configuration (0.6 M parameters) for dry runs; nobody publishes weights for it."""
        dpt = DptConfig(features=16, out_channels=(8, 12, 16, 20))
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
            dpt=dpt,
            gaussian_dpt=dpt,
        )

    @property
    def specials(self) -> int:
        """Tokens of a view in front of its patches: camera, registers and, with prior prompting, pose and ray."""
        return 1 + self.registers + (2 if self.prior_prompting else 0)
