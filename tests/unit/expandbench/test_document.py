"""The page about the ablation: made of the results file alone, with the hand-written end kept and free of numbers."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from sceneexpander.adaptation.config import AdaptConfig
from sceneexpander.cli.ablation import make_plan
from sceneexpander.errors import UserError
from sceneexpander.expandbench.document import READING, Measured, Results, document, powerless, written
from sceneexpander.expandbench.grades import GRADES
from sceneexpander.expandbench.run import BASELINE, CAPTURED
from sceneexpander.expandbench.scenes import ABLATION_TEST, CHECK, DEVELOPMENT, SCENES, TEST
from sceneexpander.expandbench.studies import STUDIES
from sceneexpander.insertion.contradiction import Contradiction
from tests.support.methods import make_method
from tests.worlds.cells import cell

ROOT = Path(__file__).parents[3]
PAGE, FILE = ROOT / "docs" / "ablation.md", ROOT / "results" / "ablation.json"
ROWS = {
    "self_distill": make_method(AdaptConfig(steps=30, restore_interval=0)),
    "paper": make_method(AdaptConfig(steps=30)),
    "corrected": make_method(AdaptConfig(steps=0), contradiction=Contradiction(fade=True)),
    "default": make_method(AdaptConfig(steps=30), contradiction=Contradiction(fade=True)),
}


def results() -> Results:
    values = {CAPTURED: 30.0, BASELINE: 28.0, "self_distill": 27.9, "paper": 27.9, "corrected": 29.5, "default": 29.25}
    cells = [
        cell("room_1", row, value + seed / 10, seed=seed, grade="" if row == CAPTURED else "mixed_2")
        for row, value in values.items()
        for seed in (0, 1)
    ]
    return Results(
        version="1.2.3",
        model="mini",
        machine="m",
        studies={"rows": Measured(cells=tuple(cells), rows=ROWS, visits=10)},
    )


def test_the_page_is_what_the_results_file_gives() -> None:
    found = Results.load(FILE) if FILE.is_file() else None
    assert PAGE.read_text() == written(found, PAGE), "run: make ablation ARGS=--finished"


def test_what_is_written_by_hand_quotes_no_measured_number() -> None:
    _, _, reading = PAGE.read_text().partition(READING)
    assert reading.strip()
    assert not re.findall(r"\d+\.\d|\d ?(?:dB|%)", reading)


def test_the_results_file_holds_the_cells_again(tmp_path: Path) -> None:
    results().save(tmp_path / "results.json")
    assert Results.load(tmp_path / "results.json") == results()
    (tmp_path / "results.json").write_text('{"schema": "ablation/2"}')
    with pytest.raises(UserError, match="ablation/3"):
        Results.load(tmp_path / "results.json")


def test_the_gain_is_split_into_corrections_and_adaptation() -> None:
    page = document(results())
    assert "Version 1.2.3" in page
    for title, number in (
        ("The insertion itself", "-2.00"),
        ("The default against the unadapted model", "+1.25"),
        ("The corrections alone against the unadapted model", "+1.50"),
        ("Algorithm 1 on top of the corrections", "-0.25"),
    ):
        (line,) = [line for line in page.splitlines() if line.startswith(f"- {title} (")]
        assert f"PSNR **{number} ± 0.00 dB** " in line
        assert "1 development scenes, with the fit" in line or "development scenes, with the fit" in line
    assert page.count("Not measured with this version.") == len(STUDIES) - 1


def test_a_row_without_power_is_no_tie() -> None:
    assert set(powerless(ROWS)) == {"paper"}
    (line,) = [line for line in document(results()).splitlines() if line.startswith("| paper | self_distill |")]
    assert "no power at 30 steps" in line
    assert "+0.00" not in line
    longer = {
        name: replace(row, adapt=replace(row.adapt, steps=400)) if row.adapt.steps else row
        for name, row in ROWS.items()
    }
    assert powerless(longer) == {}


def test_results_of_several_versions_of_the_code_say_so() -> None:
    one = results()
    cells = one.studies["rows"].cells
    mixed = Measured(cells=(replace(cells[0], code="other"), *cells[1:]), rows=ROWS, visits=10)
    assert "2 versions of the code" in document(replace(one, studies={"rows": mixed}))
    assert "versions of the code" not in document(one)


def test_rows_that_cannot_show_anything_in_few_steps_are_studied_with_many() -> None:
    """Whatever has no power in a study of the page is in another one where it has."""
    shown: dict[str, set[str]] = {}
    for study in STUDIES:
        plan, _ = make_plan(
            ROOT, study.rows, study.scenes, study.grades, ["0"], study.overrides, experiment=study.experiment
        )
        mute = set(powerless(plan.rows))
        for row in study.rows:
            shown.setdefault(row, set()).add("mute" if row in mute else "heard")
    assert "mute" in shown["paper"], "restoration cannot show in 30 steps"
    assert [row for row, seen in shown.items() if seen == {"mute"}] == []


def test_test_scenes_are_others_and_only_the_study_of_that_name_uses_them() -> None:
    assert not set(DEVELOPMENT) & set(TEST)
    assert set(SCENES) == {*DEVELOPMENT, *TEST}
    assert {SCENES[name][1] for name in DEVELOPMENT}.isdisjoint({SCENES[name][1] for name in TEST})
    assert {int(name.rpartition("_")[2]) for name in CHECK}.isdisjoint({seed for _, seed in SCENES.values()})
    for study in STUDIES:
        assert set(study.scenes) <= set(TEST if study.name == "test" else DEVELOPMENT)
        assert set(study.grades) <= set(GRADES)


def test_an_old_name_says_the_new_one() -> None:
    with pytest.raises(UserError, match="ablation=corrected"):
        make_plan(ROOT, ["control_no_adaptation"], ["room_1"], ["clean"], ["0"], [])
    plan, _ = make_plan(ROOT, ["default"], ["test"], ["clean"], ["0"], [])
    assert plan.scenes == ABLATION_TEST
