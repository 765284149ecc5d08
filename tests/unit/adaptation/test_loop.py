from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from sceneexpander.adaptation.config import AdaptConfig, AugmentConfig, Gauge, InsertedWeights, SubsetRule
from sceneexpander.adaptation.loop import (
    AdaptationInputs,
    AdaptationResult,
    NonFiniteLoss,
    Run,
    StepRecord,
    adapt,
)
from sceneexpander.artifacts.store import sha256_of_tensors
from sceneexpander.errors import UserError
from tests.support.tiny_model import TinyReconstructor
from tests.worlds.adaptation import FAST, inputs_for

NO_AUGMENT = AugmentConfig(identity=1, global_affine=0, blockwise=0, global_and_block=0)


def run_steps(config: AdaptConfig = FAST, inputs: AdaptationInputs | None = None, seed: int = 0) -> AdaptationResult:
    return adapt(TinyReconstructor(), inputs or inputs_for(), config, seed=seed)


def _bits(result: AdaptationResult) -> str:
    return sha256_of_tensors(result.student)


def test_zero_steps_leave_the_model_bit_for_bit() -> None:
    model = TinyReconstructor()
    before = sha256_of_tensors(model.state_dict())
    result = adapt(model, inputs_for(), replace(FAST, steps=0), seed=0)
    assert sha256_of_tensors(model.state_dict()) == before == _bits(result)
    assert result.records == ()


def test_with_p_0_the_inserted_view_never_touches_the_student() -> None:
    config = replace(FAST, insertion_probability=0.0)
    runs = {_bits(run_steps(config, inputs_for(inserted_seed=seed))) for seed in (9, 10)}
    assert len(runs) == 1
    nan = inputs_for()
    poisoned = replace(nan, inserted=torch.full_like(nan.inserted, float("nan")))
    assert _bits(run_steps(config, poisoned)) in runs


def test_with_p_1_the_inserted_view_matters() -> None:
    config = replace(FAST, insertion_probability=1.0)
    assert len({_bits(run_steps(config, inputs_for(inserted_seed=seed))) for seed in (9, 10)}) == 2


def test_gradients_left_over_from_other_training_do_nothing() -> None:
    used = TinyReconstructor()
    for parameter in used.parameters():  # those of heads that no loss of Algorithm 1 reaches among them
        parameter.grad = torch.ones_like(parameter)
    assert _bits(adapt(used, inputs_for(), FAST, seed=0)) == _bits(run_steps())


def test_the_anchors_are_not_changed() -> None:
    inputs = inputs_for()
    names = ("camera_vector", "depth", "normals", "depth_conf", "normals_conf")
    before = sha256_of_tensors({n: getattr(inputs.anchors, n) for n in names})
    run_steps(inputs=inputs)
    assert sha256_of_tensors({n: getattr(inputs.anchors, n) for n in names}) == before


def test_gaussian_and_point_heads_are_not_run() -> None:
    model = TinyReconstructor()
    adapt(model, inputs_for(), FAST, seed=0)
    assert model.runs["gaussians"] == model.runs["points"] == 0
    assert model.runs["depth"] == FAST.steps


def test_the_teacher_runs_only_on_steps_with_the_inserted_view(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[bool] = []
    original = TinyReconstructor.predict

    def spy(self: TinyReconstructor, *args: object, **kwargs: object) -> object:
        calls.append(torch.is_grad_enabled())
        return original(self, *args, **kwargs)

    monkeypatch.setattr(TinyReconstructor, "predict", spy)
    inputs = inputs_for()
    calls.clear()
    result = adapt(TinyReconstructor(), inputs, FAST, seed=2)
    inserted = sum(r.inserted for r in result.records)
    assert 0 < inserted < FAST.steps, "the seed must give both kinds of step"
    assert calls.count(False) == inserted
    assert calls.count(True) == FAST.steps


def test_same_seed_same_bits_other_seed_other_bits() -> None:
    assert _bits(run_steps(seed=0)) == _bits(run_steps(seed=0))
    assert _bits(run_steps(seed=0)) != _bits(run_steps(seed=1))


@pytest.mark.parametrize("stop_after", [3, 4, 7])
def test_a_resumed_run_gives_the_bits_of_an_unbroken_one(tmp_path: Path, stop_after: int) -> None:
    class Killed(Exception):
        pass

    def kill(record: StepRecord) -> None:
        if record.step == stop_after:
            raise Killed

    inputs, folder = inputs_for(), tmp_path / "checkpoint"
    with pytest.raises(Killed):
        adapt(TinyReconstructor(), inputs, FAST, seed=0, checkpoint_folder=folder, on_step=kill)
    steps: list[int] = []
    resumed = adapt(
        TinyReconstructor(), inputs, FAST, seed=0, checkpoint_folder=folder, on_step=lambda r: steps.append(r.step)
    )
    unbroken = run_steps(inputs=inputs)
    assert _bits(resumed) == _bits(unbroken)
    assert resumed.records == unbroken.records
    assert steps == list(range(1, FAST.steps + 1))


def test_the_checkpoint_of_another_run_is_not_used(tmp_path: Path) -> None:
    inputs, folder = inputs_for(), tmp_path / "checkpoint"
    adapt(TinyReconstructor(), inputs, FAST, seed=0, checkpoint_folder=folder)
    assert folder.exists()
    other = replace(FAST, learning_rate=5e-3)
    assert _bits(adapt(TinyReconstructor(), inputs, other, seed=0, checkpoint_folder=folder)) == _bits(
        run_steps(other, inputs)
    )


def test_a_damaged_checkpoint_is_ignored(tmp_path: Path) -> None:
    inputs, folder = inputs_for(), tmp_path / "checkpoint"
    adapt(TinyReconstructor(), inputs, FAST, seed=0, checkpoint_folder=folder)
    (folder / "tensors.safetensors").write_bytes(b"half")
    assert _bits(adapt(TinyReconstructor(), inputs, FAST, seed=0, checkpoint_folder=folder)) == _bits(
        run_steps(inputs=inputs)
    )


def test_a_checkpoint_that_was_just_being_replaced_is_not_lost(tmp_path: Path) -> None:
    inputs, folder = inputs_for(), tmp_path / "checkpoint"
    adapt(TinyReconstructor(), inputs, FAST, seed=0, checkpoint_folder=folder)
    folder.rename(tmp_path / ".checkpoint.0123abcd.old")  # killed between the two renames
    (tmp_path / ".checkpoint.4567cdef.part").mkdir()
    steps: list[int] = []
    original = Run.step
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Run, "step", lambda self, step: steps.append(step) or original(self, step))
        adapt(TinyReconstructor(), inputs, FAST, seed=0, checkpoint_folder=folder)
    assert steps == [7, 8], "it goes on from step 6"
    assert {path.name for path in tmp_path.iterdir()} == {"checkpoint"}


