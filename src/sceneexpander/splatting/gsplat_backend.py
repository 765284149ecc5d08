"""gsplat on CUDA behind the same interface.

Release 1.5.3 has its alpha cap (0.999) and the floor of its antialiasing factor (0) built in; differences are logged once.
Colours are evaluated here, so that RGB, depth and features are blended in one pass.
"""

from __future__ import annotations

import functools
import logging

import torch
from torch import Tensor

from sceneexpander.errors import UserError
from sceneexpander.splatting.scene import RasterScene
from sceneexpander.splatting.torch_backend import shade

logger = logging.getLogger(__name__)

GSPLAT_MAX_ALPHA = 0.999  # of release 1.5.3


def rasterise_gsplat(scene: RasterScene) -> tuple[Tensor, Tensor, Tensor]:
    """(planes (C,channels,H,W), alpha (C,H,W), radius_px (C,N)); CUDA float32 tensors."""
    if scene.means.device.type != "cuda":
        raise ValueError(f"the gsplat backend needs CUDA tensors, got {scene.means.device}")
    try:
        from gsplat import rasterization
    except ImportError as error:
        raise UserError(
            "gsplat is not installed", fix="pip install 'sceneexpander[gpu]' or use backend 'torch'"
        ) from error
    settings = scene.settings
    _mention_alpha_cap(settings.max_alpha)
    images, alphas, info = rasterization(
        means=scene.means,
        quats=scene.quat_wxyz,
        scales=scene.scales,
        opacities=scene.opacities,
        colors=torch.stack([_planes(scene, view) for view in range(scene.views)]),
        viewmats=scene.cam_from_world,
        Ks=scene.intrinsics_px.detach(),
        width=scene.width,
        height=scene.height,
        near_plane=settings.near,
        far_plane=settings.far,
        eps2d=settings.eps2d,
        rasterize_mode="antialiased" if settings.antialiased else "classic",
        packed=False,
    )
    if scene.screen_offsets is not None and scene.screen_offsets.requires_grad:
        # gsplat has no input to add offsets to: hand its own 2-D mean gradients to the tensor that asks for them.
        info["means2d"].register_hook(functools.partial(_deliver, scene.screen_offsets))
    radii = info["radii"].to(images.dtype)
    return images.movedim(-1, 1), alphas[..., 0], radii.amax(-1) if radii.ndim == 3 else radii


def _planes(scene: RasterScene, view: int) -> Tensor:
    camera = scene.cam_from_world[view]
    planes = [shade(scene.means, scene.colours, camera) if scene.colours.ndim == 3 else scene.colours]
    if scene.with_depth:
        planes.append((scene.means @ camera[2, :3] + camera[2, 3])[:, None])
    if scene.features is not None:
        planes.append(scene.features[view])
    return torch.cat(planes, -1)


def _deliver(screen_offsets: Tensor, gradient: Tensor) -> None:
    held = screen_offsets.grad
    screen_offsets.grad = gradient.detach().clone() if held is None else held + gradient.detach()


@functools.cache
def _mention_alpha_cap(max_alpha: float) -> None:
    if max_alpha != GSPLAT_MAX_ALPHA:
        logger.warning("gsplat caps alpha at %g, not at the %g asked for", GSPLAT_MAX_ALPHA, max_alpha)
