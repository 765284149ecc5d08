"""Tables: order, means, and gaps that stay visible."""

from __future__ import annotations

import csv
import io

import pytest

from sceneexpander.artifacts.metrics import Fit, UnavailableRow
from sceneexpander.evaluation import comparison_table, scene_table
from sceneexpander.evaluation.repeats import over_repeats
from tests.worlds.rows import row


def cells(table: str) -> list[list[str]]:
    return list(csv.reader(io.StringIO(table)))


def test_shape_and_means() -> None:
    rows = [
        row("b", "sceneexpander", 22.0, psnr_inserted_db=18.0, tour_covered=0.9),
        row("a", "sceneexpander", 20.0, psnr_inserted_db=17.0, tour_covered=0.8),
        row("a", "captured", 25.0, tour_covered=0.5, fit=Fit.FITTED),
        row("b", "captured", 26.0, tour_covered=0.7, fit=Fit.FITTED),
        row("a", "backbone", 18.0, psnr_inserted_db=19.0, tour_covered=0.8, fit=Fit.FITTED),
        row("b", "backbone", 19.0, psnr_inserted_db=19.0, tour_covered=0.8),
    ]
    header, *lines = cells(comparison_table(rows).csv())
    assert header == [
        "method", "Gaussians", "cells of 2", "PSNR, stored size, dB ↑", "SSIM, stored size ↑", "Tour covered, % ↑",
        "Tour covered, gained, % ↑", "Inserted PSNR, stored size, dB ↑"
    ]  # fmt: skip
    assert lines == [
        ["Captured only", "fitted", "2", "25.50", "0.500", "60.0", "–", "–"],
        [
            "made + inserted view",
            "fitted, as predicted",
            "2",
            "18.50",
            "0.500",
            "80.0",
            "20.0",
            "19.00",
        ],
        [
            "SceneExpander on made",
            "as predicted",
            "2",
            "21.00",
            "0.500",
            "85.0",
            "25.0",
            "17.50",
        ],
    ]


def test_a_method_that_could_not_be_run_has_its_reason_in_the_line() -> None:
    reason = "needs the public checkpoint"
    lost = UnavailableRow(scene="a", round=1, method="ttt3r", model="ttt3r", seed=0, reason=reason)
    rows = [row("a", "captured", 25.0), row("b", "captured", 15.0), lost, row("b", "omnivggt", 12.0)]
    header, *lines = cells(comparison_table(rows).csv())
    assert header == ["method", "Gaussians", "cells of 2", "PSNR, stored size, dB ↑", "SSIM, stored size ↑"]
    assert lines[1:] == [
        ["OmniVGGT, pixel-aligned", "as predicted", "1", "12.00 (1/2)", "0.500 (1/2)"],
        ["ttt3r, pixel-aligned", "–", "0", reason, "–"],
    ]
    per_scene = cells(scene_table(rows).csv())
    assert ["a", "1", "0", "ttt3r, pixel-aligned", "–", reason, "–"] in per_scene
    assert ["b", "1", "0", "ttt3r, pixel-aligned", "–", "missing", "missing"] in per_scene
    with pytest.raises(ValueError, match="two rows"):
        comparison_table([lost, lost])


def test_repeats_become_a_mean_with_its_spread() -> None:
    runs = [
        row("a", "gaussian_splatting", 20.0, gaussians=11, depth_abs_rel=0.1, psnr_inserted_db=9.0),
        row("a", "gaussian_splatting", 22.0, gaussians=12, depth_abs_rel=0.2),
    ]
    whole = over_repeats(runs)
    assert (whole.repeats, whole.value("psnr_captured_db"), whole.value("gaussians")) == (2, 21.0, 11)
    assert whole.spread["psnr_captured_db"] == pytest.approx(2**0.5)
    assert whole.value("depth_abs_rel") == pytest.approx(0.15)
    assert whole.spread["depth_abs_rel"] == pytest.approx(0.1 / 2**0.5)
    assert whole.value("psnr_inserted_db") is None, "one run lacks it"
    assert "psnr_inserted_db" not in whole.spread
    assert whole.numbers()["spread_psnr_captured_db"] == pytest.approx(2**0.5)
    assert cells(comparison_table([whole]).csv())[1][3] == "21.00 ± 1.41"
    assert over_repeats(runs[:1]) is runs[0]
    with pytest.raises(ValueError, match="one scene"):
        over_repeats([runs[0], row("b", "gaussian_splatting", 1.0)])


