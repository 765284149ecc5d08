"""Shapes that functions of the package are annotated with are checked in every unit test."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
from jaxtyping import install_import_hook

from tests.support import shapes

# Where tensors of several sources meet. Checks cost a fifth of the time of what is checked, so rooms that loop over small ones go without.
ROOMS = (
    "adaptation",
    "artifacts",
    "evaluation",
    "expandbench",
    "expansion",
    "exports",
    "generation",
    "geometry",
    "inference",
    "ingest",
    "insertion",
    "judge",
    "models",
    "optimisation",
    "photometric",
    "rendering",
)
# DVC would start a process for each of its commands that tries to reach its makers, and leave a file where there is no network.
os.environ["DVC_NO_ANALYTICS"] = "true"
install_import_hook([f"sceneexpander.{room}" for room in ROOMS], f"{shapes.__name__}.check_shapes")


@pytest.fixture(autouse=True)
def shapes_as_the_test_wants(request: pytest.FixtureRequest) -> Iterator[None]:
    """On, but for tests marked ``wrong_shapes``: those hear what the package says itself."""
    if request.node.get_closest_marker("wrong_shapes") is None:
        yield
    else:
        with shapes.unchecked():
            yield
