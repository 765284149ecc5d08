"""A reason travels through the pipeline in the place of a result."""

from __future__ import annotations

from pathlib import Path

import pytest

from sceneexpander.artifacts.metrics import MetricsRow, UnavailableRow, load_row
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.store import ArtifactError
from sceneexpander.artifacts.unavailable import Unavailable, passed_on, unavailable_in
from tests.worlds.wall import made_reconstruction

REASON = Unavailable(method="ttt3r", model="ttt3r", reason="needs the public checkpoint")


def test_a_reason_is_told_from_a_result(tmp_path: Path) -> None:
    REASON.save(tmp_path / "reason")
    made_reconstruction().save(tmp_path / "result")
    assert unavailable_in(tmp_path / "reason") == REASON
    assert unavailable_in(tmp_path / "result") is None
    with pytest.raises(ArtifactError, match="nothing"):
        unavailable_in(tmp_path / "nothing")


def test_a_reason_is_passed_on_and_a_result_is_not(tmp_path: Path) -> None:
    REASON.save(tmp_path / "reason")
    made_reconstruction().save(tmp_path / "result")
    assert passed_on(tmp_path / "reason", tmp_path / "renders")
    assert unavailable_in(tmp_path / "renders") == REASON
    assert not passed_on(tmp_path / "result", tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_nobody_reads_a_reason_as_a_result(tmp_path: Path) -> None:
    REASON.save(tmp_path)
    with pytest.raises(ArtifactError, match=r"unavailable/1.*expected 'reconstruction/1'"):
        Reconstruction.load(tmp_path)


def test_a_row_says_which_kind_it_is(tmp_path: Path) -> None:
    row = UnavailableRow(scene="room", round=1, method="ttt3r", model="ttt3r", seed=0, reason="needs more views")
    row.save(tmp_path / "row.json")
    assert load_row(tmp_path / "row.json") == row
    with pytest.raises(ArtifactError, match="not of schema"):
        MetricsRow.load(tmp_path / "row.json")
    (tmp_path / "row.json").write_text('{"schema": "metrics-unavailable/1", "scene": "room"}')
    with pytest.raises(ArtifactError, match="invalid"):
        load_row(tmp_path / "row.json")
