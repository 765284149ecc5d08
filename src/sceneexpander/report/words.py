"""What the report calls things."""

from __future__ import annotations

from sceneexpander.artifacts.metrics import Fit
from sceneexpander.artifacts.source_type import MADE_BY_MODEL, MADE_FROM_SCENE
from sceneexpander.catalogue import Group, Metric, Shown, measured_metrics
from sceneexpander.catalogue.methods import method_title

# How an inserted picture came to be, as far as that is known.
PICTURE_KINDS = {
    MADE_BY_MODEL: "AI-generated picture",
    MADE_FROM_SCENE: "Picture rendered from the scene itself, with parts that nobody captured",
}
LAYERS = (("rgb", "Colour"), ("depth", "Depth"), ("provenance", "Provenance"))


def number_tables() -> tuple[tuple[str, tuple[Metric, ...]], ...]:
    """The tables of numbers: heading and columns, few enough to be read without scrolling sideways."""
    return (
        ("The photos", measured_metrics(Group.QUALITY, shown=Shown.PAGE)),
        ("The inserted view", measured_metrics(Group.INSERTION, shown=Shown.PAGE)),
        ("Against known truth", measured_metrics(Group.GEOMETRY, shown=Shown.PAGE)),
    )


def method_label(name: str, model: str, fit: Fit = Fit.PREDICTED) -> str:
    """A method's title with the reconstructor's name, its fit marked. Unknown methods go by their names."""
    return method_title(name, model) + fit.mark
