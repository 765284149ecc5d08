"""All numbers about one reconstruction as one row."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import fields
from importlib.metadata import PackageNotFoundError, version

from sceneexpander.artifacts.held_out import HeldOut
from sceneexpander.artifacts.metrics import Fit, MetricsRow, ViewMetrics
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.truth import SceneTruth
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.catalogue import register
from sceneexpander.catalogue.metrics import metrics_named
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.earlier import EarlierRegions
from sceneexpander.evaluation.held_out import Show, Unseen, measure_held_out
from sceneexpander.evaluation.measure import Measure, Subject, Values, known_values
from sceneexpander.evaluation.sizes import AtOtherSizes
from sceneexpander.evaluation.tour import TourConsistency
from sceneexpander.evaluation.truth import InsertedRegions, TruthMetrics, against_truth
from sceneexpander.evaluation.views import AtStoredSize, FromOthers, TourCoverage, measure_views, see_views
from sceneexpander.evaluation.visual import Visual
from sceneexpander.geometry.cameras import Cameras

NOTHING_HELD_OUT = HeldOut()


class Counts(Measure):
    """How many Gaussians there are."""

    metrics = metrics_named("gaussians", "gaussians_generated")

    def of_scene(self, subject: Subject) -> Values:
        """Of the reconstruction as it is."""
        gaussians = subject.reconstruction.gaussians
        return {"gaussians": len(gaussians), "gaussians_generated": int(gaussians.generated.sum())}


class AgainstTruth(Measure):
    """Errors of cameras and depths where the truth is known: see `TruthMetrics`."""

    metrics = metrics_named(*(f.name for f in fields(TruthMetrics)))

    def of_scene(self, subject: Subject) -> Values:
        """Nothing without truth."""
        if subject.truth is None:
            return {}
        found = against_truth(subject.reconstruction, subject.views, subject.truth, round_number=subject.round_number)
        return {metric.name: getattr(found, metric.name) for metric in self.metrics}


MEASURES: list[Measure] = [
    AtStoredSize(),
    Unseen(),
    Visual(),
    FromOthers(),
    AtOtherSizes(),
    TourCoverage(),
    EarlierRegions(),
    TourConsistency(),
    AgainstTruth(),
    InsertedRegions(),
    Counts(),
]


def register_measure(measure: Measure) -> None:
    """Have a measure from outside the package taken in every evaluation, and its metrics shown wherever metrics are.

    Raises:
        ValueError: a metric's name is that of another one, or another measure answers with it.
    """
    for other in MEASURES:
        if both := {metric.name for metric in measure.metrics} & {metric.name for metric in other.metrics}:
            raise ValueError(f"{type(other).__name__} answers with {min(both)!r} already")
    register(*measure.metrics)
    MEASURES.append(measure)


def evaluate(
    reconstruction: Reconstruction,
    views: ViewSet,
    config: EvaluateConfig,
    *,
    scene: str,
    round_number: int,
    seed: int,
    navigation: Cameras | None = None,
    truth: SceneTruth | None = None,
    held_out: HeldOut = NOTHING_HELD_OUT,
    fit: Fit = Fit.PREDICTED,
    show_held_out: Show | None = None,
) -> MetricsRow:
    """Measure a reconstruction.

    Args:
        reconstruction: of captured and perhaps generated views.
        views: pictures of at least the reconstruction's views.
        config: settings.
        scene: name for the row.
        round_number: the round; numbers of an inserted view are of the one inserted in it, if the reconstruction has it with a pose.
        seed: for the row.
        navigation: frames for the coverage, if wanted.
        truth: known truth, if any.
        held_out: photos that the reconstruction was not made from, matched with the captured ones.
        fit: what was done to its Gaussians after they were predicted.
        show_held_out: is given what is seen at the cameras of held-out photos.
    """
    seen = see_views(reconstruction, views, config)
    captured = measure_views(seen, MEASURES, generated=False)
    inserted = measure_views(seen, MEASURES, generated=True)
    unseen = measure_held_out(reconstruction, held_out, seen, config, MEASURES, show_held_out)
    if not captured:
        raise ValueError("the reconstruction has no captured view")
    in_this_round = {record.view_id for record in views.records if record.round == round_number}
    new = next((row for row in inserted if row.view_id in in_this_round and row.posed), None)
    posed = tuple(row for row in captured if row.posed)
    subject = Subject(
        reconstruction=reconstruction,
        views=views,
        round_number=round_number,
        config=config,
        seen=seen,
        navigation=navigation,
        truth=truth,
    )
    values = {
        "views_captured": float(len(captured)),
        "views_captured_posed": float(len(posed)),
        "views_generated": float(len(inserted)),
        **_means(posed or captured),
        **({} if new is None else new.values),
        **_of_held_out(unseen),
    }
    for measure in MEASURES:
        values |= known_values(measure, measure.of_scene(subject))
    return MetricsRow(
        scene=scene,
        round=round_number,
        method=reconstruction.method,
        model=reconstruction.model,
        weights_sha256=reconstruction.weights_sha256,
        seed=seed,
        fit=fit,
        values=values,
        views=(*captured, *inserted),
        held_out=unseen,
        versions=_versions(),
    )


def _of_held_out(rows: Sequence[ViewMetrics]) -> dict[str, float]:
    """Means over all held-out photos, and none where one has no camera: a method must not gain by what it cannot show."""
    if not rows:
        return {}
    posed = [row for row in rows if row.posed]
    counts = {"views_held_out": float(len(rows)), "views_held_out_posed": float(len(posed))}
    return counts | (_means(rows) if len(posed) == len(rows) else {})


def _means(rows: Sequence[ViewMetrics]) -> dict[str, float]:
    """Means over the views of what all of them have: a mean over fewer views is another number."""
    names = [name for name in rows[0].values if all(name in row.values for row in rows)]
    return {name: sum(row.values[name] for row in rows) / len(rows) for name in names}


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in ("sceneexpander", "torch", "numpy"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "source"
    return found
