"""ST-LPIPS as the package computes it, and without the package."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import pytest
import torch

from sceneexpander.evaluation import perceptual
from sceneexpander.evaluation.perceptual import PACKAGE, blur_pool, st_lpips

installed = pytest.mark.skipif(importlib.util.find_spec(PACKAGE) is None, reason="needs stlpips-pytorch")


def picture() -> torch.Tensor:
    """Smooth blobs, 96 x 128."""
    coarse = torch.rand(1, 3, 12, 16, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.interpolate(coarse, (96, 128), mode="bicubic", align_corners=False)[0].clamp(0, 1)


def distance(image: torch.Tensor, reference: torch.Tensor) -> float:
    value = st_lpips(image, reference)
    assert value is not None
    return value


@installed
def test_equal_pictures_have_no_distance_and_worse_ones_more() -> None:
    image = picture()
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
    assert distance(image, image) == 0
    slight, strong = (distance(image + s * noise, image) for s in (0.05, 0.2))
    assert 0 < slight < strong


@installed
def test_a_shift_by_a_pixel_costs_less_than_blur() -> None:
    """What the metric is for: the squared error says the opposite."""
    image = picture()
    shifted = image.roll(1, dims=-1)
    blurred = torch.nn.functional.avg_pool2d(image, 9, stride=1, padding=4, count_include_pad=False)
    assert float((shifted - image).square().mean()) > 0.2 * float((blurred - image).square().mean())
    assert distance(shifted, image) < 0.5 * distance(blurred, image)


@installed
def test_values_outside_a_display_do_not_count() -> None:
    image = picture()
    assert distance(image + (image == 1), image) == 0


@installed
@pytest.mark.parametrize(
    ("change", "rows", "columns", "expected"),
    [("noise", 96, 128, 0.14834869), ("shift", 96, 128, 0.04361212), ("noise", 61, 93, 0.19906735)],
)
def test_values_are_those_of_the_package_with_its_own_blur(
    change: str, rows: int, columns: int, expected: float
) -> None:
    """Recorded once with stlpips-pytorch 0.0.2 as it is."""
    image = picture()
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
    changed = image + 0.1 * noise if change == "noise" else image.roll(3, -1)
    assert distance(changed[:, :rows, :columns], image[:, :rows, :columns]) == pytest.approx(expected, abs=1e-5)


@installed
@pytest.mark.parametrize("rows", [60, 61])
@pytest.mark.parametrize("columns", [74, 75])
def test_the_first_convolution_and_its_blur_are_one_at_every_border(rows: int, columns: int) -> None:
    """Lines behind the last one are reflected; where they begin depends on whether there is an even number."""
    network = perceptual._network()
    assert network is not None
    image = picture()[None, :, :rows, :columns]
    one_by_one = blur_pool(torch.nn.functional.conv2d(image, network.weights[0], network.biases[0], padding=2))
    torch.testing.assert_close(network._first(image, 2), one_by_one, atol=1e-5, rtol=0)


@installed
def test_no_code_of_the_package_is_run() -> None:
    script = (
        "import sys, torch; from sceneexpander.evaluation.perceptual import st_lpips;"
        "st_lpips(torch.zeros(3, 64, 64), torch.ones(3, 64, 64));"
        "print([n for n in sys.modules if n.startswith('stlpips_pytorch')])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.wrong_shapes
def test_pictures_that_cannot_be_compared_are_refused() -> None:
    with pytest.raises(ValueError, match="cannot compare"):
        st_lpips(picture(), picture()[:, 1:])
    with pytest.raises(ValueError, match="non-finite"):
        st_lpips(picture() * torch.nan, picture())


def test_without_the_package_there_is_no_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(perceptual.importlib.util, "find_spec", lambda name: None)
    perceptual._network.cache_clear()
    try:
        assert st_lpips(picture(), picture()) is None
    finally:
        perceptual._network.cache_clear()
