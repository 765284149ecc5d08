"""Every method and every metric, once. Tables, report, viewer, tracking and benchmark take names, titles and units from here."""

from sceneexpander.catalogue.course import LOOKS, OBJECTIVES, STEPS
from sceneexpander.catalogue.methods import MAIN, METHODS, Kind, Method, method_named
from sceneexpander.catalogue.metrics import (
    ARROWS,
    GROUP_MEANINGS,
    MEASURED,
    Group,
    Metric,
    Region,
    Scope,
    Shown,
    Size,
    Views,
    measured_metrics,
    metric_named,
    register,
)
from sceneexpander.catalogue.table import Table

__all__ = [
    "ARROWS",
    "GROUP_MEANINGS",
    "LOOKS",
    "MAIN",
    "MEASURED",
    "METHODS",
    "OBJECTIVES",
    "STEPS",
    "Group",
    "Kind",
    "Method",
    "Metric",
    "Region",
    "Scope",
    "Shown",
    "Size",
    "Table",
    "Views",
    "measured_metrics",
    "method_named",
    "metric_named",
    "register",
]
