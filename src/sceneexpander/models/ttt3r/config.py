"""Every size of CUT3R, and how its state is updated, as one value."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from sceneexpander.models.layers.dpt import DptConfig

UpdateRule = Literal["ttt3r", "cut3r"]


def cut3r_dpt(*, features: int, out_channels: tuple[int, ...], hidden: int) -> DptConfig:
    """A dense head of the CUT3R kind (ttt3r spec 6)."""
    return DptConfig(
        features=features,
        out_channels=out_channels,
        hidden=hidden,
        rectified_skip=False,
        uv_embedding=False,
        input_norm=False,
        crop_doubled=True,
        coarse_unit=True,
    )


def _released_dpt() -> DptConfig:
    return cut3r_dpt(features=256, out_channels=(96, 192, 384, 768), hidden=128)


@dataclass(frozen=True, slots=True, kw_only=True)
class TTT3RConfig:
    """Sizes and switches. The defaults are those of the released checkpoint (ttt3r spec 1).

    ``update``: ``ttt3r`` moves every state token by its own rate, ``cut3r`` replaces the state. ``encoder_rope_fp16`` rounds the
    image encoder's queries and keys to float16 around their rotation, as the released kernel does. ``reset_every`` forgets the
    state after every so many views and chains the cameras; None, as in the evaluations of the method: never.
    """

    patch: int = 16
    encoder_dim: int = 1024
    encoder_depth: int = 24
    encoder_heads: int = 16
    ray_depth: int = 2
    ray_heads: int = 16
    dim: int = 768
    depth: int = 12
    heads: int = 12
    state_heads: int = 16
    state_tokens: int = 768
    memory_slots: int = 256
    memory_depth: int = 2
    mlp_ratio: float = 4.0
    rope_base: float = 100.0
    dpt: DptConfig = field(default_factory=_released_dpt)
    update: UpdateRule = "ttt3r"
    encoder_rope_fp16: bool = True
    reset_every: int | None = None

    def __post_init__(self) -> None:
        if self.update not in ("ttt3r", "cut3r"):
            raise ValueError(f"update must be ttt3r or cut3r, got {self.update!r}")
        if len(self.dpt.factors) != 4:
            raise ValueError(f"the dense heads read 4 levels, not {len(self.dpt.factors)}")
        if self.depth < 2:
            raise ValueError(
                f"the dense heads read two intermediate layers: depth must be at least 2, got {self.depth}"
            )
        if self.reset_every is not None and self.reset_every < 1:
            raise ValueError(f"reset_every must be at least 1, got {self.reset_every}")

    @classmethod
    def large(cls, *, update: UpdateRule = "ttt3r") -> TTT3RConfig:
        """The released configuration (512, dense heads): 1248 names, 793,307,858 parameters."""
        return cls(update=update)

    @classmethod
    def tiny(cls, *, update: UpdateRule = "ttt3r") -> TTT3RConfig:
        """A complete but very small configuration (0.9 M parameters) for dry runs; nobody publishes weights for it."""
        return cls(
            encoder_dim=64,
            encoder_depth=2,
            encoder_heads=4,
            ray_depth=1,
            ray_heads=4,
            dim=32,
            depth=4,
            heads=2,
            state_heads=4,
            state_tokens=20,
            memory_slots=8,
            dpt=cut3r_dpt(features=16, out_channels=(8, 12, 16, 20), hidden=8),
            update=update,
        )

    @property
    def state_grid(self) -> tuple[int, int]:
        """(rows, columns) of the grid that gives the state tokens their positions; its last row may be part full.

        The columns are the root of the number of tokens, rounded down and made even.
        """
        side = math.isqrt(self.state_tokens)
        columns = side + side % 2
        return math.ceil(self.state_tokens / columns), columns

    @property
    def dense_layers(self) -> tuple[int, int]:
        """The two decoder layers that the dense heads read besides the last, counted from 1."""
        return 2 * self.depth // 4, 3 * self.depth // 4
