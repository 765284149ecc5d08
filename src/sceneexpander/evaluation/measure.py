"""The door for metrics: what measures a reconstruction is given its views and renders, and answers with entries of the catalogue.

A metric is its entry in `sceneexpander.catalogue` and a `Measure`, in a file of its own, that is listed in `evaluate.MEASURES`; one from
outside the package is registered by `register_measure`. Its number is then in every row, table, page and run.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.truth import SceneTruth
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.catalogue import Metric
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.likeness import Likeness, compare_pictures
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.splatting import Render

FEWEST_PIXELS = 64  # fewer say nothing about a picture or a region
Values = Mapping[str, float | None]  # by names of the catalogue; None: not defined here


@dataclass(frozen=True, kw_only=True)
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

    @cached_property
    def likeness(self) -> Likeness:
        """Of the render and the picture at the stored size: compared once, whoever asks."""
        return compare_pictures(self.render.rgb[0], self.picture, self.valid, perceptual=self.config.st_lpips)


@dataclass(frozen=True, slots=True, kw_only=True)
class UnseenView:
    """A photo that nothing was made from, and what the reconstruction shows at its camera (`evaluation.held_out`).

    Attributes:
        picture: the photo at the stored size.
        photo: the same in its own pixels.
        valid: stored pixels that show the place; None: all.
        render: the reconstruction at the photo's camera and the stored size, on black.
        config: settings.
    """

    picture: Float[Tensor, "3 height width"]
    photo: Float[Tensor, "3 photo_height photo_width"]
    valid: Bool[Tensor, "height width"] | None
    render: Render
    config: EvaluateConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Subject:
    """What is measured: a reconstruction, its views' pictures, the camera path it is shown on, and known truth where there is any.

    ``seen`` are all its views, in its order.
    """

    reconstruction: Reconstruction
    views: ViewSet
    round_number: int
    config: EvaluateConfig
    seen: tuple[SeenView, ...]
    navigation: Cameras | None = None
    truth: SceneTruth | None = None


class Measure(Protocol):
    """Something that measures reconstructions: view by view, on held-out photos, as a whole, or all of these.

    Of numbers of captured views the row has the mean over those with a camera, and none where one of these has none; numbers of inserted
    views are in the row for the view of its round; of held-out photos it has the mean if all of them have a camera. ``metrics`` are all
    that the measure can answer with.
    """

    metrics: tuple[Metric, ...]

    def of_view(self, view: SeenView) -> Values:
        """Numbers of one view."""
        return {}

    def of_held_out(self, view: UnseenView) -> Values:
        """Numbers of one photo that nothing was made from."""
        return {}

    def of_scene(self, subject: Subject) -> Values:
        """Numbers of the reconstruction as a whole."""
        return {}


def shows_enough(view: SeenView | UnseenView) -> bool:
    """Whether enough pixels of the picture count; without them the view has no numbers, like one without a camera in the scene."""
    return view.valid is None or int(view.valid.sum()) >= FEWEST_PIXELS


def known_values(measure: Measure, values: Values) -> dict[str, float]:
    """What is defined of an answer. Raises `ValueError` for a number that the measure does not declare, or that is not finite."""
    declared = {metric.name for metric in measure.metrics}
    for name, value in values.items():
        if name not in declared:
            raise ValueError(f"{type(measure).__name__} answers with {name!r}, which is none of its metrics")
        if value is not None and not math.isfinite(value):
            raise ValueError(f"{type(measure).__name__} answers {name} = {value}, which is no number to average")
    return {name: float(value) for name, value in values.items() if value is not None}
