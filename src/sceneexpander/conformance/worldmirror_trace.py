"""Recording the intermediate tensors of a WorldMirror forward pass under the names of the fixtures."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from sceneexpander.conformance.recorder import Recorder
from sceneexpander.models.layers.rope import grid_positions
from sceneexpander.models.worldmirror.model import WorldMirror
from sceneexpander.models.worldmirror.priors import normalised_depth, pose_vector, ray_vector


class Trace(Recorder):
    """Records during ``with trace: model(...)``; of several trunk passes the first is kept, of Gaussian heads the only one.

    Args:
        model: the model to observe; its forward pass is not changed.
    """

    def __init__(self, model: WorldMirror) -> None:
        super().__init__()
        self.model = model

    def observe(self) -> None:
        model, trunk = self.model, self.model.visual_geometry_transformer
        encoder = trunk.patch_embed
        self.output(encoder.patch_embed, "dino.patch_proj")
        self.input(encoder.blocks[0], "dino.tokens_in")
        for k, block in enumerate(encoder.blocks):
            self.output(block, f"dino.block{k}")
        self.output(encoder, "patch_tokens")
        self.input(trunk.frame_blocks[0], "trunk.tokens_in")
        for k, (frame, every) in enumerate(zip(trunk.frame_blocks, trunk.global_blocks, strict=True)):
            self.output(frame, f"trunk.frame{k}")
            self.output(every, f"trunk.global{k}")
        self.hook(trunk, self._collected)
        self.hook(model.cam_head, self._camera_steps)
        if model.config.prior_prompting:
            self.output(trunk.pose_embed, "cond.pose_token")
            self.output(trunk.ray_embed, "cond.ray_token")
            self.output(trunk.depth_embed, "cond.depth_tokens")
        for name in ("depth_head", "pts_head", "norm_head", "gs_head"):
            if hasattr(model, name):
                self._dense_head(name)
        if hasattr(model, "gs_renderer"):
            self.input(model.gs_renderer, "gs_head.features")
            self.output(model.gs_renderer, "gs.params_raw")

    def tensors(self, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
        """The records as ``inter.*``, reshaped to the recorded layout, with what follows from the inputs alone."""
        config = self.model.config
        batch, views, _, height, width = inputs["img"].shape
        grid = (height // config.patch, width // config.patch)
        records = {name: self._shaped(name, value, batch, views) for name, value in self.records.items()}
        with torch.inference_mode():
            records["dino.pos_embed"] = self.model.visual_geometry_transformer.patch_embed.position_table(*grid)
            positions = torch.from_numpy(grid_positions(*grid, specials=config.specials))
            records["trunk.rope_positions"] = positions.expand(batch, views, -1, -1)
            if "camera_poses" in inputs:
                records["prior.pose_vec"] = pose_vector(inputs["camera_poses"])
            if "depthmap" in inputs:
                records["prior.depth_norm"] = normalised_depth(inputs["depthmap"], height, width)
            if "camera_intrs" in inputs:
                records["prior.ray_vec"] = ray_vector(inputs["camera_intrs"], height, width)
        count, dim = batch * views, config.dim
        off = {"pose_token": 1, "ray_token": 1, "depth_tokens": grid[0] * grid[1]}
        for name, length in off.items():
            records.setdefault(f"cond.{name}", torch.zeros(count, length, dim))
        return {f"inter.{name}": value for name, value in records.items()}

    def _shaped(self, name: str, value: Tensor, batch: int, views: int) -> Tensor:
        if name.startswith(("trunk.", "gs_head.features")):
            return (
                value.reshape(batch, -1, *value.shape[1:]) if value.shape[0] != batch else self._by_view(value, views)
            )
        if name.startswith("cond."):
            return value.reshape(batch * views, -1, value.shape[-1])
        return value

    @staticmethod
    def _by_view(value: Tensor, views: int) -> Tensor:
        """(batch, view * token, dim), or one view's (1, ...), -> (batch, view, token or channel, ...)."""
        if value.ndim == 3:
            return value.reshape(value.shape[0], views, -1, value.shape[-1])
        return value.reshape(value.shape[0], views, *value.shape[1:])

    def _collected(self, _module: nn.Module, _inputs: tuple[Any, ...], output: Any) -> None:
        for j, tokens in enumerate(output.collected):
            self.record(f"tokens.collected{j}", tokens)

    def _camera_steps(self, _module: nn.Module, _inputs: tuple[Any, ...], output: Any) -> None:
        for k, vector in enumerate(output):
            self.record(f"cam_head.iter{k}", vector)

    def _dense_head(self, name: str) -> None:
        head = self.model.get_submodule(name)
        for j, layer in enumerate(head.get_submodule("resize_layers").children()):
            self.output(layer, f"{name}.level{j}")
        self.output(head.get_submodule("scratch.output_conv1"), f"{name}.fused8x")
        self.output(head.get_submodule("scratch.output_conv2.2"), f"{name}.logits")
