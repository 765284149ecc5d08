"""Bad input is refused by name and row before anything is computed."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.splatting import RasterSettings, rasterise, render
from tests.worlds.random_gaussians import cameras, intrinsics, random_gaussians

FIELDS = ("means", "quat_wxyz", "scales", "opacities", "sh")


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("field", FIELDS)
def test_non_finite_gaussians_are_named(field: str, bad: float) -> None:
    scene = random_gaussians(10)
    value = getattr(scene, field).clone()
    value[7].view(-1)[-1] = bad
    name = "colours" if field == "sh" else field
    with pytest.raises(ValueError, match=f"{name} row 7 is not finite"):
        render(replace(scene, **{field: value}), Cameras(cameras(1), intrinsics(1, 8, 8), 8, 8))


def test_non_finite_cameras_are_named() -> None:
    poses, k = cameras(2), intrinsics(2, 8, 8).clone()
    poses[1, 0, 3] = math.nan
    with pytest.raises(ValueError, match="world_from_cam row 1 is not finite"):
        render(random_gaussians(3), Cameras(poses, k, 8, 8))
    k[1, 0, 0] = math.nan
    with pytest.raises(ValueError, match="intrinsics_px row 1 is not finite"):
        render(random_gaussians(3), Cameras(cameras(2), k, 8, 8))


def test_singular_and_skewed_intrinsics_are_refused() -> None:
    k = intrinsics(2, 8, 8).clone()
    k[1, 1, 1] = 0
    with pytest.raises(ValueError, match="intrinsics_px row 1 is singular"):
        render(random_gaussians(3), Cameras(cameras(2), k, 8, 8))
    k = intrinsics(2, 8, 8).clone()
    k[0, 0, 1] = 0.5
    with pytest.raises(ValueError, match="intrinsics_px row 0 is not"):
        render(random_gaussians(3), Cameras(cameras(2), k, 8, 8))


@pytest.mark.parametrize(("height", "width"), [(0, 8), (8, 0), (8, -1), (8, 40000)])
def test_impossible_image_sizes_are_refused(height: int, width: int) -> None:
    with pytest.raises(ValueError, match=f"image size {height} x {width}"):
        render(random_gaussians(3), Cameras(cameras(1), intrinsics(1, 8, 8), height, width))


def test_wrong_shapes_are_named() -> None:
    scene, k = random_gaussians(3), intrinsics(1, 8, 8)
    with pytest.raises(ValueError, match=r"scales has shape \(3, 2\), expected \(3, 3\)"):
        render(replace(scene, scales=scene.scales[:, :2]), Cameras(cameras(1), k, 8, 8))
    with pytest.raises(ValueError, match="5 coefficients"):
        render(replace(scene, sh=torch.zeros(3, 5, 3)), Cameras(cameras(1), k, 8, 8))
    with pytest.raises(ValueError, match=r"intrinsics_px has shape \(2, 3, 3\), expected \(1, 3, 3\)"):
        render(scene, Cameras(cameras(1), intrinsics(2, 8, 8), 8, 8))
    with pytest.raises(ValueError, match="world_from_cam has shape"):
        render(scene, Cameras(cameras(1)[0], k, 8, 8))
    with pytest.raises(ValueError, match="background has shape"):
        render(scene, Cameras(cameras(1), k, 8, 8), background=torch.zeros(4))


def test_zero_quaternion_and_mixed_dtypes_are_named() -> None:
    scene, k = random_gaussians(3), intrinsics(1, 8, 8)
    quats = scene.quat_wxyz.clone()
    quats[2] = 0
    with pytest.raises(ValueError, match="quat_wxyz row 2 has zero length"):
        render(replace(scene, quat_wxyz=quats), Cameras(cameras(1), k, 8, 8))
    with pytest.raises(ValueError, match=r"opacities is torch\.float64"):
        render(replace(scene, opacities=scene.opacities.double()), Cameras(cameras(1), k, 8, 8))


def test_bottom_row_of_the_view_matrix_is_checked() -> None:
    scene, view = random_gaussians(3), torch.eye(4)[None].clone()
    view[0, 3, 2] = 1
    with pytest.raises(ValueError, match="cam_from_world row 0 has a bottom row"):
        rasterise(
            scene.means, scene.quat_wxyz, scene.scales, scene.opacities, scene.sh, view, intrinsics(1, 8, 8), 8, 8
        )


@pytest.mark.parametrize(
    "changes",
    [
        {"near": 0.0},
        {"near": 2.0, "far": 1.0},
        {"eps2d": -1.0},
        {"max_alpha": 1.0},
        {"backend": "cuda"},
        {"threads": -1},
    ],
)
def test_meaningless_settings_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="RasterSettings"):
        RasterSettings(**changes)  # type: ignore[arg-type]


def test_backends_refuse_what_they_cannot_render() -> None:
    scene = random_gaussians(3, dtype=torch.float64)
    poses, k = cameras(1, dtype=torch.float64), intrinsics(1, 8, 8, dtype=torch.float64)
    with pytest.raises(ValueError, match="gsplat backend needs CUDA"):
        render(scene, Cameras(poses, k, 8, 8), settings=RasterSettings(backend="gsplat"))
