"""Low level: tensors in, images out, one function for every backend."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.splatting.scene import RasterScene
from sceneexpander.splatting.settings import MIN_COVERAGE, RasterSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class RasterOutput:
    """Images of C views. Where nothing is drawn: the background, alpha 0, depth 0, features 0."""

    rgb: Float[Tensor, "view 3 height width"]
    alpha: Float[Tensor, "view height width"]
    depth: Float[Tensor, "view height width"] | None  # expected z-depth, scene units
    features: Float[Tensor, "view feature height width"] | None  # sums of weight * feature, like RGB without background
    radius_px: Float[Tensor, "view gaussian"]  # half side of the drawn box, 0 where not seen; not differentiable


def rasterise(
    means: Float[Tensor, "gaussian 3"],
    quat_wxyz: Float[Tensor, "gaussian 4"],
    scales: Float[Tensor, "gaussian 3"],
    opacities: Float[Tensor, "gaussian"],
    colours: Float[Tensor, "gaussian 3"] | Float[Tensor, "gaussian coefficient 3"],
    cam_from_world: Float[Tensor, "view 4 4"],
    intrinsics_px: Float[Tensor, "view 3 3"],
    height: int,
    width: int,
    *,
    features: Float[Tensor, "gaussian feature"] | Float[Tensor, "view gaussian feature"] | None = None,
    background: Float[Tensor, "3"] | Float[Tensor, "view 3"] | None = None,
    screen_offsets: Float[Tensor, "view gaussian 2"] | None = None,
    with_depth: bool = True,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 - frozen
) -> RasterOutput:
    """Render 3D Gaussians by EWA splatting, front to back; differentiable in everything but the intrinsics.

    Args:
        means: world frame.
        quat_wxyz: world_from_gaussian, any non-zero length.
        scales: standard deviations.
        opacities: in [0, 1].
        colours: RGB, or real SH coefficients of degree 0 to 3 (colour = max(0.5 + SH(direction), 0)).
        cam_from_world: rigid, OpenCV axes (the inverse of our usual ``world_from_cam``).
        intrinsics_px: without skew; treated as constants.
        features: further channels to blend like colours, per Gaussian or per view and Gaussian.
        background: seen through what is not covered; none is black.
        screen_offsets: added to the projected means (pixels). Pass zeros that require a gradient to receive the 2-D mean
            gradients that densification needs.
        with_depth: also render the expected depth.
        settings: numerical conventions and backend.

    Raises:
        ValueError: mis-shaped, non-finite or meaningless input, naming the tensor and the first bad row.
    """
    if features is not None and features.ndim == 2:
        features = features.expand(cam_from_world.shape[0], *features.shape)
    scene = RasterScene(
        means=means,
        quat_wxyz=quat_wxyz,
        scales=scales,
        opacities=opacities,
        colours=colours,
        cam_from_world=cam_from_world,
        intrinsics_px=intrinsics_px,
        height=height,
        width=width,
        features=features,
        screen_offsets=screen_offsets,
        with_depth=with_depth,
        settings=settings,
    )
    planes, alpha, radius_px = _run(scene)
    rgb = planes[:, :3]
    if background is not None:
        rgb = rgb + (1 - alpha)[:, None] * _background(background, scene)[:, :, None, None]
    depth = planes[:, 3] / alpha.clamp(min=MIN_COVERAGE) if with_depth else None
    extra = planes[:, 3 + int(with_depth) :] if features is not None else None
    return RasterOutput(rgb=rgb, alpha=alpha, depth=depth, features=extra, radius_px=radius_px)


def active_backend(scene_device: torch.device, dtype: torch.dtype, settings: RasterSettings) -> str:
    """Which backend ``auto`` means: gsplat on CUDA, the compiled kernel for float32 on the CPU where it exists, else torch."""
    if settings.backend != "auto":
        return settings.backend
    if scene_device.type == "cuda" and dtype == torch.float32:
        return "gsplat"
    if scene_device.type == "cpu" and dtype == torch.float32:
        from sceneexpander.splatting.kernel_backend import load_kernel

        return "cpu" if load_kernel() is not None else "torch"
    return "torch"


def _run(scene: RasterScene) -> tuple[Tensor, Tensor, Tensor]:
    backend = active_backend(scene.means.device, scene.means.dtype, scene.settings)
    if backend == "cpu":
        from sceneexpander.splatting.kernel_backend import rasterise_kernel

        return rasterise_kernel(scene)
    if backend == "gsplat":
        from sceneexpander.splatting.gsplat_backend import rasterise_gsplat

        return rasterise_gsplat(scene)
    from sceneexpander.splatting.torch_backend import rasterise_torch

    return rasterise_torch(scene)


def _background(background: Tensor, scene: RasterScene) -> Tensor:
    if tuple(background.shape) not in {(3,), (scene.views, 3)}:
        raise ValueError(f"background has shape {tuple(background.shape)}, expected (3,) or ({scene.views}, 3)")
    if not bool(torch.isfinite(background).all()):
        raise ValueError(f"background is not finite: {background.tolist()}")
    return background.to(scene.means).expand(scene.views, 3)
