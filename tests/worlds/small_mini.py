"""A small mini with inputs."""

from __future__ import annotations

import torch

from sceneexpander.geometry.priors import EVIDENCE_CHANNELS, Priors
from sceneexpander.geometry.rigid import rigid_from_parts, rotation_from_quat_wxyz
from sceneexpander.models.mini import Mini, MiniConfig

TINY = MiniConfig(
    work_px=64,
    width=16,
    attention_heads=1,
    stem_widths=(8, 16, 16),
    dpt_widths=(8, 8, 8, 8),
    features=8,
    head_width=8,
    camera_blocks=1,
    camera_gain=1.0,
)


def scene(views: int, height: int, width: int, seed: int = 0) -> tuple[torch.Tensor, Priors]:
    """Random pictures and plausible priors; the first camera is the world."""
    draw = torch.Generator().manual_seed(seed)
    quat = torch.nn.functional.normalize(
        torch.tensor([1.0, 0, 0, 0]) + 0.05 * torch.randn(views, 4, generator=draw), dim=-1
    )
    poses = rigid_from_parts(rotation_from_quat_wxyz(quat), 0.2 * torch.randn(views, 3, generator=draw))
    poses[0] = torch.eye(4)
    intrinsics = torch.tensor([[0.9 * width, 0, width / 2 + 1], [0, 0.9 * width, height / 2 - 1], [0, 0, 1]])
    evidence = torch.rand(views, len(EVIDENCE_CHANNELS), height, width, generator=draw)
    evidence[:, 0] = (evidence[:, 0] > 0.6).float()
    coarse = 1 + 2 * torch.rand(views, 1, height // 14, width // 14, generator=draw)
    depth = torch.nn.functional.interpolate(coarse, size=(height, width), mode="bilinear")[:, 0]
    priors = Priors(world_from_cam=poses, intrinsics_px=intrinsics.repeat(views, 1, 1), depth=depth, evidence=evidence)
    return torch.rand(views, 3, height, width, generator=draw), priors


def make_model(*, perturbed: bool = False, config: MiniConfig = TINY) -> Mini:
    """A new model with fixed initial values; ``perturbed``: with last layers that are not zero."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = Mini(config)
        if perturbed:
            with torch.no_grad():
                for parameter in model.parameters():
                    parameter.add_(0.02 * torch.randn_like(parameter))
    return model
