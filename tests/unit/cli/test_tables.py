"""The paper's two tables from what runs have left behind."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from pathlib import Path

import pytest

from sceneexpander.artifacts.judgement import Answered, JudgedRound, MethodScore, ScoreSample
from sceneexpander.artifacts.metrics import MetricsRow, UnavailableRow
from sceneexpander.catalogue.paper import ABLATION, COMPARISON
from sceneexpander.cli.tables import ablation, comparison, read_runs, write_table
from sceneexpander.errors import UserError

ROW = MetricsRow(
    scene="yard",
    round=1,
    method="backbone",
    model="mini",
    weights_sha256="0",
    seed=0,
    values={"psnr_captured_db": 20.0},
)


def write(run: Path, row: MetricsRow | UnavailableRow) -> None:
    row.save(run / "outputs" / row.scene / f"round_{row.round}" / "metrics" / f"{row.method}.json")


def lines(run: Path) -> dict[tuple[str, str], dict[str, str]]:
    """Of the comparison, by method and who measured."""
    table, _ = comparison(read_runs([run]))
    found = list(csv.DictReader(io.StringIO(table.csv())))
    return {(line["method"], line["measured by"]): line for line in found}


def test_means_of_a_column_are_over_the_same_cases_and_what_lacks_counts_as_missing(tmp_path: Path) -> None:
    write(tmp_path, ROW)
    write(tmp_path, replace(ROW, scene="hall", values={"psnr_captured_db": 40.0}))
    write(tmp_path, replace(ROW, method="sceneexpander", values={"psnr_captured_db": 21.0, "psnr_held_out_db": 18.0}))
    found = lines(tmp_path)
    assert found["cases of the means", "here"]["PSNR ↑"] == "1"
    backbone, ours = found["mini + inserted view", "here"], found["SceneExpander on mini", "here"]
    assert (backbone["PSNR ↑"], ours["PSNR ↑"]) == ("20.000", "21.000"), "without the hall, which only one of them has"
    assert (backbone["cases missing"], ours["cases missing"]) == ("0/2", "1/2")
    assert (backbone["held-out PSNR ↑"], ours["held-out PSNR ↑"]) == ("not measured", "18.000")
    assert ours["GPT-IS ↑"] == ours["H-RQ ↑"] == "not measured"


def test_lines_that_share_no_case_have_no_mean(tmp_path: Path) -> None:
    write(tmp_path, ROW)
    write(tmp_path, replace(ROW, scene="hall", method="sceneexpander"))
    assert lines(tmp_path)["mini + inserted view", "here"]["PSNR ↑"] == "no common case"


def test_the_papers_figures_are_there_as_printed_and_labelled_as_quoted(tmp_path: Path) -> None:
    write(tmp_path, ROW)
    found = lines(tmp_path)
    for row in COMPARISON:
        line = found[row.title, "the paper, quoted"]
        printed = [line[name] for name in ("PSNR ↑", "SSIM ↑", "LPIPS ↓", "GPT-IS ↑", "GPT-RQ ↑", "H-IS ↑", "H-RQ ↑")]
        assert printed == list(row.figures.values())
        assert line["held-out PSNR ↑"] == "–"
    table, _ = ablation(None)
    quoted = {line[0]: line for line in table.lines if "quoted" in line[1]}
    assert all(set(row.figures.values()) <= set(quoted[row.title]) for row in ABLATION)


def test_methods_that_could_not_be_run_and_judges_answers_that_are_missing_are_named(tmp_path: Path) -> None:
    write(tmp_path, ROW)
    write(
        tmp_path,
        UnavailableRow(
            scene="yard", round=1, method="omnivggt", model="OmniVGGT", seed=0, reason="needs its checkpoint"
        ),
    )
    answer = Answered(request="r", number=0, model="m", created="2026", said="")
    score = MethodScore(
        method="backbone",
        criterion="insertion",
        frames=(0,),
        samples=(
            ScoreSample(answered=answer, score=4.0, confidence=0.5),
            ScoreSample(answered=replace(answer, number=1, missing="refused")),
        ),
    )
    JudgedRound(scene="yard", round=1, judge="some judge", scores=(score,)).save(tmp_path / "judged/yard/round_1", {})
    table, notes = comparison(read_runs([tmp_path]))
    text = write_table(table, notes, tmp_path / "out", "t", "T")
    assert lines(tmp_path)["mini + inserted view", "here"]["GPT-IS ↑"] == "4.00"
    assert "omnivggt: needs its checkpoint." in text
    assert "Judge: some judge." in text
    assert "backbone: 1 of 2 of the judge's answers are missing" in text
    assert "cannot be compared" in (tmp_path / "out" / "t.tex").read_text()
    assert lines(tmp_path)["OmniVGGT", "here"]["PSNR ↑"] == "not measured"


def test_runs_without_numbers_and_doubles_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds no metrics"):
        read_runs([tmp_path])
    write(tmp_path / "a", ROW)
    write(tmp_path / "b", ROW)
    with pytest.raises(UserError, match="a second time"):
        read_runs([tmp_path / "a", tmp_path / "b"])
    with pytest.raises(UserError, match=r"ablation\.json"):
        ablation(tmp_path / "ablation.json")
