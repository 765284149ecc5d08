"""The iterative camera head: refine a 9-vector per view from its camera token (worldmirror spec 6, omnivggt spec 6)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from sceneexpander.models.layers.block import Block, Mlp, run_checkpointed

CAMERA_VECTOR = 9  # translation 3, quaternion xyzw 4, vertical fov, horizontal fov
FOV_START = 7


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraHeadNames:
    """Parameter names of the parts, so that checkpoints of either family load by name. Defaults: WorldMirror."""

    init_token: str = "init_token"  # noqa: S105 - a parameter name
    embed: str = "param_embed"
    modulation: str = "adapt_norm_gen"
    blocks: str = "refine_net"
    out_norm: str = "out_norm"
    predictor: str = "param_predictor"


class CameraHead(nn.Module):
    """Predicts ``[cam_from_world t, quat xyzw, fov vertical, fov horizontal]`` by a few residual steps.

    Args:
        dim: width E of the camera token.
        depth: transformer blocks per step (shared by all steps); they let the views attend to each other.
        heads: attention heads.
        steps: refinement steps.
        mlp_ratio: of the blocks.
        names: parameter names.
    """

    def __init__(
        self,
        dim: int,
        *,
        depth: int = 4,
        heads: int = 16,
        steps: int = 4,
        mlp_ratio: float = 4.0,
        names: CameraHeadNames | None = None,
    ) -> None:
        super().__init__()
        names = CameraHeadNames() if names is None else names
        self.names = names
        self.steps = steps
        self.dim = dim
        self.token_norm = nn.LayerNorm(dim, eps=1e-5)
        self.register_parameter(names.init_token, nn.Parameter(torch.zeros(1, 1, CAMERA_VECTOR)))
        self.add_module(names.embed, nn.Linear(CAMERA_VECTOR, dim))
        self.add_module(names.modulation, nn.Sequential(nn.SiLU(), nn.Linear(dim, 3 * dim)))
        self.add_module(names.blocks, nn.ModuleList([Block(dim, heads, mlp_ratio=mlp_ratio) for _ in range(depth)]))
        self.add_module(names.out_norm, nn.LayerNorm(dim, eps=1e-5))
        self.add_module(names.predictor, Mlp(dim, dim // 2, CAMERA_VECTOR))

    def forward(
        self,
        camera_tokens: Float[Tensor, "batch view dim"],
        start: Float[Tensor, "batch view 9"] | None = None,
        *,
        checkpoint: bool = False,
    ) -> list[Float[Tensor, "batch view 9"]]:
        """Camera vectors after every step (fields of view rectified); the last one is the prediction.

        Each step sees the previous vector detached, so gradients flow through the last increment only.

        Args:
            camera_tokens: one token per view, un-normalised.
            start: camera vectors to refine. Without it the first step starts from the learned token and its output *is* the
                first vector; with it every step adds to the start, so a predictor of zeros returns the start exactly.
            checkpoint: recompute the blocks in the backward pass.
        """
        tokens = self.token_norm(camera_tokens)
        normalised = F.layer_norm(tokens, (self.dim,), eps=1e-6)
        vector: Tensor | None = None if start is None else start.to(tokens.dtype)
        iterates: list[Tensor] = []
        for _ in range(self.steps):
            previous = None if vector is None else vector.detach()
            increment = self._increment(tokens, normalised, previous, checkpoint)
            vector = increment if previous is None else previous + increment
            iterates.append(torch.cat([vector[..., :FOV_START], F.relu(vector[..., FOV_START:])], dim=-1))
        return iterates

    def _increment(self, tokens: Tensor, normalised: Tensor, vector: Tensor | None, checkpoint: bool) -> Tensor:
        names = self.names
        if vector is None:
            init = self.get_parameter(names.init_token)
            vector = init.expand(*tokens.shape[:2], CAMERA_VECTOR)
        embedded = self.get_submodule(names.embed)(vector)
        shift, scale, gate = self.get_submodule(names.modulation)(embedded).chunk(3, dim=-1)
        x = gate * (normalised * (1 + scale) + shift) + tokens
        for block in self.get_submodule(names.blocks).children():
            x = run_checkpointed(block, x, enabled=checkpoint)
        return self.get_submodule(names.predictor)(self.get_submodule(names.out_norm)(x))
