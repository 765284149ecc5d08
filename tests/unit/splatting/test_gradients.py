"""Gradients: of the oracle against calculus, of the kernel against the oracle, the same bits for any thread count."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.rigid import rigid_inverse
from sceneexpander.splatting import kernel_backend, rasterise, render
from tests.unit.splatting.backends import (
    DIFFERENTIABLE,
    H,
    W,
    assert_same_pictures,
    gradients,
    needs_kernel,
    settings,
)
from tests.worlds.random_gaussians import cameras, intrinsics, random_gaussians


@needs_kernel
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("sh_coefficients", [1, 4, 9, 16])
def test_kernel_agrees_with_the_torch_oracle(sh_coefficients: int, antialiased: bool) -> None:
    scene = random_gaussians(400, sh_coefficients=sh_coefficients)
    poses, k = cameras(2), intrinsics(2, H, W)
    pictures, slopes = [], []
    for backend in ("cpu", "torch"):
        chosen = settings(backend, antialiased=antialiased)
        pictures.append(render(scene, Cameras(poses, k, H, W), settings=chosen))
        slopes.append(gradients(scene, poses, chosen))
    assert pictures[0].alpha.mean() > 0.2
    assert_same_pictures(*pictures, tolerance=2e-5)  # the fixtures' tolerance for float32 images
    for name, expected in slopes[1].items():
        error = (slopes[0][name] - expected).norm() / expected.norm()
        assert error < 1e-4, f"{name}: relative L2 {error:.1e}"  # the fixtures' tolerance for float32 gradients


@needs_kernel
@pytest.mark.parametrize("build", ["v3", "v4", "plain"])
def test_every_build_draws_the_same(build: str, monkeypatch: pytest.MonkeyPatch) -> None:
    known = kernel_backend.BUILDS.get(torch.backends.cpu.get_cpu_capability(), ("plain",))
    kernel = kernel_backend.open_build(build) if build in known else None
    if kernel is None:
        pytest.skip(f"no {build} here")
    monkeypatch.setattr(kernel_backend, "load_kernel", lambda: kernel)
    scene, poses, k = random_gaussians(400, sh_coefficients=9), cameras(2), intrinsics(2, H, W)
    ours, exact = (render(scene, Cameras(poses, k, H, W), settings=settings(backend)) for backend in ("cpu", "torch"))
    assert_same_pictures(ours, exact, tolerance=2e-5)
    for (name, slope), expected in zip(
        gradients(scene, poses, settings("cpu")).items(),
        gradients(scene, poses, settings("torch")).values(),
        strict=True,
    ):
        assert (slope - expected).norm() < 1e-4 * expected.norm(), name


@pytest.mark.parametrize(("antialiased", "as_rgb"), [(False, False), (True, False), (False, True)])
def test_oracle_gradients_are_those_of_its_images(antialiased: bool, as_rgb: bool) -> None:
    torch.manual_seed(0)  # gradcheck itself draws
    scene = random_gaussians(4, seed=1, sh_coefficients=16, dtype=torch.float64)
    # Wide enough that no pixel is at the 1/255 edge of one of them: finite differences must not cross a decision.
    scene = replace(scene, scales=scene.scales * 0.3 + 0.8, opacities=scene.opacities * 0.5 + 0.2)
    view = rigid_inverse(cameras(1, dtype=torch.float64))
    k = intrinsics(1, 3, 2, dtype=torch.float64)
    features = torch.linspace(-1, 1, 8, dtype=torch.float64).reshape(1, 4, 2).clone()
    inputs = [getattr(scene, name) for name in DIFFERENTIABLE] + [view, features, torch.zeros(1, 4, 2).double()]
    if as_rgb:
        inputs[DIFFERENTIABLE.index("sh")] = scene.sh[:, 0].abs()

    def images(*tensors: Tensor) -> tuple[Tensor, ...]:
        *gaussian, camera, extra, offsets = tensors
        bottom = camera.new_tensor([[[0.0, 0.0, 0.0, 1.0]]])  # the bottom row is constant
        camera = torch.cat([camera[:, :3], bottom], 1)
        out = rasterise(
            *gaussian,
            camera,
            k,
            3,
            2,
            features=extra,
            screen_offsets=offsets,
            settings=settings("torch", antialiased=antialiased),
        )
        assert out.depth is not None
        assert out.features is not None
        return out.rgb, out.alpha, out.depth, out.features

    assert images(*inputs)[1].min() > 0.1
    assert torch.autograd.gradcheck(images, [t.detach().clone().requires_grad_() for t in inputs], atol=1e-6)


@needs_kernel
@pytest.mark.parametrize("count", [500, 5003])  # in one and in several units of work
def test_kernel_gradients_do_not_depend_on_threads_or_bands(count: int) -> None:
    scene, poses = random_gaussians(count, seed=2), cameras(2)
    reference = gradients(scene, poses, settings("cpu", threads=1))
    for changes in (
        {"threads": 2},
        {"threads": 5},
        {"threads": 1, "band_bytes": 1},
        {"threads": 3, "band_bytes": 9000},
    ):
        for name, value in gradients(scene, poses, settings("cpu", **changes)).items():
            assert torch.equal(value, reference[name]), f"{name} differs with {changes}"


@needs_kernel
def test_gradients_of_several_views_are_the_sum_of_each_and_of_none_zero() -> None:
    scene, poses, k = random_gaussians(300, seed=3), cameras(2), intrinsics(2, H, W)

    def gradient(views: slice) -> Tensor:
        leaf = scene.means.clone().requires_grad_()
        picture = render(replace(scene, means=leaf), Cameras(poses[views], k[views], H, W), settings=settings("cpu"))
        (grad,) = torch.autograd.grad((picture.rgb**2).sum(), leaf)
        return grad

    torch.testing.assert_close(gradient(slice(0, 2)), gradient(slice(0, 1)) + gradient(slice(1, 2)))
    assert not gradient(slice(0, 0)).any()


@needs_kernel
@pytest.mark.parametrize("as_rgb", [False, True])
def test_kernel_gradients_of_offsets_and_colours_are_the_oracles(as_rgb: bool) -> None:
    scene, view, k = random_gaussians(200, seed=9), rigid_inverse(cameras(2)), intrinsics(2, H, W)
    colours = scene.sh[:, 0].abs() if as_rgb else scene.sh
    found = []
    for backend in ("cpu", "torch"):
        leaves = [colours.clone().requires_grad_(), torch.zeros(2, 200, 2, requires_grad=True)]
        out = rasterise(
            scene.means,
            scene.quat_wxyz,
            scene.scales,
            scene.opacities,
            leaves[0],
            view,
            k,
            H,
            W,
            screen_offsets=leaves[1],
            settings=settings(backend),
        )
        found.append(torch.autograd.grad((out.rgb**2).sum() + out.alpha.sum(), leaves))
    for ours, exact in zip(*found, strict=True):
        assert (ours - exact).norm() < 1e-4 * exact.norm()
