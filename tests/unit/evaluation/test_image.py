"""PSNR and SSIM against closed forms, a slow twin, and scikit-image."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from sceneexpander.evaluation.image import psnr, ssim, ssim_map
from sceneexpander.geometry.randomness import child_generator


def pair(height: int = 40, width: int = 53, noise: float = 0.1, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = child_generator(seed, "pair")
    image = torch.rand(3, height // 4 + 1, width // 4 + 1, generator=generator)
    image = torch.nn.functional.interpolate(image[None], size=(height, width), mode="bilinear")[0]
    return image, (image + noise * torch.randn(image.shape, generator=generator)).clamp(0, 1)


@pytest.mark.parametrize("noise", [0.003, 0.05, 0.3])
@pytest.mark.parametrize("seed", [0, 1])
def test_agreement_with_scikit_image(noise: float, seed: int) -> None:
    skimage = pytest.importorskip("skimage.metrics")
    a, b = pair(noise=noise, seed=seed)
    x, y = a.double().numpy(), b.double().numpy()
    # Both in double precision: only the order of summation differs.
    assert psnr(a, b) == pytest.approx(skimage.peak_signal_noise_ratio(x, y, data_range=1.0), abs=1e-6)
    expected, full = skimage.structural_similarity(
        x, y, data_range=1.0, channel_axis=0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True
    )
    assert ssim(a, b) == pytest.approx(expected, abs=1e-6)
    assert np.allclose(ssim_map(a, b).numpy(), full[:, 5:-5, 5:-5], atol=1e-6)


def test_psnr_closed_form() -> None:
    flat = torch.full((3, 12, 12), 0.5)
    assert psnr(flat, flat + 0.1) == pytest.approx(20.0, abs=1e-5)
    assert psnr(flat, flat) == math.inf
    one = flat.clone()
    one[0, 0, 0] += 0.5
    assert psnr(one, flat) == pytest.approx(-10 * math.log10(0.25 / 432), abs=1e-5)


def test_ssim_of_flat_images_is_the_luminance_term() -> None:
    a, b = torch.full((3, 20, 20), 0.2), torch.full((3, 20, 20), 0.6)
    expected = (2 * 0.2 * 0.6 + 1e-4) / (0.2**2 + 0.6**2 + 1e-4)
    assert ssim(a, b) == pytest.approx(expected, abs=1e-6)
    assert ssim(a, a) == pytest.approx(1.0, abs=1e-12)


def test_ssim_map_against_explicit_windows() -> None:
    a, b = pair(14, 17)
    offsets = np.arange(11) - 5
    weights = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    weights /= weights.sum()
    found = ssim_map(a, b)
    assert found.shape == (3, 4, 7)
    for c, y, x in ((0, 0, 0), (1, 3, 6), (2, 2, 4)):
        u, v = (t[c, y : y + 11, x : x + 11].double().numpy() for t in (a, b))
        mu, mv = (weights * u).sum(), (weights * v).sum()
        su, sv = (weights * (u - mu) ** 2).sum(), (weights * (v - mv) ** 2).sum()
        suv = (weights * (u - mu) * (v - mv)).sum()
        value = (2 * mu * mv + 1e-4) * (2 * suv + 9e-4) / ((mu**2 + mv**2 + 1e-4) * (su + sv + 9e-4))
        assert float(found[c, y, x]) == pytest.approx(value, abs=1e-9)


def test_symmetry_and_clamping() -> None:
    a, b = pair()
    assert ssim(a, b) == pytest.approx(ssim(b, a), abs=1e-12)
    assert psnr(a, b) == pytest.approx(psnr(b, a), abs=1e-12)
    assert psnr(a * 0 + 3.0, a * 0 + 1.0) == math.inf  # what a display shows of 3.0 is 1.0


def test_masks() -> None:
    a, b = pair()
    mask = torch.zeros(a.shape[1:], dtype=torch.bool)
    mask[10:30, 20:40] = True
    assert psnr(a, b, mask) == pytest.approx(psnr(a[:, 10:30, 20:40], b[:, 10:30, 20:40]), abs=1e-9)
    # Windows centred in the mask, which may look beyond it: those of the mask grown by the window's half width.
    assert ssim(a, b, mask) == pytest.approx(ssim(a[:, 5:35, 15:45], b[:, 5:35, 15:45]), abs=1e-9)
    everything = torch.ones_like(mask)
    assert psnr(a, b, everything) == pytest.approx(psnr(a, b), abs=1e-9)
    assert ssim(a, b, everything) == pytest.approx(ssim(a, b), abs=1e-12)
    outside = b.clone()
    outside[:, ~mask] = 0
    assert psnr(a, outside, mask) == pytest.approx(psnr(a, b, mask), abs=1e-9)


@pytest.mark.wrong_shapes
def test_refusals() -> None:
    a, b = pair()
    nothing = torch.zeros(a.shape[1:], dtype=torch.bool)
    with pytest.raises(ValueError, match="no pixel"):
        psnr(a, b, nothing)
    nothing[0, 0] = True  # no window fits around a corner
    with pytest.raises(ValueError, match="no window"):
        ssim(a, b, nothing)
    with pytest.raises(ValueError, match="cannot compare"):
        psnr(a, b[:, :-1])
    with pytest.raises(ValueError, match="non-finite"):
        ssim(a, b * math.nan)
    with pytest.raises(ValueError, match="at least 11"):
        ssim(a[:, :10], b[:, :10])
    with pytest.raises(ValueError, match="expected bool"):
        psnr(a, b, torch.ones(a.shape[1:]))
