"""What the benchmark tells a method: the true camera of the inserted view only where a grade says so."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from sceneexpander.artifacts.scene import KnownCameras
from sceneexpander.expandbench import prepared as module
from sceneexpander.expandbench.grades import GRADES
from sceneexpander.frontend.prior import FrontendConfig
from tests.worlds.artifacts import make_views


class Asked(Exception):
    """The front-end was asked; what it would find does not matter here."""


@pytest.mark.parametrize("grade", sorted(GRADES))
def test_the_truth_reaches_the_front_end_only_where_a_grade_tells_it(
    grade: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    secret = KnownCameras(world_from_cam=torch.eye(4).repeat(3, 1, 1), intrinsics_px=torch.eye(3).repeat(3, 1, 1))
    told: list[KnownCameras | None] = []

    def asked(*_: object, known: KnownCameras | None = None, **__: object) -> Any:
        told.append(known)
        raise Asked

    monkeypatch.setattr(module, "views_priors", asked)
    monkeypatch.setattr(module, "_intended_cameras", lambda *_: secret)
    scene: Any = SimpleNamespace(insert=lambda _: (make_views(1, generated=True, start=10), None))
    before: Any = SimpleNamespace(state=SimpleNamespace(views=make_views(2)))
    loaded: Any = None
    with pytest.raises(Asked):
        module.prepare_case(scene, before, GRADES[grade], loaded, FrontendConfig(), tmp_path)
    assert told == [secret if grade.startswith("told_") else None]
