"""The image formation: both CPU backends against each other, against calculus and against symmetries of the problem."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians, concatenate
from sceneexpander.geometry.rigid import look_at, quat_wxyz_from_rotation, rigid_inverse, rotation_from_quat_wxyz
from sceneexpander.splatting import rasterise, render, render_normals
from tests.unit.splatting.backends import (
    BACKENDS,
    DIFFERENTIABLE,
    H,
    W,
    assert_same_pictures,
    needs_kernel,
    settings,
)
from tests.worlds.random_gaussians import cameras, intrinsics, random_gaussians


def one_gaussian(*, opacity: float = 0.9, sigma: float = 0.1, dtype: torch.dtype = torch.float32) -> Gaussians:
    return Gaussians(
        means=torch.tensor([[0.0, 0.0, 2.0]], dtype=dtype),
        quat_wxyz=torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=dtype),
        scales=torch.full((1, 3), sigma, dtype=dtype),
        opacities=torch.tensor([opacity], dtype=dtype),
        sh=torch.tensor([[[1.0, 0.2, -0.6]]], dtype=dtype),
        source_view=torch.zeros(1, dtype=torch.long),
        generated=torch.zeros(1, dtype=torch.bool),
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_gaussian_has_its_closed_form(backend: str) -> None:
    focal, sigma = 50.0, 0.1
    k = torch.tensor([[[focal, 0, 20.5], [0, focal, 15.5], [0, 0, 1]]])
    out = render(one_gaussian(sigma=sigma), Cameras(torch.eye(4)[None], k, 31, 41), settings=settings(backend))
    variance = (focal * sigma / 2.0) ** 2 + 0.3  # projected at depth 2, plus the blur
    y, x = torch.meshgrid(torch.arange(31.0) - 15, torch.arange(41.0) - 20, indexing="ij")
    expected = 0.9 * torch.exp(-(x * x + y * y) / (2 * variance))
    expected = torch.where(expected >= 1 / 255, expected, 0)
    torch.testing.assert_close(out.alpha[0], expected, atol=2e-6, rtol=0)  # float32 rounding of exp and the conic
    seen = expected > 0
    torch.testing.assert_close(out.depth[0][seen], torch.full_like(expected[seen], 2.0), atol=1e-5, rtol=0)
    colour = (0.5 + 0.28209479 * torch.tensor([1.0, 0.2, -0.6]))[:, None, None]
    torch.testing.assert_close(out.rgb[0], colour * expected, atol=2e-6, rtol=0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_nearer_gaussians_hide_farther_ones_and_the_background(backend: str) -> None:
    front, back = one_gaussian(opacity=0.8), one_gaussian(opacity=1.0)
    back = replace(back, means=back.means * 2, scales=back.scales * 2, generated=torch.ones(1, dtype=torch.bool))
    k = torch.tensor([[[50.0, 0, 20.5], [0, 50, 15.5], [0, 0, 1]]])
    background = torch.tensor([0.1, 0.2, 0.3])
    for order in ([front, back], [back, front]):
        out = render(
            concatenate(order),
            Cameras(torch.eye(4)[None], k, 31, 41),
            background=background,
            settings=settings(backend),
        )
        # centre pixel: weights 0.8 and 0.2 * 0.99 (alpha is capped), the rest is background
        torch.testing.assert_close(out.alpha[0, 15, 20], torch.tensor(0.998), atol=1e-6, rtol=0)
        torch.testing.assert_close(out.generated[0, 15, 20], torch.tensor(0.198 / 0.998), atol=1e-6, rtol=0)
        torch.testing.assert_close(out.depth[0, 15, 20], torch.tensor((1.6 + 0.792) / 0.998), atol=1e-5, rtol=0)
    torch.testing.assert_close(out.rgb[0, :, 0, 0], background, atol=1e-6, rtol=0)


@needs_kernel
def test_kernel_agrees_in_float64_precision_of_the_oracle() -> None:
    scene = random_gaussians(300, seed=3)
    double = replace(scene, **{name: getattr(scene, name).double() for name in DIFFERENTIABLE})
    poses, k = cameras(2), intrinsics(2, H, W)
    exact = render(double, Cameras(poses.double(), k.double(), H, W))
    ours = render(scene, Cameras(poses, k, H, W), settings=settings("cpu"))
    torch.testing.assert_close(ours.rgb.double(), exact.rgb, atol=2e-5, rtol=0)


@needs_kernel
@pytest.mark.parametrize("count", [500, 5003])  # in one and in several units of work
def test_kernel_images_do_not_depend_on_threads_or_bands(count: int) -> None:
    scene, poses, k = random_gaussians(count, seed=2), cameras(2), intrinsics(2, H, W)
    reference = render(scene, Cameras(poses, k, H, W), settings=settings("cpu", threads=1))
    for changes in (
        {"threads": 2},
        {"threads": 5},
        {"threads": 1, "band_bytes": 1},
        {"threads": 3, "band_bytes": 9000},
    ):
        picture = render(scene, Cameras(poses, k, H, W), settings=settings("cpu", **changes))
        assert_same_pictures(picture, reference, tolerance=0)


def test_oracle_does_not_depend_on_bands() -> None:
    scene, poses, k = random_gaussians(200, seed=2), cameras(1), intrinsics(1, H, W)
    whole = render(scene, Cameras(poses, k, H, W), settings=settings("torch"))
    banded = render(scene, Cameras(poses, k, H, W), settings=settings("torch", band_bytes=1))
    assert_same_pictures(whole, banded, tolerance=1e-6)  # sums are associated differently


@pytest.mark.parametrize("backend", BACKENDS)
def test_order_of_gaussians_does_not_matter(backend: str) -> None:
    scene, poses, k = random_gaussians(300, seed=4), cameras(2), intrinsics(2, H, W)
    shuffled = scene.select(torch.randperm(300, generator=torch.Generator().manual_seed(0)))
    a = render(scene, Cameras(poses, k, H, W), settings=settings(backend))
    b = render(shuffled, Cameras(poses, k, H, W), settings=settings(backend))
    assert_same_pictures(a, b, tolerance=0 if backend == "cpu" else 1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_moving_world_and_cameras_together_changes_nothing(backend: str) -> None:
    # Degree 0: higher harmonics would have to be rotated with the world.
    scene, poses, k = random_gaussians(300, seed=5, sh_coefficients=1), cameras(2), intrinsics(2, H, W)
    moved_from_world = look_at(
        torch.tensor([0.3, -0.2, 0.5]), torch.tensor([1.0, 0.4, 2.0]), torch.tensor([0.1, -1.0, 0.2])
    )
    rotation = moved_from_world[:3, :3]
    turned = rotation @ rotation_from_quat_wxyz(scene.quat_wxyz)
    moved = replace(
        scene,
        means=scene.means @ rotation.T + moved_from_world[:3, 3],
        quat_wxyz=quat_wxyz_from_rotation(turned),
    )
    a = render(scene, Cameras(poses, k, H, W), settings=settings(backend))
    b = render(moved, Cameras(moved_from_world @ poses, k, H, W), settings=settings(backend))
    difference = (a.rgb - b.rgb).abs()
    # Rounding moves means by about 1e-6 and may swap or cut single pairs (1/255 each): nearly all pixels are equal.
    assert difference.quantile(0.99) < 1e-4
    assert difference.max() < 2e-2


@pytest.mark.parametrize("backend", BACKENDS)
def test_splitting_a_gaussians_opacity_changes_nothing(backend: str) -> None:
    # alpha = 1 - (1 - a)(1 - b) only at one opacity, so compare at the mean, where exp(-sigma) is 1.
    whole = one_gaussian(opacity=0.75)
    half = replace(whole, opacities=torch.tensor([0.5]))
    k = torch.tensor([[[50.0, 0, 20.5], [0, 50, 15.5], [0, 0, 1]]])
    a = render(whole, Cameras(torch.eye(4)[None], k, 31, 41), settings=settings(backend))
    b = render(concatenate([half, half]), Cameras(torch.eye(4)[None], k, 31, 41), settings=settings(backend))
    torch.testing.assert_close(a.alpha[0, 15, 20], b.alpha[0, 15, 20], atol=1e-6, rtol=0)
    torch.testing.assert_close(a.rgb[0, :, 15, 20], b.rgb[0, :, 15, 20], atol=1e-6, rtol=0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_alpha_cap_is_a_parameter_and_stops_the_opacity_gradient(backend: str) -> None:
    k = torch.tensor([[[50.0, 0, 0.5], [0, 50, 0.5], [0, 0, 1]]])  # one pixel, at the mean
    for cap in (0.99, 0.999, 0.5):
        opacity = torch.tensor([1.0], requires_grad=True)
        scene = replace(one_gaussian(), opacities=opacity)
        out = render(scene, Cameras(torch.eye(4)[None], k, 1, 1), settings=settings(backend, max_alpha=cap))
        assert out.alpha.item() == pytest.approx(cap, abs=1e-6)
        (grad,) = torch.autograd.grad(out.alpha.sum(), opacity)
        assert grad.item() == 0


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("case", ["empty", "behind", "beyond far", "transparent"])
def test_nothing_to_see_gives_the_background_and_zero_gradients(backend: str, case: str) -> None:
    scene = random_gaussians(0 if case == "empty" else 20)
    poses = cameras(2)
    chosen = settings(backend, far=1.0) if case == "beyond far" else settings(backend)
    if case == "behind":
        poses = poses @ torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))  # turned around
    if case == "transparent":
        scene = replace(scene, opacities=torch.full((20,), 0.003))
    leaf = scene.means.clone().requires_grad_()
    out = render(
        replace(scene, means=leaf),
        Cameras(poses, intrinsics(2, H, W), H, W),
        background=torch.tensor([0.2, 0.4, 0.6]),
        settings=chosen,
    )
    assert torch.equal(out.rgb, torch.tensor([0.2, 0.4, 0.6])[:, None, None].expand(2, 3, H, W))
    assert out.alpha.abs().max() == out.depth.abs().max() == out.generated.abs().max() == 0
    (out.rgb.sum() + out.depth.sum()).backward()
    assert leaf.grad is not None
    assert not leaf.grad.any()


@pytest.mark.parametrize("backend", BACKENDS)
def test_screen_offsets_move_gaussians_and_receive_their_gradients(backend: str) -> None:
    scene, poses = random_gaussians(40, seed=6, dtype=torch.float32), cameras(1)
    k, view = intrinsics(1, H, W), rigid_inverse(cameras(1))
    gaussian = [getattr(scene, name) for name in DIFFERENTIABLE]
    offsets = torch.zeros(1, 40, 2, requires_grad=True)
    out = rasterise(*gaussian, view, k, H, W, screen_offsets=offsets, settings=settings(backend))
    (out.rgb**2).sum().backward()
    assert offsets.grad is not None
    hidden = out.radius_px[0] == 0
    assert not offsets.grad[0][hidden].any()
    assert offsets.grad[0][~hidden].any()
    # Moving every Gaussian by a whole pixel moves the picture.
    moved = rasterise(*gaussian, view, k, H, W, screen_offsets=torch.ones(1, 40, 2), settings=settings(backend))
    plain = render(scene, Cameras(poses, k, H, W), settings=settings(backend))
    torch.testing.assert_close(moved.rgb[0, :, 1:, 1:], plain.rgb[0, :, :-1, :-1], atol=2e-3, rtol=0)


@needs_kernel
def test_many_feature_channels_agree_between_backends() -> None:
    scene, view, k = random_gaussians(100, seed=7), rigid_inverse(cameras(1)), intrinsics(1, H, W)
    gaussian = [getattr(scene, name) for name in DIFFERENTIABLE]
    for count in (1, 2, 4, 9, 12):
        features = torch.randn(100, count, generator=torch.Generator().manual_seed(count))
        outputs = []
        for backend in ("cpu", "torch"):
            leaf = features.clone().requires_grad_()
            out = rasterise(*gaussian, view, k, H, W, features=leaf, settings=settings(backend))
            assert out.features is not None
            (out.features**2).sum().backward()
            outputs.append((out.features, leaf.grad))
        torch.testing.assert_close(outputs[0][0], outputs[1][0], atol=2e-5, rtol=0)
        torch.testing.assert_close(outputs[0][1], outputs[1][1], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_huge_gaussians_cover_everything_within_bounded_memory(backend: str) -> None:
    scene = random_gaussians(64, seed=8)
    scene = replace(scene, scales=scene.scales * 50)
    out = render(scene, Cameras(cameras(1), intrinsics(1, H, W), H, W), settings=settings(backend, band_bytes=20_000))
    assert out.alpha.min() > 0.9


@pytest.mark.parametrize("backend", BACKENDS)
def test_normals_face_the_camera(backend: str) -> None:
    # A flat Gaussian whose thin axis points away from the camera: its normal must be turned around.
    flat = replace(one_gaussian(), scales=torch.tensor([[0.5, 0.5, 0.001]]))
    k = torch.tensor([[[50.0, 0, 20.5], [0, 50, 15.5], [0, 0, 1]]])
    normals = render_normals(flat, Cameras(torch.eye(4)[None], k, 31, 41), settings=settings(backend))
    torch.testing.assert_close(normals[0, 15, 20], torch.tensor([0.0, 0.0, -1.0]))
