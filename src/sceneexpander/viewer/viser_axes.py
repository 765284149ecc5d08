"""Our conventions in viser's words: the one place where they are converted.

viser's cameras have our axes (x right, y down, z forward) and scalar-first quaternions. It differs in three ways: a lens is one vertical
angle and an aspect ratio with the principal point in the middle; pictures and colours are bytes with channels last; Gaussians are full
covariances.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from sceneexpander.geometry.gaussians import Gaussians, rgb_from_sh
from sceneexpander.geometry.rigid import quat_wxyz_from_rotation, rigid_inverse, rotation_from_quat_wxyz
from sceneexpander.geometry.similarity import Similarity
from sceneexpander.splatting.video import GENERATED_TINT
from sceneexpander.viewer.cameras import ShownCameras

LEAST_STD_PX = 0.8
TYPICAL_STD = 0.05  # its square is far from both ends of 16-bit floats, 6e-8 and 65504
TINT_STRENGTH = 0.45


@dataclass(frozen=True, slots=True, kw_only=True)
class ViserCamera:
    """Pose and lens of one view. A principal point away from the middle is lost: viser has no such lens."""

    wxyz: tuple[float, float, float, float]
    position: tuple[float, float, float]
    look_at: tuple[float, float, float]
    fov: float  # vertical, radians
    aspect: float  # of a pixel grid with square pixels: width over height, times fy over fx


@dataclass(frozen=True, slots=True, kw_only=True)
class ViserSplats:
    """Arguments of ``add_gaussian_splats``."""

    centers: NDArray[np.float32]
    covariances: NDArray[np.float32]
    rgbs: NDArray[np.float32]
    opacities: NDArray[np.float32]


def enlargement(gaussians: Gaussians) -> float:
    """By how much to enlarge a scene for viser, which sends covariances as 16-bit floats: those of small scenes would become zero.

    Typical Gaussians get a standard deviation of `TYPICAL_STD`, ten times thinner and a thousand times larger ones still fit.
    """
    if not len(gaussians):
        return 1.0
    return TYPICAL_STD / max(float(gaussians.scales.median()), torch.finfo(torch.float32).tiny)


def widen_gaussians(gaussians: Gaussians, cameras: ShownCameras) -> Gaussians:
    """Gaussians wide enough for viser to draw them where a window has about the resolution of the views.

    It leaves out those of which opacity times the determinant of the 2-D covariance (blurred by 0.3) is below a quarter of a pixel^4; a
    pixel of a view with a standard deviation of 0.4 is among them. The two wider axes therefore get at least `LEAST_STD_PX` pixels of
    the view that made the Gaussian; the thin one stays.
    """
    source = gaussians.source_view.clamp(0, len(cameras.view_ids) - 1)
    cam_from_world = rigid_inverse(cameras.world_from_cam)[source]
    depth = (cam_from_world[:, 2, :3] * gaussians.means).sum(-1) + cam_from_world[:, 2, 3]
    least = LEAST_STD_PX * depth.clamp(min=0) / cameras.intrinsics_px[source, 0, 0]
    thin = torch.nn.functional.one_hot(gaussians.scales.argmin(-1), 3).bool()
    return replace(gaussians, scales=torch.where(thin, gaussians.scales, gaussians.scales.maximum(least[:, None])))


def viser_camera(cameras: ShownCameras, view: int) -> ViserCamera:
    """One view; what it looks at lies ``focus`` ahead."""
    pose = cameras.world_from_cam[view].double()
    fx, fy = (float(cameras.intrinsics_px[view, i, i]) for i in (0, 1))
    w, x, y, z = quat_wxyz_from_rotation(pose[:3, :3]).tolist()
    return ViserCamera(
        wxyz=(w, x, y, z),
        position=_triple(pose[:3, 3]),
        look_at=_triple(pose[:3, 3] + float(cameras.focus[view]) * pose[:3, 2]),
        fov=2 * math.atan(cameras.height / (2 * fy)),
        aspect=cameras.width * fy / (cameras.height * fx),
    )


def viser_splats(
    gaussians: Gaussians, target_from_world: Similarity, *, tint: bool = False, opacity: float = 1.0
) -> ViserSplats:
    """Gaussians in the frame of the viewer, with their direction-independent colour.

    Args:
        gaussians: in the world frame of their reconstruction.
        target_from_world: to the frame of the viewer.
        tint: colour generated ones orange, as the provenance video does.
        opacity: factor of all opacities, in [0, 1].
    """
    axes = target_from_world.scale * target_from_world.rotation @ rotation_from_quat_wxyz(gaussians.quat_wxyz)
    shape = axes * gaussians.scales[:, None, :]
    colours = rgb_from_sh(gaussians.sh[:, 0]).clamp(0, 1)
    if tint:
        share = TINT_STRENGTH * gaussians.generated[:, None].to(colours)
        colours = colours * (1 - share) + colours.new_tensor(GENERATED_TINT) * share
    return ViserSplats(
        centers=_array(target_from_world.points(gaussians.means)),
        covariances=_array(shape @ shape.transpose(-1, -2)),
        rgbs=_array(colours),
        opacities=_array(gaussians.opacities[:, None] * opacity),
    )


def viser_picture(picture: Float[Tensor, "3 height width"]) -> UInt8[np.ndarray[Any, Any], "height width 3"]:
    """RGB bytes, channels last."""
    return (picture.clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()


def _array(value: Tensor) -> NDArray[np.float32]:
    return value.detach().cpu().float().numpy()


def _triple(value: Tensor) -> tuple[float, float, float]:
    x, y, z = value.tolist()
    return x, y, z
