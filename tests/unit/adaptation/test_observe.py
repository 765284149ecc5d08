"""Looks show what the losses do not, and change nothing."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from sceneexpander.adaptation.loop import adapt
from sceneexpander.adaptation.observe import HARM_DB, MOST_DB, Look, psnr_db, spread, warnings_of
from sceneexpander.artifacts.store import sha256_of_tensors
from tests.support.tiny_model import TinyReconstructor
from tests.worlds.adaptation import FAST, inputs_for

WATCHED = replace(FAST, observe_every=3)


def _look(step: int, captured_psnr: float) -> Look:
    return Look(
        step=step,
        captured_psnr=captured_psnr,
        inserted_psnr=10.0,
        captured_depth_change=0.0,
        head_disagreement=0.0,
        drift={},
    )


def test_looks_change_no_bit_of_the_run(tmp_path: Path) -> None:
    blind = adapt(TinyReconstructor(), inputs_for(), FAST, seed=0)
    watched = adapt(TinyReconstructor(), inputs_for(), WATCHED, seed=0, looks_folder=tmp_path)
    assert sha256_of_tensors(blind.student) == sha256_of_tensors(watched.student)
    assert blind.records == watched.records
    assert blind.looks == ()


def test_looks_come_before_between_and_after(tmp_path: Path) -> None:
    seen: list[int] = []
    result = adapt(
        TinyReconstructor(),
        inputs_for(),
        WATCHED,
        seed=0,
        on_look=lambda look: seen.append(look.step),
        looks_folder=tmp_path,
    )
    assert seen == [look.step for look in result.looks] == [0, 3, 6, 8]
    pictures = {f"{name}_{step:04d}.jpg" for name in ("captured", "inserted", "depth") for step in seen}
    assert {path.name for path in tmp_path.iterdir()} == pictures
    assert Image.open(tmp_path / "depth_0000.jpg").size == (16, 12)
    first, last = result.looks[0], result.looks[-1]
    assert first.drift == {}
    assert last.drift.keys() == {"stem.weight", "stem.bias", "depth_head.weight", "depth_head.bias"} | {
        "normals_head.weight",
        "normals_head.bias",
        "camera_head.weight",
        "camera_head.bias",
        "view_token",
    }
    assert last.drift["stem.weight"] > 0
    assert last.head_disagreement == 0, "this model places Gaussians by its depth head"
    assert last.captured_depth_change > 0


def test_the_first_look_of_the_frozen_model_is_at_its_anchors_but_for_the_inserted_view() -> None:
    inputs = inputs_for()
    same = replace(inputs, inserted=inputs.captured.mean(0))
    look = adapt(TinyReconstructor(), same, replace(WATCHED, steps=1), seed=0).looks[0]
    assert look.captured_depth_change < 0.05


def test_a_resumed_run_keeps_the_looks_of_its_past(tmp_path: Path) -> None:
    class Killed(Exception):
        pass

    def kill(look: Look) -> None:
        if look.step == 6:
            raise Killed

    with pytest.raises(Killed):
        adapt(TinyReconstructor(), inputs_for(), WATCHED, seed=0, checkpoint_folder=tmp_path, on_look=kill)
    resumed = adapt(TinyReconstructor(), inputs_for(), WATCHED, seed=0, checkpoint_folder=tmp_path)
    assert resumed.looks == adapt(TinyReconstructor(), inputs_for(), WATCHED, seed=0).looks


@pytest.mark.parametrize(("values", "harmed"), [([20, 19.8, 21], False), ([20, 19.4, 20.5], True), ([], False)])
def test_harm_is_a_fall_below_the_first_look(values: list[float], harmed: bool) -> None:
    assert HARM_DB == 0.5
    found = warnings_of([_look(10 * i, value) for i, value in enumerate(values)])
    assert bool(found) == harmed
    if harmed:
        assert "20.00 dB before it and at 19.40 dB after step 10" in found[0]


@pytest.mark.parametrize(("count", "chosen"), [(1, [0]), (2, [0, 1]), (3, [0, 1, 2]), (8, [0, 4, 7])])
def test_views_that_are_looked_at_are_spread(count: int, chosen: list[int]) -> None:
    assert spread(count, 3) == chosen


def test_psnr_is_bounded() -> None:
    picture = torch.full((3, 4, 4), 0.5)
    assert psnr_db(picture, picture) == MOST_DB
    assert psnr_db(picture, picture + 0.1) == pytest.approx(20, abs=1e-4)
