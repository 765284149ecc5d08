"""Every loss and its gradient against plain numpy loops in float64."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from sceneexpander.adaptation.config import AdaptConfig, DepthDistance
from sceneexpander.adaptation.losses import (
    LossTerms,
    ViewGeometry,
    anchor_loss,
    camera_distance,
    depth_distance,
    generation_loss,
    normal_distance,
)

VIEWS, H, W = 3, 4, 5


def _geometry(seed: int) -> ViewGeometry:
    g = torch.Generator().manual_seed(seed)
    normals = torch.nn.functional.normalize(torch.randn(VIEWS, H, W, 3, generator=g, dtype=torch.float64), dim=-1)
    return ViewGeometry(
        camera_vector=torch.randn(VIEWS, 9, generator=g, dtype=torch.float64),
        depth=torch.rand(VIEWS, H, W, generator=g, dtype=torch.float64) + 0.5,
        normals=normals,
    )


def _reference(student: ViewGeometry, target: ViewGeometry, weight_d: float, weight_n: float, huber: float) -> float:
    total = 0.0
    for v in range(VIEWS):
        p, q = student.camera_vector[v].numpy(), target.camera_vector[v].numpy().copy()
        if np.dot(p[3:7], q[3:7]) < 0:
            q[3:7] *= -1
        camera = 0.0
        for a, b in zip(p, q, strict=True):
            d = abs(a - b)
            camera += (0.5 * d * d / huber if d < huber else d - 0.5 * huber) / 9
        depth = normal = 0.0
        for y in range(H):
            for x in range(W):
                depth += abs(float(student.depth[v, y, x] - target.depth[v, y, x])) / (H * W)
                normal += (1 - float(student.normals[v, y, x] @ target.normals[v, y, x])) / (H * W)
        total += camera + weight_d * depth + weight_n * normal
    return total


@pytest.mark.parametrize("huber", [1.0, 0.3])
def test_anchor_and_generation_losses_equal_their_equations(huber: float) -> None:
    config = AdaptConfig(camera_huber=huber, alpha_depth=0.2, alpha_normal=0.3, beta_depth=1.1, beta_normal=0.7)
    student, target = _geometry(0), _geometry(1)
    assert float(anchor_loss(student, target, config).total) == pytest.approx(
        _reference(student, target, 0.2, 0.3, huber), rel=1e-12
    )
    assert float(generation_loss(student, target, config).total) == pytest.approx(
        _reference(student, target, 1.1, 0.7, huber), rel=1e-12
    )


@pytest.mark.parametrize("field", ["camera_vector", "depth", "normals"])
def test_gradients_equal_finite_differences_of_the_reference(field: str) -> None:
    config = AdaptConfig()
    student, target = _geometry(2), _geometry(3)
    leaf = getattr(student, field).clone().requires_grad_(True)
    parts = {name: getattr(student, name) for name in ("camera_vector", "depth", "normals")} | {field: leaf}
    anchor_loss(ViewGeometry(**parts), target, config).total.backward()
    step = 1e-6
    for flat in (0, 7, leaf.numel() - 1):
        values = []
        for sign in (1, -1):
            moved = leaf.detach().clone()
            moved.view(-1)[flat] += sign * step
            values.append(_reference(ViewGeometry(**{**parts, field: moved}), target, 0.2, 0.2, 1.0))
        assert float(leaf.grad.view(-1)[flat]) == pytest.approx((values[0] - values[1]) / (2 * step), abs=1e-7)


def test_targets_get_no_gradient() -> None:
    student, target = _geometry(4), _geometry(5)
    depth = target.depth.clone().requires_grad_(True)
    leaf = student.depth.clone().requires_grad_(True)
    teacher = ViewGeometry(camera_vector=target.camera_vector, depth=depth, normals=target.normals)
    learner = ViewGeometry(camera_vector=student.camera_vector, depth=leaf, normals=student.normals)
    generation_loss(learner, teacher, AdaptConfig()).total.backward()
    assert depth.grad is None
    assert leaf.grad is not None


def test_opposite_quaternions_are_the_same_camera() -> None:
    camera = _geometry(6).camera_vector
    flipped = camera.clone()
    flipped[:, 3:7] *= -1
    assert float(camera_distance(camera, flipped, 1.0).abs().max()) == 0


def test_all_distances_vanish_at_equality() -> None:
    g = _geometry(7)
    assert float(camera_distance(g.camera_vector, g.camera_vector, 1.0).max()) == 0
    assert float(depth_distance(g.depth, g.depth, DepthDistance.L1).max()) == 0
    # 1e-12: the scale-invariant error is smoothed by sqrt(1e-8) - 1e-4, equal up to rounding
    assert float(depth_distance(g.depth, g.depth, DepthDistance.SCALE_INVARIANT).abs().max()) < 1e-12
    assert float(normal_distance(g.normals, g.normals).abs().max()) < 1e-15


def test_scale_invariant_depth_ignores_scale_and_l1_does_not() -> None:
    g, other = _geometry(8), _geometry(9)
    plain = depth_distance(g.depth, other.depth, DepthDistance.SCALE_INVARIANT)
    scaled = depth_distance(3 * g.depth, other.depth, DepthDistance.SCALE_INVARIANT)
    torch.testing.assert_close(plain, scaled)
    assert not torch.allclose(
        depth_distance(g.depth, other.depth, DepthDistance.L1),
        depth_distance(3 * g.depth, other.depth, DepthDistance.L1),
    )


def test_scale_invariant_depth_is_the_deviation_of_the_log_ratio() -> None:
    g, other = _geometry(10), _geometry(11)
    ratio = np.log(g.depth.numpy()) - np.log(other.depth.numpy())
    expected = [math.sqrt(r.var() + 1e-8) - 1e-4 for r in ratio]
    np.testing.assert_allclose(depth_distance(g.depth, other.depth, DepthDistance.SCALE_INVARIANT).numpy(), expected)


def test_views_are_summed_and_pixels_averaged() -> None:
    student, target = _geometry(12), _geometry(13)
    config = AdaptConfig()
    whole = float(anchor_loss(student, target, config).total)
    parts = [float(anchor_loss(student.view(v, v + 1), target.view(v, v + 1), config).total) for v in range(VIEWS)]
    assert whole == pytest.approx(sum(parts), rel=1e-12)


def _written_out_gradients(
    student: ViewGeometry, target: ViewGeometry, weight_d: float, weight_n: float, huber: float, kind: DepthDistance
) -> dict[str, np.ndarray]:
    """The derivatives of the equations, worked out by hand."""
    p, q = student.camera_vector.numpy(), target.camera_vector.numpy().copy()
    q[:, 3:7] *= np.where((p[:, 3:7] * q[:, 3:7]).sum(1, keepdims=True) < 0, -1, 1)
    camera = np.clip((p - q) / huber, -1, 1) / 9
    d, e = student.depth.numpy(), target.depth.numpy()
    if kind is DepthDistance.L1:
        depth = np.sign(d - e) / (H * W)
    else:
        ratio = np.log(d) - np.log(e)
        mean = ratio.mean((1, 2), keepdims=True)
        variance = ((ratio - mean) ** 2).mean((1, 2), keepdims=True)
        depth = (ratio - mean) / (H * W * d * np.sqrt(variance + 1e-8))
    normals = -target.normals.numpy() / (H * W)
    return {"camera_vector": camera, "depth": weight_d * depth, "normals": weight_n * normals}


@pytest.mark.parametrize("kind", list(DepthDistance))
@pytest.mark.parametrize("huber", [1.0, 0.3])
@pytest.mark.parametrize("loss", [anchor_loss, generation_loss])
def test_every_gradient_equals_the_one_worked_out_by_hand(
    loss: Callable[..., LossTerms], huber: float, kind: DepthDistance
) -> None:
    config = AdaptConfig(
        camera_huber=huber, alpha_depth=0.2, alpha_normal=0.3, beta_depth=1.1, beta_normal=0.7, depth_distance=kind
    )
    weight_d, weight_n = (0.2, 0.3) if loss is anchor_loss else (1.1, 0.7)
    student, target = _geometry(20), _geometry(21)
    leaves = {
        name: getattr(student, name).clone().requires_grad_(True) for name in ("camera_vector", "depth", "normals")
    }
    loss(ViewGeometry(**leaves), target, config).total.backward()
    for name, expected in _written_out_gradients(student, target, weight_d, weight_n, huber, kind).items():
        np.testing.assert_allclose(leaves[name].grad.numpy(), expected, rtol=1e-11, atol=1e-14)


@pytest.mark.parametrize("kind", [*DepthDistance, None])
@pytest.mark.parametrize("scale", [1.0, 0.05])
def test_a_weight_of_three_is_the_pixel_three_times(kind: DepthDistance | None, scale: float) -> None:
    """And only the ratio of weights counts. ``None``: normals."""
    student, target = _geometry(30), _geometry(31)
    times = torch.tensor([[1, 3, 0, 2, 1]]).repeat(H, 1)
    weights = (scale * times.double()).expand(VIEWS, H, W)

    def repeated(values: torch.Tensor) -> torch.Tensor:
        return values.repeat_interleave(times[0], dim=2)

    if kind is None:
        plain = normal_distance(repeated(student.normals), repeated(target.normals))
        weighted = normal_distance(student.normals, target.normals, weights)
    else:
        plain = depth_distance(repeated(student.depth), repeated(target.depth), kind)
        weighted = depth_distance(student.depth, target.depth, kind, weights)
    torch.testing.assert_close(weighted, plain)


def test_weights_of_pixels_are_no_weights_of_the_camera() -> None:
    student, target = _geometry(32).view(0, 1), _geometry(33).view(0, 1)
    weights = torch.rand(1, H, W, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    plain = generation_loss(student, target, AdaptConfig())
    weighted = generation_loss(student, target, AdaptConfig(), weights)
    assert float(weighted.camera) == float(plain.camera)
    assert float(weighted.depth) != float(plain.depth)
    assert float(weighted.normal) != float(plain.normal)
