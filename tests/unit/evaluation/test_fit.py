"""What was done to a method's Gaussians is read from what lies beside them."""

from __future__ import annotations

from pathlib import Path

import pytest

from sceneexpander.artifacts.metrics import Fit, MetricsRow
from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.catalogue import METHODS, Kind
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.evaluate import evaluate
from stages import layout
from stages.evaluate import fit_of
from stages.runner import Cell
from tests.worlds.wall import made_reconstruction, own_pictures


@pytest.mark.parametrize(
    ("method", "after", "wanted"),
    [
        ("backbone", 0.1, Fit.FITTED),
        ("omnivggt", 0.1, Fit.FITTED),
        ("backbone", 0.3, Fit.PREDICTED),  # it did not help and was taken back
        ("corrected", None, Fit.PREDICTED),
        ("gaussian_splatting", None, Fit.OPTIMISED),
        ("sceneexpander_optimised", None, Fit.OPTIMISED),
    ],
)
def test_a_fit_counts_if_it_was_kept(
    method: str, after: float | None, wanted: Fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if after is not None:
        beside = layout.reconstruction("s", 1, method).parent / layout.REFINEMENT
        write_json_atomic(beside, {"steps": 4, "before": 0.2, "after": after})
    assert fit_of(Cell(scene="s", round=1, method=method)) is wanted


def test_only_methods_that_optimise_need_no_mark_for_it() -> None:
    optimised = [method for method in METHODS if method.kind is Kind.OPTIMISED]
    assert all("optimis" in method.title or method.name in ("gaussian_splatting",) for method in optimised)
    assert not any("optimis" in method.title for method in METHODS if method not in optimised)


def test_it_is_kept_with_the_numbers(tmp_path: Path) -> None:
    scene = made_reconstruction()
    made = evaluate(scene, own_pictures(scene), EvaluateConfig(), scene="m", round_number=1, seed=0, fit=Fit.FITTED)
    made.save(tmp_path / "row.json")
    assert MetricsRow.load(tmp_path / "row.json").fit is Fit.FITTED
