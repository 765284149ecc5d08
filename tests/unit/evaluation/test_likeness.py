"""A render compared with a picture: what counts, what is capped and what is left out."""

from __future__ import annotations

import importlib.util

import pytest
import torch

from sceneexpander.evaluation.image import psnr, ssim
from sceneexpander.evaluation.likeness import compare_pictures
from sceneexpander.evaluation.perceptual import PACKAGE, st_lpips


def pictures(height: int = 64, width: int = 80) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(1, 3, 8, 10, generator=generator)
    wanted = torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic").clamp(0, 1)[0]
    return (wanted + 0.1 * torch.randn(wanted.shape, generator=generator)).clamp(0, 1), wanted


@pytest.mark.skipif(importlib.util.find_spec(PACKAGE) is None, reason="needs stlpips-pytorch")
@pytest.mark.parametrize("masked", [False, True])
def test_it_is_what_the_measures_say_of_what_counts(masked: bool) -> None:
    shown, wanted = pictures()
    valid = torch.ones(64, 80, dtype=torch.bool)
    valid[:, 50:] = not masked
    like = compare_pictures(shown, wanted, valid if masked else None, perceptual=True)
    assert like.st_lpips == st_lpips(shown * valid, wanted * valid)
    assert like.st_lpips > 0.001
    assert like.psnr_db == psnr(shown, wanted, valid)
    assert like.ssim == ssim(shown, wanted, valid)


def test_equal_pictures_are_capped_and_small_or_unasked_ones_have_no_st_lpips() -> None:
    shown, wanted = pictures()
    assert compare_pictures(wanted, wanted, None, perceptual=False).psnr_db == 100
    assert compare_pictures(shown, wanted, None, perceptual=False).st_lpips is None
    assert compare_pictures(*pictures(27, 80), None, perceptual=True).st_lpips is None
