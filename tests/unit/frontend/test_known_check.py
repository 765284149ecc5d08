"""Matches of things that only look alike take no right pose away, and a wrong one agrees with nobody."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from sceneexpander.frontend import known_check
from sceneexpander.frontend.sfm_types import SfmConfig


@pytest.mark.parametrize(
    ("with_neighbour", "dropped"),
    [(0.95, [False, False, False]), (0.1, [False, False, True])],
    ids=["a neighbour bears it out", "nobody does"],
)
def test_a_pose_is_believed_if_one_neighbour_bears_it_out(
    monkeypatch: pytest.MonkeyPatch, with_neighbour: float, dropped: list[bool]
) -> None:
    """View 2 has 40 matches with view 1, and three times as many with view 0 that are of something else."""
    total = np.array([[0.0, 200, 120], [200, 0, 40], [120, 40, 0]])
    share = np.array([[0.0, 0.9, 0.05], [0.9, 0, with_neighbour], [0.05, with_neighbour, 0]])
    monkeypatch.setattr(known_check, "_agreeing", lambda *_: (share * total, total))
    known = SimpleNamespace(
        intrinsics=np.tile(np.eye(3), (3, 1, 1)), posed=np.ones(3, bool), cam_from_world=np.tile(np.eye(4), (3, 1, 1))
    )
    setup = SimpleNamespace(names=("a", "b", "c"), unit_px=1.0, seed=0)
    found = known_check.compare_with_matches([], [], known, SfmConfig(), setup)  # type: ignore[arg-type]
    assert found.poses.tolist() == dropped
    assert len(found.notes) == sum(dropped)
