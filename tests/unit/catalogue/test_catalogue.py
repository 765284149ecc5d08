"""The catalogue: whole, unambiguous, light to import, and in the order in which MLflow shows it."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest

from sceneexpander.adaptation.observe import Look
from sceneexpander.adaptation.records import StepRecord
from sceneexpander.catalogue import (
    GROUP_MEANINGS,
    LOOKS,
    METHODS,
    Group,
    Kind,
    Metric,
    Scope,
    Shown,
    Views,
    measured_metrics,
    method_named,
    metric_named,
    register,
)
from sceneexpander.catalogue.course import COURSE, DRIFT_ALL
from sceneexpander.catalogue.document import metrics_document
from sceneexpander.catalogue.metrics import JUDGED
from sceneexpander.errors import UserError
from sceneexpander.evaluation.evaluate import MEASURES
from sceneexpander.tracking.tracked import tracked_step


def numeric(kind: type) -> set[str]:
    return {f.name for f in fields(kind) if str(f.type).split(" | ")[0] in ("float", "int")}


def test_it_is_light() -> None:
    heavy = "{name.partition('.')[0] for name in sys.modules} & {'torch', 'numpy', 'PIL', 'hydra'}"
    code = f"import sys, sceneexpander.catalogue; raise SystemExit(bool({heavy}))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_every_number_of_a_step_and_a_look_is_in_it() -> None:
    inserted = dict.fromkeys(numeric(StepRecord), 1.0)
    assert len(tracked_step(inserted, inserted=True)) == len(numeric(StepRecord) - {"step", "captured", "restored"})
    assert {metric.name for metric in LOOKS} - {DRIFT_ALL.name} == numeric(Look) - {"step"}


def test_what_is_measured_is_measured_by_one_measure() -> None:
    answered = [metric.name for measure in MEASURES for metric in measure.metrics]
    assert len(set(answered)) == len(answered)
    # Counted by `evaluate` itself, a difference of two rows, a judge's, and the benchmark's.
    elsewhere = {"views_captured", "views_captured_posed", "views_generated", "repeats", "tour_covered_gained"}
    elsewhere |= {metric.name for metric in JUDGED}
    elsewhere |= {metric.name for metric in measured_metrics() if metric.scope.views is Views.HELD_OUT}
    assert {metric.name for metric in measured_metrics()} == set(answered) | elsewhere


def test_names_are_unambiguous_and_such_as_mlflow_takes() -> None:
    every = (*measured_metrics(), *COURSE)
    for names in ([item.tracked for item in every], [item.name for item in measured_metrics()]):
        assert len(set(names)) == len(names)
    for item in every:
        assert re.fullmatch(r"\d_[a-z]+/[a-z0-9_]+", item.tracked), item.tracked
    titles = [item.title for item in measured_metrics()]
    assert len(set(titles)) == len(titles), "two numbers with one heading"
    assert set(GROUP_MEANINGS) == set(Group)


def test_sorted_by_name_quality_comes_first() -> None:
    names = sorted(item.tracked for item in (*measured_metrics(shown=Shown.PAGE), *COURSE))
    assert names[0] == "1_quality/psnr_at_photo_size_db"
    assert [group for group in Group if any(name.startswith(group) for name in names)] == list(
        dict.fromkeys(Group(name.partition("/")[0]) for name in names)
    )


def test_printed_numbers_have_their_unit_once() -> None:
    share = metric_named("seen_through_at_photo_size")
    assert (share.text(0.125), share.text_with_unit(0.125), share.bare(0.125)) == ("12.5 %", "12.5 %", "12.5")
    assert (share.heading, share.column) == ("Open", "Open, % \u2193")
    psnr = metric_named("psnr_at_photo_size_db")
    assert (psnr.text(20), psnr.text_with_unit(20), psnr.bare(20, sign=True)) == ("20.00", "20.00 dB", "+20.00")
    assert psnr.text_with_unit(None) == "\u2013"


def test_a_name_is_given_once() -> None:
    psnr = metric_named("psnr_captured_db")
    register(psnr)
    with pytest.raises(ValueError, match="another metric 'psnr_captured_db'"):
        register(Metric(name=psnr.name, group=Group.COST, title="x", scope=Scope(views=Views.NONE)))
    for name in ("PSNR", "a-b", "own.psnr"):
        with pytest.raises(ValueError, match="no name of a metric"):
            Metric(name=name, group=Group.COST, title="x", scope=Scope(views=Views.NONE))


def test_what_is_misspelt_is_one_line_with_a_suggestion() -> None:
    with pytest.raises(UserError, match="ssim_captured"):
        metric_named("ssim_capturd")
    with pytest.raises(UserError, match="backbone"):
        method_named("backbon")


def test_methods_start_from_methods() -> None:
    names = [method.name for method in METHODS]
    assert len(set(names)) == len(names)
    for method in METHODS:
        assert (method.starts_from is not None) is (method.kind is Kind.OPTIMISED)
        if method.starts_from is not None:
            assert method_named(method.starts_from).kind is not Kind.OPTIMISED
    assert len({method.title for method in METHODS}) == len(names)


def test_the_page_about_the_metrics_is_what_the_catalogue_says() -> None:
    page = Path(__file__).parents[3] / "docs" / "metrics.md"
    assert page.read_text(encoding="utf-8") == metrics_document(), "run: python -m sceneexpander.catalogue.document"
