"""Options that trade memory for time leave the numbers alone."""

from dataclasses import replace

import pytest
import torch

from sceneexpander.adaptation.config import EngineConfig, Precision
from sceneexpander.adaptation.engine import set_up
from sceneexpander.adaptation.learner import Learner
from sceneexpander.adaptation.loop import adapt
from sceneexpander.artifacts.store import sha256_of_tensors
from sceneexpander.errors import UserError
from sceneexpander.models.layers.block import Block
from sceneexpander.models.protocol import GEOMETRY_HEADS
from tests.support.tiny_model import TinyReconstructor
from tests.worlds.engines import STEPS, adapted_mini, adapted_worldmirror, run_steps


@pytest.mark.parametrize("make", [adapted_worldmirror, adapted_mini], ids=["worldmirror", "mini"])
def test_recomputed_activations_give_the_same_bits(make: object) -> None:
    plain = run_steps(make, STEPS)
    saving = run_steps(make, replace(STEPS, engine=EngineConfig(checkpoint_activations=True)))
    assert sha256_of_tensors(plain.student) == sha256_of_tensors(saving.student)
    assert plain.records == saving.records


@pytest.mark.parametrize("make", [adapted_worldmirror, adapted_mini], ids=["worldmirror", "mini"])
def test_chunks_of_views_change_nothing_but_rounding(make: object) -> None:
    config = replace(STEPS, steps=1)
    plain = run_steps(make, config).records[0]
    for checkpoint in (False, True):
        engine = EngineConfig(views_per_chunk=1, checkpoint_activations=checkpoint)
        chunked = run_steps(make, replace(config, engine=engine)).records[0]
        assert chunked.loss == pytest.approx(plain.loss, rel=1e-5)
        assert chunked.gradient_norm == pytest.approx(plain.gradient_norm, rel=1e-4)


def test_gaussians_among_the_anchors_reach_their_head() -> None:
    config = replace(STEPS, steps=2, insertion_probability=0.0, restore_interval=0)
    for weight, reached in ((0.0, False), (1.0, True)):
        model, inputs = adapted_mini()
        before = {name: value.clone() for name, value in model.state_dict().items()}
        result = adapt(model, inputs, replace(config, alpha_gaussian=weight), seed=0)
        moved = [
            not torch.equal(before[n], v) for n, v in result.student.items() if n.startswith("network.gaussian_head")
        ]
        assert any(moved) == reached
        assert (result.records[-1].anchor_gaussian > 0) == reached


@pytest.mark.parametrize("make", [adapted_worldmirror, adapted_mini], ids=["worldmirror", "mini"])
def test_theta_0_on_the_host_changes_no_bit(make: object) -> None:
    plain = run_steps(make, STEPS)
    offloaded = run_steps(make, replace(STEPS, engine=EngineConfig(start_on_host=True)))
    assert sha256_of_tensors(plain.student) == sha256_of_tensors(offloaded.student)


@pytest.mark.parametrize("make", [adapted_worldmirror, adapted_mini], ids=["worldmirror", "mini"])
@pytest.mark.parametrize("checkpoint", [False, True])
def test_bfloat16_passes_update_float32_masters(make: object, checkpoint: bool) -> None:
    model, inputs = make()  # type: ignore[operator]
    engine = EngineConfig(checkpoint_activations=checkpoint)
    tiny_rate = replace(STEPS, precision=Precision.BF16, learning_rate=1e-6, weight_decay=0.0, engine=engine)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    result = adapt(model, inputs, tiny_rate, seed=0)
    full = run_steps(make, replace(tiny_rate, precision=Precision.FP32))
    assert result.records[0].loss == pytest.approx(full.records[0].loss, rel=0.2, abs=2e-3)
    assert {value.dtype for value in result.student.values()} == {torch.float32}
    moved = [not torch.equal(before[name], value) for name, value in result.student.items()]
    # A change of 1e-6 is lost on a bfloat16 weight of ordinary size.
    assert sum(moved) > 0.5 * len(moved)


def test_outputs_of_a_bfloat16_pass_are_float32() -> None:
    for make in (adapted_worldmirror, adapted_mini):
        model, inputs = make()
        with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16):
            prediction = model.predict(inputs.captured, inputs.captured_priors, heads=GEOMETRY_HEADS)
        assert {prediction.depth.dtype, prediction.normals.dtype, prediction.camera_vector.dtype} == {torch.float32}


@pytest.mark.slow
def test_compiled_blocks_give_the_same_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    # Tracing and dynamic shapes as in use; the code generator, which takes minutes on a CPU, is left out.
    compiled = Block.compile
    monkeypatch.setattr(Block, "compile", lambda self, **options: compiled(self, backend="eager", **options))
    two = replace(STEPS, steps=2)
    plain = run_steps(adapted_worldmirror, two)
    fast = run_steps(adapted_worldmirror, replace(two, engine=EngineConfig(compile=True)))
    for ours, reference in zip(fast.records, plain.records, strict=True):
        assert ours.loss == pytest.approx(reference.loss, rel=1e-4)


def test_a_model_without_the_option_says_so() -> None:
    with pytest.raises(UserError, match="tiny can neither recompute"):
        set_up(TinyReconstructor(), replace(STEPS, engine=EngineConfig(checkpoint_activations=True)))
    set_up(TinyReconstructor(), STEPS)


def test_the_teacher_saves_memory_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its views in chunks too: without, it would need what the student was spared."""
    model, inputs = adapted_worldmirror()
    told = []
    save = type(model).save_memory
    monkeypatch.setattr(
        type(model), "save_memory", lambda self, **how: told.append((id(self), how)) or save(self, **how)
    )
    learner = Learner(model, inputs.anchors, replace(STEPS, engine=EngineConfig(views_per_chunk=1)), seed=0)
    assert {whose for whose, _ in told} == {id(model), id(learner.teacher)}
    assert all(how["views_per_chunk"] == 1 for _, how in told)
