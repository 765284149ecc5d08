"""``python -m sceneexpander.catalogue.document``: the page about all metrics, ``docs/metrics.md``."""

from __future__ import annotations

import sys

from sceneexpander.catalogue.metrics import ARROWS, GROUP_MEANINGS, Group, Metric, Scope, measured_metrics
from sceneexpander.catalogue.table import Table

_HEAD = """# What is measured

Written by `python -m sceneexpander.catalogue.document`. A name is the same in `metrics.json`, `results/metrics.json`, the benchmark, and in
MLflow behind its group. Shares are from 0 to 1 there, and in percent where people read them. An arrow says which way is better. Numbers of
captured views are means over those with a camera; what is not defined is left out."""


def metrics_document() -> str:
    """Every metric of a reconstruction by group, as Markdown."""
    parts = [_HEAD]
    for group in Group:
        metrics = measured_metrics(group)
        if metrics:
            table = Table(header=("name", "title", "unit", "on"), lines=tuple(map(_line, metrics)), left=4)
            parts.append(f"## `{group}`: {GROUP_MEANINGS[group]}\n\n{table.markdown()}".rstrip())
    return "\n\n".join(parts) + "\n"


def _line(metric: Metric) -> tuple[str, ...]:
    return f"`{metric.name}`", f"{metric.title} {ARROWS[metric.better]}".rstrip(), metric.unit, _scope(metric.scope)


def _scope(scope: Scope) -> str:
    words = [
        f"{scope.views} views" if scope.views in ("captured", "inserted", "earlier", "held_out") else str(scope.views)
    ]
    words += [f"{scope.size} size"] if scope.size != "stored" else []
    words += [f"{scope.region} pixels"] if scope.region != "all" else []
    return ", ".join(words).replace("held_out", "held-out").replace("none", "the whole")


if __name__ == "__main__":
    sys.stdout.write(metrics_document())
