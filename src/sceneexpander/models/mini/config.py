"""All sizes of the embedded reconstructor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields

PATCH_PX = 16  # stride of the convolutional stem: one token per 16 x 16 working pixels
OUTPUT_STRIDE = 2  # the dense heads answer at half the working resolution


@dataclass(frozen=True, slots=True, kw_only=True)
class MiniConfig:
    """Architecture and fixed geometric factors of `Mini`; stored inside its weights file.

    ``work_px`` is the longer side of the internal resolution: cost does not grow with the size of the images.
    """

    work_px: int = 192
    width: int = 128  # token width
    attention_heads: int = 2
    depth: int = 4  # pairs of (frame, global) attention blocks
    register_tokens: int = 2
    layer_scale: float = 0.1  # initial LayerScale; large because training is short
    stem_widths: tuple[int, int, int] = (32, 48, 96)  # at 1/2, 1/4 and 1/8 of the working resolution
    dpt_widths: tuple[int, int, int, int] = (48, 64, 96, 96)
    features: int = 48  # width of the fusion decoder
    head_width: int = 32
    camera_blocks: int = 2
    camera_steps: int = 2
    camera_gain: float = 0.02  # share of the camera head's residual that is applied, see `Mini._cameras`
    max_log_residual: float = 2.0  # the depth residual saturates at e^2 = 7.4 times the base
    confident_pull: float = (
        0.9  # share of the residual that confident pixels ignore, as long as the network does not say otherwise
    )
    splat_std_px: float = 0.55  # standard deviation of a Gaussian in pixels of its own view
    max_stretch: float = 3.0  # along the slant of a surface, 1 / cos at most
    splat_thickness: float = 0.2  # standard deviation along the normal / across
    cross_views: int = 8  # other views each view is compared with, nearest first

    def __post_init__(self) -> None:
        if self.work_px % PATCH_PX:
            raise ValueError(f"work_px must be a multiple of {PATCH_PX}, got {self.work_px}")
        if self.width % (4 * self.attention_heads):
            raise ValueError(f"width {self.width} must be a multiple of 4 x {self.attention_heads} attention heads")

    def to_dict(self) -> dict[str, object]:
        """Plain values for the metadata of a weights file."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, values: Mapping[str, object]) -> MiniConfig:
        """Inverse of `to_dict`. Unknown keys raise `ValueError`: the file was written by another version."""
        known = {field.name for field in fields(cls)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise ValueError(f"unknown MiniConfig keys: {unknown}")
        return cls(**{name: tuple(value) if isinstance(value, list) else value for name, value in values.items()})  # type: ignore[arg-type]
