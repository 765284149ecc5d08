"""The page that shows the library runs as it stands."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from sceneexpander.artifacts.views import load_png
from sceneexpander.splatting.ply import read_ply

ROOT = Path(__file__).parents[2]


@pytest.mark.pipeline
@pytest.mark.timeout(1200)
def test_the_tour_expands_the_bundled_scene(tmp_path: Path) -> None:
    quick = ["profile=smoke", "frontend.sfm.max_features=1000", "frontend.sfm.learned=never"]
    subprocess.run([sys.executable, "docs/tour.py", str(tmp_path / "out"), *quick], cwd=ROOT, check=True)
    gaussians = read_ply(tmp_path / "out" / "gaussians.ply")
    assert 0 < gaussians.generated.float().mean() < 0.5
    for name in ("backbone", "expanded"):
        pictures = sorted((tmp_path / "out").glob(f"{name}_*.png"))
        assert len(pictures) == 9
        assert all(load_png(path).std() > 0.05 for path in pictures)
