"""What CUT3R predicts from one time step: camera, two pointmaps, colour (ttt3r spec 6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneexpander.models.layers.activations import confidence, radial_expm1
from sceneexpander.models.layers.block import Mlp
from sceneexpander.models.layers.dpt import DptHead, DptNames
from sceneexpander.models.layers.rope import RopeTable
from sceneexpander.models.ttt3r.blocks import ModulatedBlock
from sceneexpander.models.ttt3r.config import TTT3RConfig

NAMES = DptNames(
    project="act_postprocess.{index}.0",
    resize="act_postprocess.{index}.1",
    level_alias="scratch.layer_rn.{index}",
    features="head.0",
    hidden="head.2",
    output="head.4",
)
CAMERA_CHANNELS = 7  # translation 3, quaternion wxyz 4
MODULATIONS = 2
RGB_MARGIN = 1e-6


class DenseMap(StrEnum):
    """The dense maps of a time step."""

    SELF = "self"  # points in the view's own camera frame
    WORLD = "world"  # points in the first camera's frame, regressed directly
    RGB = "rgb"


ALL_MAPS = frozenset(DenseMap)


@dataclass(frozen=True, slots=True, kw_only=True)
class StepMaps:
    """Outputs of the heads for one time step; maps that were not asked for are None."""

    camera_pose: Float[Tensor, "batch 7"]  # world_from_cam: translation, unit quaternion wxyz with w >= 0
    points_self: Float[Tensor, "batch height width 3"] | None = None
    conf_self: Float[Tensor, "batch height width"] | None = None  # >= 1
    points_world: Float[Tensor, "batch height width 3"] | None = None
    conf_world: Float[Tensor, "batch height width"] | None = None  # >= 1
    rgb: Float[Tensor, "batch height width 3"] | None = None  # in (-1, 1)


class PoseHead(nn.Module):
    """Pose token -> camera."""

    def __init__(self, dim: int, mlp_ratio: float) -> None:
        super().__init__()
        self.mlp = Mlp(dim, int(dim * mlp_ratio), CAMERA_CHANNELS)

    def forward(self, pose_token: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch 7"]:
        raw = self.mlp(pose_token)
        quat = nn.functional.normalize(raw[:, 3:], dim=-1)
        quat = torch.where(quat[:, :1] < 0, -quat, quat)
        return torch.cat([radial_expm1(raw[:, :3]), quat], dim=-1)


class StepHeads(nn.Module):
    """All heads; submodule names are those of the checkpoint's ``downstream_head``."""

    def __init__(self, config: TTT3RConfig) -> None:
        super().__init__()
        widths = (config.encoder_dim, config.dim, config.dim, config.dim)
        self.dpt_self = DptHead(widths, 4, config.dpt, names=NAMES)
        self.dpt_cross = DptHead(widths, 4, config.dpt, names=NAMES)
        self.dpt_rgb = DptHead(widths, 3, config.dpt, names=NAMES)
        self.final_transform = nn.ModuleList(
            [ModulatedBlock(config.dim, config.heads, mlp_ratio=config.mlp_ratio) for _ in range(MODULATIONS)]
        )
        self.pose_head = PoseHead(config.dim, config.mlp_ratio)
        self.patch = config.patch

    def forward(
        self,
        levels: Sequence[Float[Tensor, "batch patch _"]],
        pose_token: Float[Tensor, "batch 1 dim"],
        rope: RopeTable,
        *,
        grid: tuple[int, int],
        maps: frozenset[DenseMap] = ALL_MAPS,
    ) -> StepMaps:
        """The camera, and the maps asked for.

        Args:
            levels: the fused features and the patch tokens of three decoder layers, the last one normalised.
            pose_token: the decoder's pose token.
            rope: rotations of the patches.
            grid: rows and columns of patches.
            maps: which maps to compute.
        """
        points_self = conf_self = points_world = conf_world = rgb = None
        if DenseMap.SELF in maps:
            points_self, conf_self = _pointmap(self._dense(self.dpt_self, levels, grid))
        if DenseMap.WORLD in maps:
            last = levels[-1]
            for block in self.final_transform:
                last = block(last, pose_token, rope)
            points_world, conf_world = _pointmap(self._dense(self.dpt_cross, [*levels[:-1], last], grid))
        if DenseMap.RGB in maps:
            level = torch.sigmoid(self._dense(self.dpt_rgb, levels, grid)) * (1 - 2 * RGB_MARGIN) + RGB_MARGIN
            rgb = 2 * (level.movedim(1, -1) - 0.5)
        return StepMaps(
            camera_pose=self.pose_head(pose_token[:, 0]),
            points_self=points_self,
            conf_self=conf_self,
            points_world=points_world,
            conf_world=conf_world,
            rgb=rgb,
        )

    def _dense(self, head: DptHead, levels: Sequence[Tensor], grid: tuple[int, int]) -> Tensor:
        return head(levels, specials=0, grid=grid, size=(grid[0] * self.patch, grid[1] * self.patch))


def _pointmap(raw: Float[Tensor, "batch 4 height width"]) -> tuple[Tensor, Tensor]:
    return radial_expm1(raw[:, :3].movedim(1, -1)), confidence(raw[:, 3])
