"""The command that measures: studies into one results file and one page, a table of one's own beside them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from sceneexpander.cli import ablation
from sceneexpander.expandbench.document import READING, Results, written
from sceneexpander.expandbench.run import BASELINE, CAPTURED, CellResult, Plan, Settings
from sceneexpander.expandbench.studies import STUDIES
from tests.worlds.cells import cell

ROOT = Path(__file__).parents[3]


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The configuration, a page with a hand-written end, and cells that are made up instead of measured."""
    monkeypatch.setenv("SCENEEXPANDER_ROOT", str(tmp_path))
    for name in ("conf", "src"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "dvc.yaml").write_text("stages: {}")
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "ablation.md").write_text(f"old\n{READING}\n## Mine\n")

    def made(plan: Plan, settings: Settings, **_: object) -> list[CellResult]:
        gain = 2.0 if settings.refine.visits else 1.0
        rows = {CAPTURED: 30.0, BASELINE: 28.0, **dict.fromkeys(plan.rows, 28.0 + gain)}
        return [
            cell(scene, row, value, seed=seed, grade="" if row == CAPTURED else grade)
            for scene in plan.scenes
            for grade in plan.grades
            for row, value in rows.items()
            for seed in plan.seeds
        ]

    monkeypatch.setattr(ablation, "run", made)
    return tmp_path


def command(monkeypatch: pytest.MonkeyPatch, given: Sequence[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["ablation", *given])
    ablation.main()


def test_all_studies_make_one_file_and_one_page(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    command(monkeypatch, [])
    results = Results.load(project / "results" / "ablation.json")
    assert set(results.studies) == {study.name for study in STUDIES}
    assert results.studies["predicted"].visits == 0 < results.studies["rows"].visits
    assert {row.adapt.steps for row in results.studies["long"].rows.values()} == {0, 400}
    page = (project / "docs" / "ablation.md").read_text()
    assert "Not measured" not in page
    assert "old" not in page.split()
    assert page.endswith("## Mine\n")
    assert page == written(results, project / "docs" / "ablation.md"), "the file gives the same page"
    assert "PSNR **+2.00 ± 0.00 dB**" in page
    assert "PSNR **+1.00 ± 0.00 dB**" in page
    assert (project / "docs" / "ablation.svg").is_file()


def test_one_study_leaves_the_others_as_they_were_measured(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    command(monkeypatch, ["--study", "grades,free_cameras"])
    before = Results.load(project / "results" / "ablation.json")
    command(monkeypatch, ["--study", "free_cameras", "refine.visits=3"])
    after = Results.load(project / "results" / "ablation.json")
    assert after.studies["grades"] == before.studies["grades"]
    assert after.studies["free_cameras"].visits == 3
    monkeypatch.setattr(ablation, "version", lambda _: "9.9.9")
    command(monkeypatch, ["--study", "free_cameras"])
    assert list(Results.load(project / "results" / "ablation.json").studies) == ["free_cameras"], (
        "another version's are gone"
    )


def test_a_table_of_ones_own_touches_neither(
    project: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (project / "docs" / "ablation.md").read_text()
    command(monkeypatch, ["--rows", "default", "--scenes", "test", "--seeds", "0"])
    shown = capsys.readouterr().out
    assert "8 test scenes" in shown
    assert "| default | 8 | 30.00 |" in shown
    assert (project / "docs" / "ablation.md").read_text() == before
    assert not (project / "results").exists()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--study", "row"], "did you mean 'rows'"),
        (["--study", "rows", "--rows", "paper"], "--study"),
        (["adapt.steps=3"], "would change every study"),
        (["--rows", "control_no_adaptation"], "ablation=corrected"),
        (["--rows", "full"], "ablation=paper"),
        (["--rows", "free_cameras"], "row 'free_cameras' changes what all rows of a table share"),
    ],
)
def test_what_cannot_be_meant_is_one_line(
    project: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], given: list[str], said: str
) -> None:
    with pytest.raises(SystemExit) as caught:
        command(monkeypatch, given)
    assert caught.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
