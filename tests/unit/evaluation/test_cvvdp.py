"""ColorVideoVDP as its package computes it with torchvision's blur, and without the package."""

from __future__ import annotations

import dataclasses
import importlib.util
import subprocess
import sys

import pytest
import torch

from sceneexpander.evaluation import cvvdp as module
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.cvvdp import PACKAGE, cvvdp
from sceneexpander.evaluation.evaluate import evaluate
from tests.worlds.wall import made_reconstruction, own_pictures

installed = pytest.mark.skipif(importlib.util.find_spec(PACKAGE) is None, reason="needs cvvdp")


def picture() -> torch.Tensor:
    """Smooth blobs, 96 x 128."""
    coarse = torch.rand(1, 3, 12, 16, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.interpolate(coarse, (96, 128), mode="bicubic", align_corners=False)[0].clamp(0, 1)


@installed
@pytest.mark.parametrize(
    ("change", "rows", "columns", "expected"),
    [("noise", 96, 128, 9.3271523), ("noise", 61, 93, 9.3502750), ("shift", 96, 128, 7.2192135)],
)
def test_values_are_those_of_the_package_with_torchvision(
    change: str, rows: int, columns: int, expected: float
) -> None:
    """Recorded once with cvvdp 0.5.7 and torchvision 0.28.0."""
    image = picture()
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
    changed = image + 0.1 * noise if change == "noise" else image.roll(3, -1)
    assert cvvdp(changed[:, :rows, :columns], image[:, :rows, :columns]) == pytest.approx(expected, abs=1e-4)


@installed
def test_equal_pictures_have_10_and_it_is_in_the_row_of_who_asks() -> None:
    assert cvvdp(picture(), picture()) == 10
    scene = made_reconstruction()
    config = EvaluateConfig(st_lpips=False, flip=False, ghosting=False)
    row = evaluate(scene, own_pictures(scene), config, scene="s", round_number=1, seed=0)
    assert not any(name.startswith("cvvdp") for name in row.values)
    asked = dataclasses.replace(config, cvvdp=True)
    row = evaluate(scene, own_pictures(scene), asked, scene="s", round_number=1, seed=0)
    assert row.values["cvvdp_captured"] > 9.5
    assert row.values["cvvdp_inserted"] > 9.5


@installed
def test_nothing_of_the_package_stays_behind() -> None:
    script = (
        "import sys, torch; from sceneexpander.evaluation.cvvdp import cvvdp; path = list(sys.path);"
        "cvvdp(torch.zeros(3, 32, 32), torch.ones(3, 32, 32));"
        "names = ('pycvvdp', 'ffmpeg', 'torchvision', 'interp', 'third_party');"
        "print([n for n in sys.modules if n.partition('.')[0] in names], sys.path == path)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[-2] == "[] True"


@pytest.mark.wrong_shapes
def test_pictures_that_cannot_be_compared_are_refused() -> None:
    with pytest.raises(ValueError, match="cannot compare"):
        cvvdp(picture(), picture()[:, 1:])
    with pytest.raises(ValueError, match="non-finite"):
        cvvdp(picture() * torch.nan, picture())


def test_without_the_package_there_is_no_number_and_one_line(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    module._metric.cache_clear()
    try:
        assert cvvdp(picture(), picture()) is None
        assert cvvdp(picture(), picture()) is None
        assert [record.getMessage() for record in caplog.records] == [
            "the package cvvdp is not installed: no CVVDP; pip install --no-deps cvvdp==0.5.7"
        ]
    finally:
        module._metric.cache_clear()
