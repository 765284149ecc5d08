"""PSNR and SSIM, exactly.

Images are RGB in [0, 1]; values outside are clamped first, because that is what a display or a PNG would show. Sums are in double
precision.

- PSNR = 10 log10(1 / MSE), with one MSE over all pixels and channels.
- SSIM: Wang et al. 2004: 11 x 11 Gaussian window with sigma 1.5 (normalised), K1 = 0.01, K2 = 0.03, data range 1, population (not
  sample) covariances, only windows that lie inside the image; per channel, then the mean over channels and window positions.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

WINDOW = 11
SIGMA = 1.5
K1, K2 = 0.01, 0.03


def psnr(
    image: Float[Tensor, "3 height width"],
    reference: Float[Tensor, "3 height width"],
    mask: Bool[Tensor, "height width"] | None = None,
) -> float:
    """Peak signal-to-noise ratio in dB over all pixels, or those of ``mask``; infinite for equal images.

    Raises:
        ValueError: shapes differ, values are not finite, or the mask selects no pixel.
    """
    a, b = _checked(image, reference)
    squares = (a - b) ** 2
    if mask is not None:
        _check_mask(mask, a)
        squares = squares[:, mask]
        if squares.numel() == 0:
            raise ValueError("psnr: the mask selects no pixel")
    mse = float(squares.mean())
    return math.inf if mse == 0 else -10 * math.log10(mse)


def ssim_map(
    image: Float[Tensor, "3 height width"], reference: Float[Tensor, "3 height width"]
) -> Float[Tensor, "3 valid_height valid_width"]:
    """Structural similarity at every window position inside the image: position (y, x) is the window around pixel (y + 5, x + 5)."""
    return similarity(*_checked(image, reference))


def similarity(
    a: Float[Tensor, "3 height width"], b: Float[Tensor, "3 height width"]
) -> Float[Tensor, "3 valid_height valid_width"]:
    """`ssim_map` in the precision of what is given and differentiable, without checks and clamping: also a loss.

    Raises:
        ValueError: the images are smaller than the window.
    """
    if min(a.shape[1:]) < WINDOW:
        raise ValueError(f"ssim needs at least {WINDOW} x {WINDOW} pixels, got {tuple(a.shape[1:])}")
    # Two calls: a reference that needs no gradient shall not cost one.
    mean_a, square_a, product = _windowed(torch.cat([a, a * a, a * b])).chunk(3)
    mean_b, square_b = _windowed(torch.cat([b, b * b])).chunk(2)
    variance_a, variance_b = square_a - mean_a**2, square_b - mean_b**2
    covariance = product - mean_a * mean_b
    c1, c2 = K1**2, K2**2
    numerator = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    return numerator / ((mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2))


def ssim(
    image: Float[Tensor, "3 height width"],
    reference: Float[Tensor, "3 height width"],
    mask: Bool[Tensor, "height width"] | None = None,
) -> float:
    """Mean structural similarity, over all window positions or those whose centre pixel is in ``mask``.

    Raises:
        ValueError: shapes differ, values are not finite, the image is smaller than the window, or the mask selects no position.
    """
    similarity = ssim_map(image, reference)
    if mask is not None:
        _check_mask(mask, image)
        margin = WINDOW // 2
        similarity = similarity[:, mask[margin:-margin, margin:-margin]]
        if similarity.numel() == 0:
            raise ValueError("ssim: the mask selects no window position inside the image")
    return float(similarity.mean())


def _windowed(planes: Float[Tensor, "plane height width"]) -> Float[Tensor, "plane valid_height valid_width"]:
    offsets = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    weights = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    return _Separable.apply(planes, (weights / weights.sum()).tolist())  # type: ignore[no-untyped-call]


class _Separable(torch.autograd.Function):
    """Weighted sums over windows along both axes. Sums of shifted images: many times faster on a CPU than convolutions of one channel.

    One plane after the other: one stays in the processor's cache through all shifts, all together do not.
    """

    @staticmethod
    def forward(ctx: Any, planes: Tensor, weights: list[float]) -> Tensor:
        ctx.weights = weights
        return torch.stack([_gathered(plane, weights) for plane in planes])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return torch.stack([_scattered(plane, ctx.weights) for plane in gradient]), None


def _gathered(plane: Tensor, weights: list[float]) -> Tensor:
    for axis in (0, 1):
        length = plane.shape[axis] - len(weights) + 1
        total = plane.narrow(axis, 0, length) * weights[0]
        for shift, weight in enumerate(weights[1:], 1):
            total.add_(plane.narrow(axis, shift, length), alpha=weight)
        plane = total
    return plane


def _scattered(plane: Tensor, weights: list[float]) -> Tensor:
    """The transpose of `_gathered`."""
    for axis in (1, 0):
        length = plane.shape[axis]
        shape = list(plane.shape)
        shape[axis] += len(weights) - 1
        total = plane.new_zeros(shape)
        for shift, weight in enumerate(weights):
            total.narrow(axis, shift, length).add_(plane, alpha=weight)
        plane = total
    return plane


def check_comparable(image: Tensor, reference: Tensor) -> None:
    """Raise ValueError unless both are pictures (3, height, width) of one size that hold finite values."""
    if image.shape != reference.shape or image.ndim != 3:
        raise ValueError(f"cannot compare images of {tuple(image.shape)} and {tuple(reference.shape)}")
    if not bool(torch.isfinite(image).all() and torch.isfinite(reference).all()):
        raise ValueError("cannot compare images that hold non-finite values")


def _checked(image: Tensor, reference: Tensor) -> tuple[Tensor, Tensor]:
    check_comparable(image, reference)
    a, b = image.detach().double(), reference.detach().double()
    return a.clamp(0, 1), b.clamp(0, 1)


def _check_mask(mask: Tensor, image: Tensor) -> None:
    if mask.shape != image.shape[1:] or mask.dtype != torch.bool:
        raise ValueError(f"mask is {mask.dtype} {tuple(mask.shape)}, expected bool {tuple(image.shape[1:])}")