@pytest.mark.parametrize("captured", [1, 2, 3, 4])
@pytest.mark.parametrize("gauge", list(Gauge))
def test_any_small_number_of_captured_views(captured: int, gauge: Gauge) -> None:
    result = run_steps(replace(FAST, gauge=gauge), inputs_for(captured))
    assert len(result.records) == FAST.steps
    assert all(torch.isfinite(v).all() for v in result.student.values())


@pytest.mark.parametrize("captured", [1, 2, 3, 4])
def test_the_unadapted_model_has_no_anchor_loss_on_the_full_unwarped_set(captured: int) -> None:
    # All views, no augmentation, no insertion: the student sees what the anchors were made from, in the same gauge.
    config = replace(
        FAST, steps=1, subset=SubsetRule.ALL, augment=NO_AUGMENT, insertion_probability=0.0, gauge=Gauge.KEEP_FIRST
    )
    record = run_steps(config, inputs_for(captured)).records[0]
    assert record.anchor_camera + record.anchor_depth + record.anchor_normal < 1e-6


def test_adaptation_pulls_a_disturbed_model_back_to_the_anchors() -> None:
    model, draw = TinyReconstructor(), torch.Generator().manual_seed(4)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=draw))
    still = replace(FAST, augment=NO_AUGMENT, subset=SubsetRule.ALL, restore_interval=0, lambda_reg=0.0)
    config = replace(still, steps=60, insertion_probability=0.0, learning_rate=3e-3)
    records = adapt(model, inputs_for(), config, seed=0).records
    terms = [r.anchor_camera + r.anchor_depth + r.anchor_normal for r in records]
    assert sum(terms[-10:]) / 10 < 0.3 * terms[0]


def test_warped_targets_change_the_loss_of_warped_views_only() -> None:
    always = AugmentConfig(identity=0, global_affine=1, blockwise=0, global_and_block=0)
    plain = run_steps(replace(FAST, augment=always)).records[0]
    warped = run_steps(replace(FAST, augment=always, warp_targets=True)).records[0]
    assert plain.anchor_depth != warped.anchor_depth
    still = replace(FAST, augment=NO_AUGMENT)
    assert _bits(run_steps(still)) == _bits(run_steps(replace(still, warp_targets=True)))


def test_the_drift_term_holds_the_weights_back() -> None:
    free, held = (run_steps(replace(FAST, steps=30, lambda_reg=weight)).records[-1].drift for weight in (0.0, 10.0))
    assert held < 0.5 * free


def test_restored_counts_appear_every_k_steps() -> None:
    records = run_steps(replace(FAST, restore_interval=4, restore_rate=0.5)).records
    assert [r.step for r in records if r.restored] == [4, 8]


def test_a_non_finite_loss_stops_the_run_and_names_the_term() -> None:
    inputs = inputs_for()
    poisoned = replace(inputs, inserted=torch.full_like(inputs.inserted, float("nan")))
    with pytest.raises(NonFiniteLoss, match=r"at step \d+") as caught:
        run_steps(replace(FAST, insertion_probability=1.0), poisoned)
    assert isinstance(caught.value, UserError), "one line and exit code 2 at every door"
    assert "adapt.learning_rate" in caught.value.line()


@pytest.mark.parametrize("change", [lambda i: replace(i, captured=i.captured[:3])])
def test_views_and_anchors_must_match(change: Callable[[AdaptationInputs], AdaptationInputs]) -> None:
    with pytest.raises(ValueError, match="3 captured views, 4 anchors"):
        run_steps(inputs=change(inputs_for()))


def test_consistent_weights_change_the_inserted_loss_only() -> None:
    config = replace(FAST, insertion_probability=1.0, lambda_anchor=0.0, lambda_reg=0.0, augment=NO_AUGMENT)
    weighted = run_steps(replace(config, inserted_weights=InsertedWeights.CONSISTENT))
    uniform = run_steps(config)
    assert weighted.records[0].anchor_depth == uniform.records[0].anchor_depth
    assert weighted.records[0].gen_camera == uniform.records[0].gen_camera
    assert _bits(weighted) != _bits(uniform)
