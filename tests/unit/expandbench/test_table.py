"""Tables from made-up cells whose means, spreads and differences are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from sceneexpander.expandbench.measure import BenchNumbers
from sceneexpander.expandbench.plot import curve, plot
from sceneexpander.expandbench.run import BASELINE, CAPTURED, CellResult
from sceneexpander.expandbench.table import (
    COLUMNS,
    acceptance_table,
    compare_rows,
    components_table,
    curve_table,
    main_table,
    mean_of,
    row_names,
    scenes_table,
    seed_spread,
)
from sceneexpander.insertion.acceptance import Acceptance
from tests.worlds.cells import cell, changed

PSNR = next(column for column in COLUMNS if column.name == "psnr_captured_db")
DEPTH = next(column for column in COLUMNS if column.name == "depth_abs_rel")


CELLS = [
    cell("a", CAPTURED, 21.0, grade=""),
    cell("b", CAPTURED, 23.0, grade=""),
    cell("a", BASELINE, 20.0),
    cell("b", BASELINE, 22.0),
    cell("a", "paper", 21.0, seed=0, depth=0.04),
    cell("b", "paper", 21.9, seed=0, depth=0.06),
    cell("a", "paper", 22.0, seed=1, depth=0.04),
    cell("b", "paper", 21.9, seed=1, depth=0.06),
    *(cell(scene, CAPTURED, value, seed=1, grade="") for scene, value in (("a", 21.2), ("b", 23.2))),
    *(cell(scene, BASELINE, value, seed=1) for scene, value in (("a", 20.4), ("b", 22.4))),
]


def test_rows_start_with_the_fixed_ones() -> None:
    assert row_names(CELLS[::-1]) == [CAPTURED, BASELINE, "paper"]


def test_means_and_spread_over_seeds() -> None:
    own = [c for c in CELLS if c.row == "paper"]
    assert mean_of(own, PSNR) == pytest.approx((21 + 21.9 + 22 + 21.9) / 4)
    # Per seed: 21.45 and 21.95.
    assert seed_spread(own, PSNR) == pytest.approx(0.5 / 2**0.5)
    assert seed_spread(own[:2], PSNR) is None


def test_a_mean_with_a_gap_is_no_mean() -> None:
    gap = replace(CELLS[4], numbers=BenchNumbers(values={"psnr_captured_db": 20.0}))
    column = next(c for c in COLUMNS if c.name == "psnr_from_others_db")
    assert mean_of([gap, CELLS[5]], column) is None
    assert mean_of([], column) is None


def test_differences_are_paired_by_scene_and_grade() -> None:
    found = compare_rows(CELLS, "paper", PSNR)
    assert found is not None
    # Scene a: 21 - 20 and 22 - 20.4, scene b: 21.9 - 22 and 21.9 - 22.4: each with the baseline of its own seed.
    assert found.mean == pytest.approx((1.3 - 0.3) / 2)
    assert found.lowest == pytest.approx(-0.3)
    assert (found.better, found.scenes) == (1, 2)
    assert found.seed_spread == pytest.approx(abs((1 - 0.1) / 2 - (1.6 - 0.5) / 2) / 2**0.5)
    assert compare_rows([c for c in CELLS if c.row != BASELINE or c.seed == 0], "paper", PSNR) == compare_rows(
        CELLS[:6], "paper", PSNR
    )
    assert compare_rows(CELLS[:4], "paper", PSNR) is None
    assert compare_rows([c for c in CELLS if c.row != BASELINE], "paper", PSNR) is None


def test_a_component_is_compared_with_the_row_that_lacks_it_unless_it_cannot_show() -> None:
    cells = [
        *CELLS,
        *(
            replace(
                c, row="more", numbers=changed(c.numbers, psnr_captured_db=c.numbers.values["psnr_captured_db"] + 0.3)
            )
            for c in CELLS[4:8]
        ),
    ]
    references = {"paper": BASELINE, "more": "paper", "absent": "paper"}
    lines = components_table(cells, references, {}, [PSNR]).splitlines()
    assert lines[3] == "| more | paper | +0.30 ± 0.00 (worst +0.30; 2/2) |"
    assert len(lines) == 4
    mute = components_table(cells, references, {"more": "no power at 30 steps: it touches nothing"}, [PSNR, DEPTH])
    assert mute.splitlines()[3] == "| more | paper | no power at 30 steps: it touches nothing | – |"


def test_scene_by_scene() -> None:
    assert scenes_table(CELLS, ["paper"]).splitlines()[2:] == [
        "| before | 21.10 | 23.10 |",
        "| baseline | -0.90 | -0.90 |",
        "| paper | +1.30 | -0.30 |",
    ]


def test_for_errors_lower_is_better_and_higher_is_worst() -> None:
    found = compare_rows(CELLS, "paper", DEPTH)
    assert found is not None
    assert found.mean == pytest.approx(0.0)
    assert found.lowest == pytest.approx(0.01)
    assert found.better == 1
    smaller = [replace(c, numbers=changed(c.numbers, depth_abs_rel=0.03)) if c.row == "paper" else c for c in CELLS]
    found = compare_rows(smaller, "paper", DEPTH)
    assert found is not None
    assert (found.better, found.scenes) == (2, 2)


def test_the_tables_say_so() -> None:
    text = main_table(CELLS)
    assert "| paper | 4 | 21.70 ± 0.35 | 0.0 ± 0.0 | 21.70 ± 0.35 |" in text
    assert "| captured | 4 | 22.10 ± 0.14 | 0.0 ± 0.0 | 22.10 ± 0.14 |" in text
    curve = curve_table(CELLS, ["paper"])
    assert "| mixed_1 | -0.90 ± 0.14 (worst -0.90; 0/2) | +0.50 ± 0.07 (worst -0.30; 1/2) |" in curve


def test_a_curve_is_relative_to_the_pre_insertion_scene(tmp_path: Path) -> None:
    cells = [
        *CELLS[:2],
        cell("a", BASELINE, 21.0, grade="clean"),
        cell("b", BASELINE, 22.5, grade="clean"),
        cell("a", BASELINE, 19.0, grade="mixed_2"),
        cell("b", BASELINE, 21.0, grade="mixed_2"),
        *CELLS[2:4],
    ]
    assert curve(cells, BASELINE, "mixed", PSNR) == [(0.0, -0.25), (1, -1.0), (2, -2.0)]
    assert plot(cells, tmp_path / "curve.svg")
    first = (tmp_path / "curve.svg").read_bytes()
    assert plot(cells, tmp_path / "curve.svg")
    assert (tmp_path / "curve.svg").read_bytes() == first
    assert not plot(CELLS[:2], tmp_path / "none.svg")


def test_the_acceptance_table_counts_and_separates() -> None:
    def judged(scene: str, grade: str, psnr: float, depth: float, reasons: tuple[str, ...]) -> CellResult:
        candidate = Acceptance(
            posed=True, overlap=0.5, depth_conflict=depth, colour_conflict=None, cameras_moved_deg=0.0, reasons=reasons
        )
        return replace(cell(scene, BASELINE, psnr, grade=grade), candidate=candidate)

    cells = [
        *CELLS[:2],
        judged("a", "g", 19.0, 0.3, ("depth",)),  # costs 2 dB
        judged("a", "h", 20.9, 0.1, ()),
        judged("b", "g", 22.9, 0.2, ()),
        judged("b", "h", 22.0, 0.15, ()),  # costs 1 dB
    ]
    text = acceptance_table(cells)
    assert "2 cost more than 0.5 dB" in text
    assert "| depth_conflict | 4 | 0.75 |" in text  # of the four pairs, 0.15 < 0.2 is the wrong way round
    assert "| overlap | 4 | 0.50 |" in text
    assert "| colour_conflict | 0 | – |" in text
    assert "| refused | 1 of 4 | – |" in text
    assert "| mean loss of the refused, dB | 1 | 2.00 |" in text
    again = [replace(c, seed=1) for c in cells]
    assert acceptance_table([*cells, *again]) == text, (
        "a candidate counts once, however many fits were measured with it"
    )
    assert acceptance_table(CELLS[:2]).startswith("No candidate")
