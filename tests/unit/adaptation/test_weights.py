import pytest
import torch

from sceneexpander.adaptation import weights as ops
from sceneexpander.adaptation.config import DriftForm


def _tensors(seed: int) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return [torch.randn(shape, generator=g) for shape in ((300, 40), (7,), (1, 2, 3, 50), ())]


def test_ema_equals_its_closed_form() -> None:
    teacher, mu = _tensors(0), 0.9
    start = [t.clone() for t in teacher]
    students = [_tensors(seed) for seed in range(1, 6)]
    for student in students:
        ops.ema_update(teacher, student, mu)
    for i, value in enumerate(teacher):
        closed = mu**5 * start[i] + sum((1 - mu) * mu ** (4 - k) * s[i] for k, s in enumerate(students))
        torch.testing.assert_close(value, closed, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("rate", [1e-3, 0.05, 0.5])
def test_restoration_hits_its_rate_and_returns_exact_values(rate: float) -> None:
    start, weights = _tensors(0), _tensors(1)
    before = [w.clone() for w in weights]
    count = sum(w.numel() for w in weights)
    restored = sum(
        ops.restore([w.copy_(b) for w, b in zip(weights, before, strict=True)], start, rate, seed=4, step=s)
        for s in range(20)
    )
    sigma = (rate * (1 - rate) / (20 * count)) ** 0.5
    assert abs(restored / (20 * count) - rate) <= 3 * sigma
    for w, b, s in zip(weights, before, start, strict=True):
        changed = w != b
        assert torch.equal(w[changed], s[changed]), "a changed element is exactly theta_0"


def test_restoration_of_everything_and_of_nothing() -> None:
    start, weights = _tensors(0), _tensors(1)
    assert ops.restore(weights, start, 0.0, seed=0, step=1) == 0
    assert ops.restore(weights, start, 1.0, seed=0, step=1) == sum(w.numel() for w in weights)
    assert all(torch.equal(w, s) for w, s in zip(weights, start, strict=True))


@pytest.mark.parametrize("form", list(DriftForm))
def test_the_drift_gradient_is_that_of_autograd(form: DriftForm) -> None:
    start = _tensors(0)
    weights = [w.requires_grad_(True) for w in _tensors(1)]
    total = sum(((w - s) ** 2).sum() for w, s in zip(weights, start, strict=True))
    if form is DriftForm.MEAN:
        total = total / sum(w.numel() for w in weights)
    (0.3 * total).backward()
    gradients = [torch.ones_like(w) for w in weights]
    with torch.no_grad():
        ops.add_drift_gradient(weights, gradients, start, 0.3, form)
        torch.testing.assert_close(ops.drift_squared(weights, start, form), total.detach())
    for ours, w in zip(gradients, weights, strict=True):
        torch.testing.assert_close(ours - 1, w.grad, atol=1e-6, rtol=1e-5)
