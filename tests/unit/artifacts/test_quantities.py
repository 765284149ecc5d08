"""The table of everything that is measured: whole, unambiguous, and in the order in which MLflow shows it."""

from __future__ import annotations

import re
from dataclasses import fields

import pytest

from sceneexpander.adaptation.loop import StepRecord
from sceneexpander.adaptation.observe import Look
from sceneexpander.artifacts.metrics import SIZES, MetricsRow, SizeMetrics, TruthMetrics
from sceneexpander.artifacts.quantities import (
    GROUP_MEANINGS,
    MEASURED,
    TABLE,
    Group,
    tracked_cost,
    tracked_look,
    tracked_row,
    tracked_step,
)

LOOK = {"step": 4, "captured_psnr": 20.0, "inserted_psnr": 15.0, "drift": {"a": 3.0, "b": 4.0}}


def numeric(kind: type) -> set[str]:
    return {f.name for f in fields(kind) if str(f.type).split(" | ")[0] in ("float", "int")}


def test_every_number_of_a_row_a_step_and_a_look_is_in_the_table() -> None:
    known = {item.name for item in MEASURED}
    parts = {f"truth.{name}" for name in numeric(TruthMetrics)}
    parts |= {f"{part}.{name}" for part in (*SIZES, "inserted_own") for name in numeric(SizeMetrics)}
    assert numeric(MetricsRow) - {"round", "seed"} | parts == known
    inserted = dict.fromkeys(numeric(StepRecord), 1.0) | {"inserted": True}
    assert len(tracked_step(inserted)) == len(numeric(StepRecord) - {"step", "captured", "restored"})
    assert len(tracked_look(LOOK | dict.fromkeys(numeric(Look) - {"step"}, 1.0))) == len(numeric(Look) - {"step"}) + 3


def test_names_are_unambiguous_and_such_as_mlflow_takes() -> None:
    names = [item.tracked for item in TABLE]
    assert len(set(names)) == len(names)
    for name in names:
        assert re.fullmatch(r"\d_[a-z]+/[a-z0-9_]+", name), name
    assert set(GROUP_MEANINGS) == set(Group)


def test_sorted_by_name_quality_comes_first() -> None:
    names = sorted(item.tracked for item in TABLE)
    assert names[0] == "1_quality/psnr_at_photo_size_db"
    assert [group for group in Group if any(name.startswith(group) for name in names)] == list(
        dict.fromkeys(Group(name.partition("/")[0]) for name in names)
    )


@pytest.mark.parametrize("inserted", [True, False])
def test_a_step_counts_for_its_kind_only(inserted: bool) -> None:
    step = {"step": 1, "inserted": inserted, "loss": 2.0, "gen_depth": 0.0, "anchor_depth": 1.0}
    found = tracked_step(step)
    kind = "with" if inserted else "without"
    assert [name for name in found if "objective" in name] == [f"4_loss/objective_{kind}_inserted"]
    assert ("4_loss/inserted_depth" in found) is inserted
    assert found["4_loss/anchor_depth"] == 1.0


def test_the_drift_of_all_modules_is_their_norm() -> None:
    found = tracked_look(LOOK)
    assert found["6_drift/all_modules"] == 5.0
    assert found["6_drift/b"] == 4.0
    assert "6_drift/all_modules" not in tracked_look(LOOK | {"drift": {}}), "nothing moved before the first step"


def test_rows_print_few_digits_but_whole_counts() -> None:
    row = MetricsRow(
        scene="s",
        round=1,
        method="m",
        model="mini",
        weights_sha256="0",
        seed=0,
        captured_views=3,
        generated_views=1,
        gaussians=12_345_678,
        generated_gaussians=1,
        psnr_db=21.5963656389,
        ssim=0.5,
        coverage=1.0,
        truth=TruthMetrics(camera_rotation_deg=0.25),
        spread={"psnr_db": 0.5, "truth.camera_rotation_deg": 0.125},
    )
    found = tracked_row(row)
    assert found["1_quality/psnr_captured_db"] == 21.5964
    assert found["8_count/gaussians"] == 12_345_678
    assert found["3_geometry/camera_rotation_deg"] == 0.25
    assert found["9_spread/psnr_captured_db"] == 0.5
    assert found["9_spread/camera_rotation_deg"] == 0.125
    assert not [name for name in found if "inserted" in name], "what is not known is not zero"


def test_cost_adds_up() -> None:
    stages = {"render": {"wall_s": 2.0, "peak_rss_mb": 9.0}, "adapt": {"wall_s": 3.0, "peak_rss_mb": 7.0}}
    assert tracked_cost(stages) == {
        "7_cost/time_render_s": 2.0,
        "7_cost/time_adapt_s": 3.0,
        "7_cost/time_all_s": 5.0,
        "7_cost/peak_memory_mb": 9.0,
    }
    assert tracked_cost({}) == {}
