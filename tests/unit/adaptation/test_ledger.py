"""The update of the weights: every part of it against its formula, written out."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from sceneexpander.adaptation import ledger as ledgers
from sceneexpander.adaptation.config import AdaptConfig, DriftForm, EngineConfig, MomentsForm
from sceneexpander.adaptation.ledger import WeightLedger, restore, teacher_of
from sceneexpander.adaptation.moments import (
    BLOCK,
    FIRST_ROOT,
    SECOND_ROOT,
    ByteMoments,
    FullMoments,
    _compress,
    _expand,
)

SHAPES = ((300, 40), (7,), (1, 2, 3, 50), (), (256, 2))
PLAIN = AdaptConfig(learning_rate=1e-2, restore_interval=0, lambda_reg=0.0)


class Bag(nn.Module):
    """Parameters without a purpose."""

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        draw = torch.Generator().manual_seed(seed)
        self.items = nn.ParameterList([nn.Parameter(torch.randn(shape, generator=draw)) for shape in SHAPES])

    def give_gradients(self, seed: int, only: tuple[int, ...] = tuple(range(len(SHAPES)))) -> list[torch.Tensor]:
        draw = torch.Generator().manual_seed(seed)
        made = [torch.randn(shape, generator=draw) for shape in SHAPES]
        for index in only:
            self.items[index].grad = made[index].clone()
        return made

    def numbers(self) -> list[torch.Tensor]:
        return [p.detach().clone() for p in self.items]


def _ledger(config: AdaptConfig = PLAIN, seed: int = 0) -> tuple[Bag, Bag, WeightLedger]:
    bag = Bag()
    teacher = teacher_of(bag)
    return bag, teacher, WeightLedger(bag, teacher, config, seed=seed)


@pytest.fixture(params=[1 << 18, 100], ids=["one bucket", "many buckets"], autouse=True)
def bucket_elements(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ledgers.BUCKET_ELEMENTS, "cpu", request.param)


@pytest.mark.parametrize("form", list(DriftForm))
def test_student_and_drift_follow_torchs_own_adamw_on_the_penalised_loss(form: DriftForm) -> None:
    config = replace(PLAIN, lambda_reg=0.05, drift=form, weight_decay=0.1)
    bag, _, ledger = _ledger(config)
    start = bag.numbers()
    count = sum(p.numel() for p in start)
    mirror = [p.double().requires_grad_(True) for p in start]
    optimiser = torch.optim.AdamW(mirror, lr=config.learning_rate, weight_decay=config.weight_decay)
    for step in range(1, 6):
        gradients = bag.give_gradients(step)
        optimiser.zero_grad()
        drift = sum(((w - s) ** 2).sum() for w, s in zip(mirror, start, strict=True))
        scale = 1 if form is DriftForm.SUM else count
        linear = sum((w * g).sum() for w, g in zip(mirror, gradients, strict=True))
        (linear + config.lambda_reg * drift / scale).backward()
        norm = float(torch.stack([w.grad.norm() for w in mirror]).norm())
        done = ledger.update(step)
        optimiser.step()
        assert done.drift == pytest.approx(float(drift.detach()), rel=1e-4, abs=1e-9)
        assert done.gradient == pytest.approx(norm, rel=1e-5)
    for ours, exact in zip(bag.numbers(), mirror, strict=True):
        torch.testing.assert_close(ours, exact.detach().float(), atol=2e-6, rtol=1e-5)
    assert ledger.adapted == count


def test_the_teacher_equals_its_closed_form() -> None:
    bag, teacher, ledger = _ledger(replace(PLAIN, ema_momentum=0.9))
    start, students = bag.numbers(), []
    for step in range(1, 6):
        bag.give_gradients(step)
        ledger.update(step)
        students.append(bag.numbers())
    for i, value in enumerate(teacher.numbers()):
        closed = 0.9**5 * start[i] + sum(0.1 * 0.9 ** (4 - k) * s[i] for k, s in enumerate(students))
        torch.testing.assert_close(value, closed, atol=1e-6, rtol=1e-6)


def test_the_teacher_is_updated_before_the_student_is_restored() -> None:
    config = replace(PLAIN, ema_momentum=0.5, restore_interval=1, restore_rate=1.0)
    bag, teacher, ledger = _ledger(config)
    start = bag.numbers()
    bag.give_gradients(1)
    ledger.update(1)
    assert all(torch.equal(p, s) for p, s in zip(bag.numbers(), start, strict=True)), "all of it was restored"
    moved = [(t - s).abs().max() for t, s in zip(teacher.numbers(), start, strict=True)]
    assert min(moved) > 1e-3, "the teacher saw the student as it was before"


@pytest.mark.parametrize("rate", [1e-3, 0.05, 0.5])
def test_restoration_hits_its_rate_and_returns_exact_values(rate: float) -> None:
    draw = torch.Generator().manual_seed(1)
    start, before = torch.randn(12_000, generator=draw), torch.randn(12_000, generator=draw)
    restored = 0
    for _ in range(20):
        weights = before.clone()
        count = int(restore(weights, start, rate, draw))
        changed = weights != before
        assert int(changed.sum()) == count
        assert torch.equal(weights[changed], start[changed]), "a changed element is exactly theta_0"
        restored += count
    sigma = (rate * (1 - rate) / (20 * 12_000)) ** 0.5
    assert abs(restored / (20 * 12_000) - rate) <= 3 * sigma


def test_restoration_reaches_every_tensor_every_k_steps() -> None:
    bag, _, ledger = _ledger(replace(PLAIN, restore_interval=2, restore_rate=1.0))
    start = bag.numbers()
    counts = []
    for step in (1, 2, 3):
        bag.give_gradients(step)
        counts.append(ledger.update(step).restored)
        equal = [torch.equal(p, s) for p, s in zip(bag.numbers(), start, strict=True)]
        assert equal == [step == 2] * len(SHAPES)
    assert counts == [0, sum(p.numel() for p in start), 0]


def test_parameters_without_a_gradient_are_left_alone_and_shared() -> None:
    bag, teacher, ledger = _ledger(replace(PLAIN, weight_decay=0.5))
    before = bag.numbers()
    bag.give_gradients(1, only=(0, 3))
    ledger.update(1)
    for index, (old, new) in enumerate(zip(before, bag.numbers(), strict=True)):
        assert torch.equal(old, new) == (index not in (0, 3))
        shared = bag.items[index].data_ptr() == teacher.items[index].data_ptr()
        assert shared == (index not in (0, 3)), "the teacher has numbers of its own only where they change"
    bag.give_gradients(2, only=(0, 1, 3))
    ledger.update(2)
    assert not torch.equal(bag.numbers()[1], before[1]), "a late gradient is taken in"


def test_buckets_are_views_that_state_dicts_can_change() -> None:
    bag, _, ledger = _ledger()
    bag.give_gradients(1)
    ledger.update(1)
    bag.load_state_dict({name: torch.zeros_like(value) for name, value in bag.state_dict().items()})
    assert all(float(bucket.student.abs().sum()) == 0 for bucket in ledger.buckets)


@pytest.mark.parametrize("moments", list(MomentsForm))
def test_a_reloaded_ledger_goes_on_with_the_same_bits(moments: MomentsForm) -> None:
    config = replace(PLAIN, engine=EngineConfig(moments=moments), restore_interval=2, restore_rate=0.1, lambda_reg=0.1)
    bag, teacher, ledger = _ledger(config)
    for step in (1, 2, 3):
        bag.give_gradients(step)
        ledger.update(step)
    state = [(names, {k: v.clone() for k, v in tensors.items()}) for names, tensors in ledger.state()]
    other, other_teacher, resumed = _ledger(config)
    resumed.load(state)
    for step in (4, 5):
        for one, book in ((bag, ledger), (other, resumed)):
            one.give_gradients(step)
            book.update(step)
    for one, two in ((bag, other), (teacher, other_teacher)):
        assert all(torch.equal(a, b) for a, b in zip(one.numbers(), two.numbers(), strict=True))


def test_drift_by_module_is_the_norm_of_the_change() -> None:
    bag, _, ledger = _ledger()
    start = bag.numbers()
    bag.give_gradients(1)
    ledger.update(1)
    change = [(p - s) for p, s in zip(bag.numbers(), start, strict=True)]
    found = ledger.drift_by_module(2)
    assert found == pytest.approx({f"items.{i}": float(c.norm()) for i, c in enumerate(change)}, rel=1e-5)
    whole = float(torch.cat([c.flatten() for c in change]).norm())
    assert ledger.drift_by_module(1) == {"items": pytest.approx(whole, rel=1e-5)}


def test_half_precision_masters_are_refused() -> None:
    bag = Bag().half()
    with pytest.raises(ValueError, match="must be float32"):
        WeightLedger(bag, teacher_of(bag), PLAIN, seed=0)


def test_bytes_keep_moments_over_many_orders_of_magnitude() -> None:
    draw = torch.Generator().manual_seed(0)
    values = torch.exp(-6 * torch.rand(BLOCK * 4, generator=draw))  # within 1 : 400 of each block's largest
    signed = values * torch.sign(torch.randn(values.shape, generator=draw))
    for power, original, dtype in ((SECOND_ROOT, values, torch.uint8), (FIRST_ROOT, signed, torch.int8)):
        codes = torch.zeros(values.numel(), dtype=dtype)
        tries = []
        for _ in range(400):
            scale = _compress(original, codes, power, draw)
            tries.append(_expand(codes, scale, power))
        once, mean = tries[0], torch.stack(tries).mean(0)
        assert float(((once - original) / original).abs().max()) < (0.07 if power == SECOND_ROOT else 0.2)
        assert float(((mean - original) / original).abs().max()) < 0.05, "random rounding is right on average"


def test_the_second_moment_of_a_weight_with_a_gradient_is_never_nothing() -> None:
    values = torch.tensor([1.0, 1e-30, 0.0]).repeat(BLOCK)[:BLOCK]
    codes = torch.zeros(BLOCK, dtype=torch.uint8)
    _compress(values, codes, SECOND_ROOT, torch.Generator().manual_seed(0))
    assert ((codes > 0) == (values > 0)).all()


def test_eight_bit_moments_follow_float32_ones_closely() -> None:
    draw = torch.Generator().manual_seed(3)
    weights = [torch.zeros(4096), torch.zeros(4096)]
    moments = (FullMoments(weights[0]), ByteMoments(weights[1], seed=5))
    direction = torch.randn(4096, generator=draw)
    size = torch.exp(torch.randn(4096, generator=draw))  # gradients of different sizes in one block
    for _ in range(200):
        gradient = size * (direction + torch.randn(4096, generator=draw))
        for weight, moment in zip(weights, moments, strict=True):
            moment.update(weight, gradient.clone(), rate=1e-3, decay=0.0)
    full, byte = weights
    assert float((byte - full).norm() / full.norm()) < 0.06
    assert float(torch.nn.functional.cosine_similarity(byte, full, dim=0)) > 0.998
    kept = sum(value.numel() * value.element_size() for value in moments[1].state().values())
    assert kept < 0.27 * sum(value.numel() * value.element_size() for value in moments[0].state().values())


@pytest.mark.parametrize("form", list(MomentsForm))
def test_a_parameter_without_a_gradient_stays_whatever_its_neighbours_do(form: MomentsForm) -> None:
    """In torch's AdamW a step counts for those that have a gradient only."""
    config = replace(PLAIN, weight_decay=0.1, engine=EngineConfig(moments=form))
    bag, teacher, ledger = _ledger(config)
    mirror = [p.clone().requires_grad_(True) for p in bag.numbers()]
    optimiser = torch.optim.AdamW(mirror, lr=config.learning_rate, weight_decay=config.weight_decay)
    everything = tuple(range(len(SHAPES)))
    for step, only in enumerate((everything, (0, 3), everything, (1, 4), everything), start=1):
        before, taught = bag.numbers(), teacher.numbers()
        gradients = bag.give_gradients(step, only=only)
        for index, parameter in enumerate(mirror):
            parameter.grad = gradients[index].clone() if index in only else None
        ledger.update(step)
        optimiser.step()
        for index, (old, new) in enumerate(zip(before, bag.numbers(), strict=True)):
            assert torch.equal(old, new) == (index not in only)
        momentum = config.ema_momentum
        for old, new, student in zip(taught, teacher.numbers(), bag.numbers(), strict=True):
            torch.testing.assert_close(new, momentum * old + (1 - momentum) * student, atol=1e-6, rtol=0)
    assert {name for bucket in ledger.buckets for name in bucket.names} == {f"items.{i}" for i in everything}
    if form is MomentsForm.FP32:
        for ours, exact in zip(bag.numbers(), mirror, strict=True):
            torch.testing.assert_close(ours, exact.detach(), atol=2e-6, rtol=1e-5)


def test_a_split_ledger_is_resumed_as_it_was() -> None:
    ledgers_of = []
    for resumed in (False, True):
        bag, teacher, ledger = _ledger()
        for step, only in enumerate(((0, 1, 2, 3, 4), (0, 3)), start=1):
            bag.give_gradients(step, only=only)
            ledger.update(step)
        if resumed:
            saved = [(names, {k: v.clone() for k, v in tensors.items()}) for names, tensors in ledger.state()]
            bag, teacher, ledger = _ledger()
            ledger.load(saved)
        bag.give_gradients(3)
        ledger.update(3)
        ledgers_of.append((bag, teacher))
    for one, other in zip(*ledgers_of, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(one.numbers(), other.numbers(), strict=True))
