"""Keypoints and matches of before: looked for once, the same to the last bit, and of no use to anything else."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sceneexpander.artifacts.store import ArtifactError, load_artifact, save_artifact
from sceneexpander.frontend import learned, memory
from sceneexpander.frontend.memory import MatchMemory
from sceneexpander.frontend.sfm import estimate_cameras
from sceneexpander.frontend.sfm_types import LearnedUse, SfmConfig, SparseReconstruction
from sceneexpander.reconstruction.memory import SCHEMA, load_memory, save_memory
from sceneexpander.synthetic import SyntheticViews, make_views

USE = LearnedUse.ALWAYS if learned.is_installed() else LearnedUse.NEVER
CONFIG = SfmConfig(max_features=600, learned=USE, learned_features=512, learned_long_side_px=320, focal_starts=(0.85,))


@pytest.fixture(scope="module")
def views() -> SyntheticViews:
    return make_views(1, views=4, height=180, width=240, kind="room", split="test")


def estimate(images: torch.Tensor, remembered: MatchMemory | None) -> SparseReconstruction:
    return estimate_cameras(images, CONFIG, generator=torch.Generator().manual_seed(0), memory=remembered)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often each of the four is done."""
    counts: Counter[str] = Counter()
    for module, name in (
        (memory, "detect_features"),
        (memory, "match_descriptors"),
        (learned, "detect_learned"),
        (learned, "match_learned"),
    ):

        def counted(*arguments: object, name: str = name, done: object = getattr(module, name)) -> object:
            counts[name] += 1
            return done(*arguments)  # type: ignore[operator]

        monkeypatch.setattr(module, name, counted)
    return counts


def test_a_view_that_joins_is_all_that_is_looked_at(views: SyntheticViews, asked: Counter[str], tmp_path: Path) -> None:
    before = MatchMemory()
    estimate(views.images[:3], before)
    save_memory(tmp_path, before)
    asked.clear()
    alone = estimate(views.images, None)
    whole = Counter(asked)
    asked.clear()
    found = estimate(views.images, load_memory(tmp_path))
    assert whole["detect_features"] == 4
    assert whole["match_descriptors"] == 6
    assert asked["detect_features"] == 1
    assert asked["match_descriptors"] == 3
    assert asked["detect_learned"] == (USE is LearnedUse.ALWAYS)
    assert asked["match_learned"] == whole["match_learned"] / 2
    assert torch.equal(found.world_from_cam, alone.world_from_cam)
    assert torch.equal(found.intrinsics_px, alone.intrinsics_px)
    assert torch.equal(found.sparse.points_world, alone.sparse.points_world)


def test_other_pictures_and_other_settings_find_nothing(asked: Counter[str]) -> None:
    grey = np.random.default_rng(0).integers(0, 256, (60, 80), dtype=np.uint8)
    remembered = MatchMemory()
    remembered.detect_features(grey, CONFIG)
    remembered.detect_features(grey, CONFIG)
    assert asked["detect_features"] == 1
    changed = grey.copy()
    changed[0, 0] ^= 1
    remembered.detect_features(changed, CONFIG)
    remembered.detect_features(grey, replace(CONFIG, max_features=10))
    remembered.detect_features(grey.reshape(80, 60), CONFIG)
    assert asked["detect_features"] == 4


@pytest.mark.parametrize("kind", ["missing", "type", "table"])
def test_a_damaged_one_is_refused(kind: str, tmp_path: Path) -> None:
    remembered = MatchMemory()
    remembered.detect_features(np.random.default_rng(0).integers(0, 256, (60, 80), dtype=np.uint8), CONFIG)
    save_memory(tmp_path / "whole", remembered)
    _, tensors = load_artifact(tmp_path / "whole", SCHEMA)
    name = next(name for name in tensors if name.endswith("pixel_xy"))
    if kind == "missing":
        del tensors[name]
    elif kind == "type":
        tensors[name] = tensors[name].float()
    else:
        tensors["other/0/pixel_xy"] = tensors[name].clone()
    save_artifact(tmp_path / "damaged", SCHEMA, {}, tensors)
    with pytest.raises(ArtifactError):
        load_memory(tmp_path / "damaged")
