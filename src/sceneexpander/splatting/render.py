"""High level: a Gaussian scene and cameras in our conventions -> pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.geometry.rigid import rotation_from_quat_wxyz
from sceneexpander.splatting.rasterise import rasterise
from sceneexpander.splatting.settings import MIN_COVERAGE, RasterSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class Render:
    """What C cameras see of a scene."""

    rgb: Float[Tensor, "view 3 height width"]  # not clamped above 1
    alpha: Float[Tensor, "view height width"]
    depth: Float[Tensor, "view height width"]  # expected z-depth, scene units; 0 where nothing is drawn
    generated: Float[Tensor, "view height width"]  # share of alpha that generated Gaussians contribute, in [0, 1]


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Float[Tensor, "3"] | Float[Tensor, "view 3"] | None = None,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 - frozen
) -> Render:
    """Render a scene; differentiable in the Gaussians and the camera poses (intrinsics are constants).

    Opacities are compensated for the screen blur as the scene says (`Gaussians.antialiased`), whatever the settings do.

    Raises:
        ValueError: bad input, naming the tensor and the first bad row (see `rasterise`).
    """
    out = rasterise(
        gaussians.means,
        gaussians.quat_wxyz,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        _cam_from_world(cameras),
        cameras.intrinsics_px,
        cameras.height,
        cameras.width,
        features=gaussians.generated.to(gaussians.means.dtype)[:, None],
        background=background,
        settings=replace(settings, antialiased=gaussians.antialiased),
    )
    assert out.depth is not None and out.features is not None  # noqa: S101, PT018 - both were asked for
    generated = out.features[:, 0] / out.alpha.clamp(min=MIN_COVERAGE)
    return Render(rgb=out.rgb, alpha=out.alpha, depth=out.depth, generated=generated)


def render_normals(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 - frozen
) -> Float[Tensor, "view height width 3"]:
    """Normals of the rendered surface: camera frame, unit, facing the camera; 0 where nothing is drawn.

    A Gaussian's normal is its shortest axis, turned to the camera; pixels blend them like colours and normalise.
    """
    cam_from_world = _cam_from_world(cameras)
    shortest = gaussians.scales.argmin(-1)
    axes = rotation_from_quat_wxyz(gaussians.quat_wxyz)
    normals_world = axes.gather(-1, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
    normals_cam = torch.einsum("vij,gj->vgi", cam_from_world[:, :3, :3], normals_world)
    points_cam = (
        torch.einsum("vij,gj->vgi", cam_from_world[:, :3, :3], gaussians.means) + cam_from_world[:, None, :3, 3]
    )
    away = (normals_cam * points_cam).sum(-1, keepdim=True) > 0
    out = rasterise(
        gaussians.means,
        gaussians.quat_wxyz,
        gaussians.scales,
        gaussians.opacities,
        torch.zeros_like(gaussians.means),
        cam_from_world,
        cameras.intrinsics_px,
        cameras.height,
        cameras.width,
        features=torch.where(away, -normals_cam, normals_cam),
        with_depth=False,
        settings=replace(settings, antialiased=gaussians.antialiased),
    )
    assert out.features is not None  # noqa: S101 - asked for
    return torch.nn.functional.normalize(out.features.movedim(1, -1), dim=-1)


def _cam_from_world(cameras: Cameras) -> Tensor:
    world_from_cam = cameras.world_from_cam
    finite = torch.isfinite(world_from_cam).flatten(1).all(1)
    if not bool(finite.all()):
        row = int((~finite).nonzero()[0, 0])
        raise ValueError(f"world_from_cam row {row} is not finite: {world_from_cam[row].flatten().tolist()}")
    return cameras.cam_from_world
