"""Numbers under their names in MLflow."""

from __future__ import annotations

import pytest

from sceneexpander.artifacts.metrics import MetricsRow
from sceneexpander.artifacts.page import StageRun
from sceneexpander.tracking.tracked import tracked_cost, tracked_look, tracked_row, tracked_step

LOOK = {"step": 4, "captured_psnr": 20.0, "inserted_psnr": 15.0}


@pytest.mark.parametrize("inserted", [True, False])
def test_a_step_counts_for_its_kind_only(inserted: bool) -> None:
    found = tracked_step({"step": 1, "loss": 2.0, "gen_depth": 0.0, "anchor_depth": 1.0}, inserted=inserted)
    kind = "with" if inserted else "without"
    assert [name for name in found if "loss_with" in name] == [f"4_loss/loss_{kind}_inserted"]
    assert ("4_loss/gen_depth" in found) is inserted
    assert found["4_loss/anchor_depth"] == 1.0


def test_the_drift_of_all_modules_is_their_norm() -> None:
    found = tracked_look(LOOK, {"a": 3.0, "b": 4.0})
    assert found["6_drift/all_modules"] == 5.0
    assert found["6_drift/b"] == 4.0
    assert found["5_look/captured_psnr"] == 20.0
    assert "6_drift/all_modules" not in tracked_look(LOOK, {}), "nothing moved before the first step"


def test_rows_print_few_digits_but_whole_counts() -> None:
    row = MetricsRow(
        scene="s",
        round=1,
        method="m",
        model="mini",
        weights_sha256="0",
        seed=0,
        values={"gaussians": 12_345_678.0, "psnr_captured_db": 21.5963656389, "camera_rotation_deg": 0.25},
        spread={"psnr_captured_db": 0.5, "camera_rotation_deg": 0.125},
    )
    assert tracked_row(row) == {
        "1_quality/psnr_captured_db": 21.5964,
        "3_geometry/camera_rotation_deg": 0.25,
        "8_count/gaussians": 12_345_678,
        "8_count/repeats": 1,
        "9_spread/psnr_captured_db": 0.5,
        "9_spread/camera_rotation_deg": 0.125,
    }, "what is not known is not zero"


def test_cost_adds_up() -> None:
    stages = {
        "render": StageRun(started=1.0, wall_s=2.0, peak_rss_mb=9.0),
        "adapt": StageRun(started=1.0, wall_s=3.0, peak_rss_mb=7.0),
    }
    assert tracked_cost(stages) == {
        "7_cost/time_render_s": 2.0,
        "7_cost/time_adapt_s": 3.0,
        "7_cost/wall_s": 5.0,
        "7_cost/peak_rss_mb": 9.0,
    }
    assert tracked_cost({}) == {}
