"""The adapter to gsplat, without a GPU: what it hands over means what gsplat says, and what comes back lands where it belongs."""

from __future__ import annotations

import inspect
import sys
import types
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from sceneexpander.geometry.rigid import rigid_inverse
from sceneexpander.splatting import RasterSettings
from sceneexpander.splatting.gsplat_backend import rasterise_gsplat
from sceneexpander.splatting.scene import RasterScene
from sceneexpander.splatting.torch_backend import rasterise_torch
from tests.worlds.random_gaussians import cameras, intrinsics, random_gaussians

H, W = 20, 30


class OnCuda:
    """A scene whose tensors claim to be on the GPU: all that the adapter asks before it calls gsplat."""

    def __init__(self, scene: RasterScene) -> None:
        self._scene = scene

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._scene, name)
        return _Claims(value) if name == "means" else value


class _Claims(Tensor):
    @staticmethod
    def __new__(cls, value: Tensor) -> _Claims:
        return value.as_subclass(cls)

    device = types.SimpleNamespace(type="cuda")  # type: ignore[assignment]


def stand_in(seen: dict[str, Any]) -> types.ModuleType:
    """``gsplat.rasterization`` as its documentation describes it, drawn by the oracle."""

    def rasterization(**given: Any) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        seen.update(given)
        colours = given["colors"]  # (C, N, D): per view, any number of channels
        scene = RasterScene(
            means=given["means"].as_subclass(Tensor),
            quat_wxyz=given["quats"],
            scales=given["scales"],
            opacities=given["opacities"],
            colours=torch.zeros_like(given["scales"]),
            cam_from_world=given["viewmats"],
            intrinsics_px=given["Ks"],
            height=given["height"],
            width=given["width"],
            features=colours.as_subclass(Tensor),
            with_depth=False,
            settings=RasterSettings(backend="torch", max_alpha=0.999, eps2d=given["eps2d"], near=given["near_plane"]),
        )
        planes, alpha, radius = rasterise_torch(scene)
        means2d = torch.zeros(len(planes), scene.count, 2, requires_grad=True)
        info = {"means2d": means2d, "radii": radius[..., None].expand(-1, -1, 2)}
        images = (
            planes[:, 3:].movedim(1, -1) + means2d.sum()
        )  # depends on the 2-D means, so that their gradient arrives
        return images, alpha[..., None], info

    module = types.ModuleType("gsplat")
    module.rasterization = rasterization  # type: ignore[attr-defined]
    return module


def scene_of(coefficients: int | None) -> RasterScene:
    gaussians = random_gaussians(60, sh_coefficients=coefficients or 1)
    return RasterScene(
        means=gaussians.means,
        quat_wxyz=gaussians.quat_wxyz,
        scales=gaussians.scales,
        opacities=gaussians.opacities,
        colours=gaussians.sh if coefficients else gaussians.sh[:, 0].abs(),
        cam_from_world=rigid_inverse(cameras(2)),
        intrinsics_px=intrinsics(2, H, W).contiguous(),
        height=H,
        width=W,
        features=torch.rand(2, 60, 2, generator=torch.Generator().manual_seed(1)),
        screen_offsets=torch.zeros(2, 60, 2, requires_grad=True),
        settings=RasterSettings(max_alpha=0.999),
    )


@pytest.mark.parametrize("coefficients", [None, 4])
def test_it_draws_what_the_oracle_draws(coefficients: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, Any] = {}
    monkeypatch.setitem(sys.modules, "gsplat", stand_in(seen))
    scene = scene_of(coefficients)
    planes, alpha, radius = rasterise_gsplat(OnCuda(scene))  # type: ignore[arg-type]
    exact, exact_alpha, exact_radius = rasterise_torch(replace(scene, screen_offsets=None))
    assert planes.shape == (2, 6, H, W)  # RGB, depth, two features
    torch.testing.assert_close(planes.detach().as_subclass(Tensor), exact, atol=1e-5, rtol=0)
    torch.testing.assert_close(alpha.detach().as_subclass(Tensor), exact_alpha, atol=1e-6, rtol=0)
    assert torch.equal(radius.as_subclass(Tensor), exact_radius)
    planes.sum().backward()
    assert scene.screen_offsets is not None
    assert scene.screen_offsets.grad is not None, "densification gets gsplat's own 2-D mean gradients"
    assert bool((scene.screen_offsets.grad != 0).all())


def test_gsplat_knows_every_argument(monkeypatch: pytest.MonkeyPatch) -> None:
    gsplat = pytest.importorskip("gsplat", reason="pip install gsplat==1.5.3")
    known = set(inspect.signature(gsplat.rasterization).parameters)
    seen: dict[str, Any] = {}
    monkeypatch.setitem(sys.modules, "gsplat", stand_in(seen))
    rasterise_gsplat(OnCuda(scene_of(1)))  # type: ignore[arg-type]
    assert set(seen) <= known
