"""Parameter-efficient variants and early stopping."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sceneexpander.adaptation import plateau
from sceneexpander.adaptation.config import AdaptConfig, PlateauConfig, Trainable
from sceneexpander.adaptation.loop import StepRecord, adapt
from sceneexpander.adaptation.trainable import LowRankLinear, plain_state, trained_parts
from sceneexpander.artifacts.state import WeightsChange
from sceneexpander.artifacts.store import sha256_of_tensors
from sceneexpander.errors import UserError
from tests.support.tiny_model import TinyReconstructor
from tests.worlds.engines import STEPS, adapted_mini, adapted_worldmirror, run_steps

MAKERS = pytest.mark.parametrize("make", [adapted_worldmirror, adapted_mini], ids=["worldmirror", "mini"])
LORA, HEADS = (replace(STEPS, trainable=kind, lora_rank=3) for kind in (Trainable.LORA, Trainable.HEADS))


@MAKERS
def test_heads_only_leaves_the_trunk_bit_for_bit(make: object) -> None:
    model, inputs = make()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    result = adapt(model, inputs, HEADS, seed=0)
    changed = {name for name, value in result.student.items() if not torch.equal(value, before[name])}
    assert changed
    assert not [name for name in changed if name.startswith(model.trunk_prefixes)]
    assert all(p.requires_grad for p in model.parameters()), "afterwards everything can be trained again"


@MAKERS
def test_lora_changes_linear_layers_by_a_low_rank_and_nothing_else(make: object) -> None:
    model, inputs = make()
    names = list(model.state_dict())
    before = {name: value.clone() for name, value in model.state_dict().items()}
    result = adapt(model, inputs, LORA, seed=0)
    assert list(result.student) == names == list(model.state_dict())
    assert not [m for m in model.modules() if isinstance(m, LowRankLinear)]
    changes = WeightsChange.between(before, result.student).change
    assert changes
    for name, change in changes.items():
        assert name.endswith((".qkv.weight", ".proj.weight", ".fc1.weight", ".fc2.weight"))
        values = torch.linalg.svdvals(change)
        assert values[0] > 0
        assert float(values[3:].sum()) < 1e-3 * float(values[0]), "rank 3"
    assert sha256_of_tensors(dict(model.state_dict())) == sha256_of_tensors(result.student)


@MAKERS
def test_lora_without_a_step_changes_no_bit(make: object) -> None:
    model, inputs = make()
    before = sha256_of_tensors(model.state_dict())
    assert sha256_of_tensors(adapt(model, inputs, replace(LORA, steps=0), seed=0).student) == before
    with trained_parts(model, LORA, seed=0):
        assert sha256_of_tensors(plain_state(model)) == before


def test_a_low_rank_layer_is_the_merged_layer() -> None:
    draw = torch.Generator().manual_seed(0)
    layer = LowRankLinear(torch.nn.Linear(6, 5), 2, draw)
    with torch.no_grad():
        layer.lora_b.normal_(generator=draw)
    x = torch.randn(3, 6, generator=draw)
    torch.testing.assert_close(layer(x), torch.nn.functional.linear(x, layer.merged(), layer.bias))


def test_lora_repeats_and_resumes(tmp_path: Path) -> None:
    assert sha256_of_tensors(run_steps(adapted_mini, LORA).student) == sha256_of_tensors(
        run_steps(adapted_mini, LORA).student
    )
    model, inputs = adapted_mini()
    every = replace(LORA, checkpoint_every=1)
    whole = adapt(model, inputs, every, seed=0, checkpoint_folder=tmp_path / "point")
    model, inputs = adapted_mini()
    steps: list[int] = []
    resumed = adapt(
        model, inputs, every, seed=0, checkpoint_folder=tmp_path / "point", on_step=lambda r: steps.append(r.step)
    )
    assert steps == [1, 2, 3]
    assert sha256_of_tensors(resumed.student) == sha256_of_tensors(whole.student)


def test_a_model_without_a_trunk_or_blocks_is_refused() -> None:
    for config in (LORA, HEADS):
        with pytest.raises(UserError, match="tiny"), trained_parts(TinyReconstructor(), config, seed=0):
            pass


def _record(step: int, anchor: float, gen: float | None, captured: int = 3) -> StepRecord:
    return StepRecord(
        step=step,
        captured=captured,
        inserted=gen is not None,
        loss=0.0,
        anchor_camera=anchor * captured,
        anchor_depth=0.0,
        anchor_normal=0.0,
        gen_camera=gen or 0.0,
        gen_depth=0.0,
        gen_normal=0.0,
        drift=0.0,
        gradient_norm=0.0,
        restored=0,
    )


@pytest.mark.parametrize(
    ("anchors", "stops"),
    [([4, 4, 2, 2], False), ([4, 4, 4, 3.99], True), ([1, 1, 4, 4], True), ([4, 4, 2], False), ([4, 4], False)],
)
def test_the_plateau_compares_windows(anchors: list[float], stops: bool) -> None:
    config = AdaptConfig(plateau=PlateauConfig(window=2, tolerance=0.1), lambda_gen=0.0)
    # The number of views changes from step to step and must not matter.
    records = [_record(i + 1, value, None, captured=2 + i % 3) for i, value in enumerate(anchors)]
    assert plateau.has_plateaued(records, config) == stops


def test_the_plateau_waits_until_the_inserted_view_was_seen() -> None:
    config = AdaptConfig(plateau=PlateauConfig(window=1), lambda_gen=1.0)
    assert not plateau.has_plateaued([_record(1, 1.0, 1.0), _record(2, 1.0, None)], config)
    assert plateau.has_plateaued([_record(1, 1.0, 1.0), _record(2, 1.0, 1.0)], config)
    assert not plateau.has_plateaued([_record(1, 1.0, 1.0), _record(2, 1.0, 0.5)], config)


@pytest.mark.parametrize("insertion", [0.0, 0.5])
def test_windows_are_compared_by_what_the_objective_weighs(insertion: float) -> None:
    """All terms count, each of a view as the objective has it, and the last two windows alone."""
    config = AdaptConfig(
        plateau=PlateauConfig(window=3, tolerance=0.25),
        lambda_anchor=2.0,
        lambda_gen=3.0,
        insertion_probability=insertion,
    )
    draw, answers = np.random.default_rng(0), set()
    for _ in range(60):
        records = []
        for step in range(1, 13):
            terms = {
                f"{loss}_{part}": float(draw.uniform())
                for loss in ("anchor", "gen")
                for part in ("camera", "depth", "normal")
            }
            seen = step % 3 == 0 or bool(draw.integers(2))
            records.append(
                replace(_record(step, 0.0, 1.0 if seen else None, captured=int(draw.integers(2, 5))), **terms)
            )
        last, before = records[-3:], records[-6:-3]

        def level(window: list[StepRecord]) -> float:
            anchor = [(one.anchor_camera + one.anchor_depth + one.anchor_normal) / one.captured for one in window]
            gen = [one.gen_camera + one.gen_depth + one.gen_normal for one in window if one.inserted]
            return 2.0 * float(np.mean(anchor)) + (3.0 * float(np.mean(gen)) if insertion else 0.0)

        falls = level(last) <= 0.75 * level(before)
        assert plateau.has_plateaued(records, config) == (not falls)
        assert not plateau.has_plateaued(records[:-1], config), "asked once per window"
        answers.add(falls)
    assert answers == {True, False}


def test_stopping_early_reports_the_steps_saved_and_looks_once_more() -> None:
    model, inputs = adapted_mini()
    never_better = PlateauConfig(window=1, tolerance=0.99)
    config = replace(STEPS, steps=9, observe_every=5, plateau=never_better)
    result = adapt(model, inputs, config, seed=0)
    assert len(result.records) == 2
    assert result.steps_saved == 7
    assert [look.step for look in result.looks] == [0, 2]


def test_a_low_rank_change_starts_at_nothing_with_directions_to_all_sides() -> None:
    """As a linear layer's own weights are drawn: evenly within one over the root of its inputs, around zero."""
    layer = LowRankLinear(torch.nn.Linear(400, 7), 50, torch.Generator().manual_seed(0))
    assert not layer.lora_b.any()
    drawn, bound = layer.lora_a.detach(), 400**-0.5
    assert float(drawn.abs().max()) <= bound
    assert abs(float(drawn.mean())) < 0.02 * bound  # 20,000 draws: four standard deviations are 0.016
    assert float(drawn.std()) == pytest.approx(bound / 3**0.5, rel=0.03)
