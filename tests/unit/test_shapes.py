"""That annotated shapes are really checked while the unit tests run."""

from __future__ import annotations

import pytest
import torch
from jaxtyping import TypeCheckError

from sceneexpander.geometry.camera import resize_intrinsics
from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.rigid import rigid_inverse


def test_a_wrong_argument_is_noticed() -> None:
    with pytest.raises(TypeCheckError, match="a_from_b"):
        rigid_inverse(torch.eye(3))


def test_so_are_a_wrong_dtype_and_fields_of_values() -> None:
    with pytest.raises(TypeCheckError, match="intrinsics_px"):
        resize_intrinsics(torch.eye(3, dtype=torch.long), 1.0, 1.0)
    with pytest.raises(TypeCheckError, match="depth"):
        Priors(world_from_cam=torch.eye(4)[None], depth=torch.ones(2, 4, 4))


@pytest.mark.wrong_shapes
def test_where_a_test_wants_to_hear_the_package_itself_they_are_off() -> None:
    with pytest.raises((RuntimeError, IndexError)):
        rigid_inverse(torch.eye(3))
