"""Shapes that functions of the package are annotated with are checked in every unit test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from jaxtyping import install_import_hook

from tests.support import shapes

install_import_hook("sceneexpander", f"{shapes.__name__}.check_shapes")


@pytest.fixture(autouse=True)
def shapes_as_the_test_wants(request: pytest.FixtureRequest) -> Iterator[None]:
    """On, but for tests marked ``wrong_shapes``: those hear what the package says itself."""
    if request.node.get_closest_marker("wrong_shapes") is None:
        yield
    else:
        with shapes.unchecked():
            yield