def test_the_means_of_a_column_are_over_the_same_cells() -> None:
    """Captured has an easy scene more than SceneExpander: that must not raise its mean."""
    rows = [
        row("a", "captured", 25.0, tour_covered=0.5),
        row("b", "captured", 40.0, tour_covered=0.6),
        row("a", "sceneexpander", 20.0, tour_covered=0.9, depth_abs_rel=0.1),
        row("c", "sceneexpander", 22.0, tour_covered=0.7, depth_abs_rel=0.3),
    ]
    header, *lines = cells(comparison_table(rows).csv())
    table = {line[0].split()[0]: dict(zip(header, line, strict=True)) for line in lines}
    assert table["Captured"]["PSNR, stored size, dB ↑"] == "25.00 (1/3)"
    assert table["SceneExpander"]["PSNR, stored size, dB ↑"] == "20.00 (1/3)"
    assert table["SceneExpander"]["Tour covered, gained, % ↑"] == "40.0 (1/3)"
    assert table["Captured"]["Depth error, % ↓"] == "missing", "what a method never has narrows no column"
    assert table["SceneExpander"]["Depth error, % ↓"] == "20.00 (2/3)"
    assert table["SceneExpander"]["cells of 3"] == "2"
    assert "Inserted PSNR, stored size, dB ↑" not in header


def test_methods_without_a_cell_in_common_have_no_means() -> None:
    rows = [row("a", "captured", 25.0), row("b", "backbone", 15.0), row("b", "sceneexpander", 16.0)]
    _, *lines = cells(comparison_table(rows).csv())
    assert [line[3] for line in lines] == ["no common cell"] * 3


def test_scene_table_lists_absent_combinations() -> None:
    rows = [row("a", "captured", 25.0), row("b", "sceneexpander", 20.0)]
    _, *lines = cells(scene_table(rows).csv())
    assert [line[0] for line in lines] == ["a", "a", "b", "b"]
    assert [line[5] for line in lines] == ["25.00", "missing", "missing", "20.00"]


def test_seeds_and_rounds_are_cells_of_their_own() -> None:
    rows = [row("a", "captured", 20.0), row("a", "captured", 30.0, seed=1), row("a", "captured", 10.0, round_number=2)]
    assert cells(comparison_table(rows).csv())[1][2:4] == ["3", "20.00"]
    with pytest.raises(ValueError, match="two rows"):
        comparison_table([*rows, rows[0]])


def test_unknown_methods_come_last() -> None:
    rows = [row("a", "zebra", 1.0), row("a", "other", 2.0), row("a", "sceneexpander", 3.0)]
    assert [line[0] for line in cells(comparison_table(rows).csv())[1:]] == [
        "SceneExpander on made",
        "other",
        "zebra",
    ]


def test_markdown() -> None:
    text = comparison_table([row("a", "odd|name", 25.0)]).markdown().splitlines()
    assert text[1].startswith("| :-- | :-- | --: |")
    assert text[2].startswith("| odd\\|name | as predicted | 1 | 25.00 |")


def test_what_the_scene_before_the_insertion_shows_of_an_inserted_view_is_no_number() -> None:
    table = comparison_table([row("a", "captured", 25.0, psnr_inserted_db=9.0)])
    assert "Inserted PSNR, stored size, dB ↑" not in table.header
