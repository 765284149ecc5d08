"""Shapes that functions of the package are annotated with are checked in every unit test."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from jaxtyping import install_import_hook

from tests.support import shapes

# Not those of commands and the pipeline: they have no tensors, and what they hand to other processes must be as it is.
ROOMS = sorted(
    path.parent.name
    for path in (Path(__file__).parents[2] / "src" / "sceneexpander").glob("*/__init__.py")
    if path.parent.name not in ("cli", "config", "pipeline")
)
install_import_hook([f"sceneexpander.{room}" for room in ROOMS], f"{shapes.__name__}.check_shapes")


@pytest.fixture(autouse=True)
def shapes_as_the_test_wants(request: pytest.FixtureRequest) -> Iterator[None]:
    """On, but for tests marked ``wrong_shapes``: those hear what the package says itself."""
    if request.node.get_closest_marker("wrong_shapes") is None:
        yield
    else:
        with shapes.unchecked():
            yield
