"""The door for metrics: what measures a reconstruction is given its views and renders, and answers with entries of the catalogue.

A metric is its entry in `sceneexpander.catalogue` and a `Measure`, in a file of its own, that is listed in `evaluate.MEASURES`; one from
outside the package is registered by `register_measure`. Its number is then in every row, table, page and run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.truth import SceneTruth
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.catalogue import Metric
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.splatting import Render

Values = Mapping[str, float | None]  # by names of the catalogue; None: not defined here


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenView:
    """One view of a reconstruction and what its own camera sees of it.

    Attributes:
        reconstruction: all of it.
        index: of the view in it.
        picture: the view's picture at the stored size.
        photo: the same in its own pixels.
        valid: stored pixels that show the place; None: all.
        render: the reconstruction at the view's own camera and the stored size, on black.
        config: settings.
    """

    reconstruction: Reconstruction
    index: int
    picture: Float[Tensor, "3 height width"]
    photo: Float[Tensor, "3 photo_height photo_width"]
    valid: Bool[Tensor, "height width"] | None
    render: Render
    config: EvaluateConfig

    @property
    def generated(self) -> bool:
        """Whether it is an inserted view: metrics of captured and of inserted views have different names."""
        return bool(self.reconstruction.generated[self.index])


@dataclass(frozen=True, slots=True, kw_only=True)
class Subject:
    """What is measured: a reconstruction, its views' pictures, the camera path it is shown on, and known truth where there is any."""

    reconstruction: Reconstruction
    views: ViewSet
    round_number: int
    config: EvaluateConfig
    navigation: Cameras | None = None
    truth: SceneTruth | None = None


class Measure(Protocol):
    """Something that measures reconstructions: view by view, as a whole, or both.

    Of numbers of captured views the row has the mean over those with a camera, and none where one of these has none; numbers of inserted
    views are in the row for the view of its round. ``metrics`` are all that the measure can answer with.
    """

    metrics: tuple[Metric, ...]

    def of_view(self, view: SeenView) -> Values:
        """Numbers of one view."""
        return {}

    def of_scene(self, subject: Subject) -> Values:
        """Numbers of the reconstruction as a whole."""
        return {}


def known_values(measure: Measure, values: Values) -> dict[str, float]:
    """What is defined of an answer. Raises `ValueError` for a number that the measure does not declare."""
    declared = {metric.name for metric in measure.metrics}
    for name in values:
        if name not in declared:
            raise ValueError(f"{type(measure).__name__} answers with {name!r}, which is none of its metrics")
    return {name: float(value) for name, value in values.items() if value is not None}
