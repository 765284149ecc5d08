"""Damaged files of every kind end as a value or as one line; `scripts/fuzz_readers.py` by itself runs many more."""

from __future__ import annotations

import pytest
from fuzz_readers import damage, targets

pytestmark = pytest.mark.timeout(120)


def test_damaged_files_of_every_kind_are_one_line() -> None:
    with targets() as found:
        assert {"ply", "spz4", "zip", "scene.yaml", "artifact.json", "depth-npy", "metashape-cameras.xml"} <= set(found)
        for name, target in found.items():
            refused, wrong = damage(target, 12, seed=1)
            assert not wrong, f"{name}: {wrong[0][1]}"
            assert refused, f"{name}: damage is never noticed"
            target.read()
