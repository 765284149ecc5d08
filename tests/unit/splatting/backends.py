"""What the tests of several backends share."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.splatting import RasterSettings, Render, render
from sceneexpander.splatting.kernel_backend import load_kernel
from tests.worlds.random_gaussians import intrinsics

H, W = 43, 57  # no multiples of the tile size
needs_kernel = pytest.mark.skipif(load_kernel() is None, reason="no compiled kernel (no compiler at install)")
BACKENDS = [pytest.param("cpu", marks=needs_kernel), "torch"]
DIFFERENTIABLE = ("means", "quat_wxyz", "scales", "opacities", "sh")


def settings(backend: str, **changes: object) -> RasterSettings:
    return RasterSettings(backend=backend, **changes)  # type: ignore[arg-type]


def assert_same_pictures(a: Render, b: Render, tolerance: float) -> None:
    for field in fields(Render):
        # Depth is about 4 and a quotient by alpha, which is 1 - T to 6e-8: five times coarser where alpha is a few per cent.
        allowed = 5 * tolerance if field.name == "depth" else tolerance
        torch.testing.assert_close(getattr(a, field.name), getattr(b, field.name), atol=allowed, rtol=0)


def gradients(gaussians: Gaussians, world_from_cam: Tensor, chosen: RasterSettings) -> dict[str, Tensor]:
    leaves = {name: getattr(gaussians, name).detach().clone().requires_grad_() for name in DIFFERENTIABLE}
    poses = world_from_cam.clone().requires_grad_()
    picture = render(replace(gaussians, **leaves), Cameras(poses, intrinsics(len(poses), H, W), H, W), settings=chosen)
    weights = torch.linspace(-1, 2, W)
    loss = (picture.rgb**2 * weights).sum() + (picture.alpha * weights).sum() + (picture.generated * weights).sum()
    # Expected depth of barely covered pixels is a quotient of roundings: only where there is something.
    (loss + (picture.depth * weights)[picture.alpha > 0.1].sum()).backward()
    return {name: leaf.grad for name, leaf in leaves.items()} | {"world_from_cam": poses.grad}  # type: ignore[dict-item]
