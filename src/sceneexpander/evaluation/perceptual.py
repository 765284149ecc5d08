"""Shift-tolerant LPIPS (Ghildyal and Liu, ECCV 2022; AlexNet variant): the network is written here, the weights are ``stlpips-pytorch``'s.

It is not LPIPS and never reported as such: other weights, other numbers. Being tolerant to shifts it punishes a ghost mildly: ghosting is
measured by `evaluation.ghosting`.

AlexNet with every stride blurred (Zhang, ICML 2019): a convolution or a pooling is taken at every position, blurred by a binomial 3 x 3
window on a border of two reflected pixels, and only then subsampled by two. The first convolution is linear, so it and its blur are one
convolution of stride two here: a third of the products and a quarter of the memory.

Of the package no code is run: its blur-pooling is CC BY-NC-SA, and it imports torchvision.
"""

from __future__ import annotations

import functools
import importlib.util
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from sceneexpander.evaluation.image import check_comparable

PACKAGE = "stlpips_pytorch"
_WEIGHTS = "weights/vST0.0/alex_shift_tolerant.pth"
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
# Of the convolutions: name in the file, padding, and whether a pooling comes before.
_LAYERS = (
    ("net.slice1.0", 2, False),
    ("net.slice2.5", 2, True),
    ("net.slice3.9", 1, True),
    ("net.slice4.11", 1, False),
    ("net.slice5.13", 1, False),
)
_BINOMIAL = (0.25, 0.5, 0.25)
_HALVES = (0.5, 0.5)  # the binomial window around a line behind the last one, reflected
_EPS = 1e-10
_log = logging.getLogger(__name__)


@torch.no_grad()
def st_lpips(image: Float[Tensor, "3 height width"], reference: Float[Tensor, "3 height width"]) -> float | None:
    """Perceptual distance of two pictures (RGB, clamped to [0, 1]): 0 for equal ones; None where the package is not installed.

    Raises:
        ValueError: shapes differ, or values are not finite.
    """
    check_comparable(image, reference)
    network = _network()
    if network is None:
        return None
    first, second = (
        network.features(picture.detach().to("cpu", torch.float32).clamp(0, 1)[None]) for picture in (image, reference)
    )
    return float(sum(_apart(a, b, head) for a, b, head in zip(first, second, network.heads, strict=True)))


def blur_pool(maps: Float[Tensor, "1 channel height width"]) -> Float[Tensor, "1 channel half_height half_width"]:
    """Blurred subsampling by two, each channel by itself: a binomial 3 x 3 window on a reflected border of two pixels."""
    window = torch.outer(*(maps.new_tensor(_BINOMIAL),) * 2).expand(maps.shape[1], 1, 3, 3)
    return functional.conv2d(functional.pad(maps, (2, 2, 2, 2), mode="reflect"), window, stride=2, groups=maps.shape[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class _Network:
    """Weights and biases of the convolutions, and of the heads over their rectified answers."""

    weights: tuple[Tensor, ...]
    biases: tuple[Tensor, ...]
    heads: tuple[Tensor, ...]

    @classmethod
    def of(cls, weights: Mapping[str, Tensor]) -> _Network:
        """From the package's file."""
        return cls(
            weights=tuple(
                weights[f"{name}.weight"].contiguous(memory_format=torch.channels_last) for name, *_ in _LAYERS
            ),
            biases=tuple(weights[f"{name}.bias"] for name, *_ in _LAYERS),
            heads=tuple(weights[f"lin{number}.model.1.weight"].flatten() for number in range(len(_LAYERS))),
        )

    def features(self, picture: Float[Tensor, "1 3 height width"]) -> list[Float[Tensor, "1 _ _ _"]]:
        """Of a picture in [0, 1], after each rectifier."""
        shift, scale = (picture.new_tensor(values)[:, None, None] for values in (_SHIFT, _SCALE))
        maps = ((2 * picture - 1 - shift) / scale).contiguous(memory_format=torch.channels_last)
        found: list[Tensor] = []
        for (_, padding, pooled), weight, bias in zip(_LAYERS, self.weights, self.biases, strict=True):
            if pooled:
                maps = blur_pool(functional.max_pool2d(maps, 3, 1))
            maps = functional.conv2d(maps, weight, bias, padding=padding) if found else self._first(maps, padding)
            maps = maps.relu_()
            found.append(maps)
        return found

    def _first(
        self, picture: Float[Tensor, "1 3 height width"], padding: int
    ) -> Float[Tensor, "1 channel half_height half_width"]:
        """`blur_pool` of the first convolution.

        Without the border, position i of the result is blurred around line 2 i - 1 of the convolution's n lines. Reflection makes the
        first position equal to the second, and, as n is odd, the last one to the one before; where n is even, the last one is
        the mean of the last two lines.
        """
        padded = functional.pad(picture, (padding,) * 4)
        reach = self.weights[0].shape[-1] + len(_HALVES) - 1  # lines under the mean of two
        even_rows, even_columns = ((side - self.weights[0].shape[-1] + 1) % 2 == 0 for side in padded.shape[2:])

        def lines(rows: Tensor, vertical: tuple[float, ...]) -> Tensor:
            inner = self._blurred(rows, vertical, _BINOMIAL)
            last = self._blurred(rows[..., -reach:], vertical, _HALVES) if even_columns else inner[..., -1:]
            return torch.cat([inner[..., :1], inner, last], -1)

        inner = lines(padded, _BINOMIAL)
        last = lines(padded[..., -reach:, :], _HALVES) if even_rows else inner[..., -1:, :]
        return torch.cat([inner[..., :1, :], inner, last], -2).contiguous(memory_format=torch.channels_last)

    def _blurred(self, padded: Tensor, vertical: tuple[float, ...], horizontal: tuple[float, ...]) -> Tensor:
        """At every second position, where the windows lie inside."""
        weight = self.weights[0]
        window = torch.outer(weight.new_tensor(vertical), weight.new_tensor(horizontal))
        apart = weight.reshape(-1, 1, *weight.shape[2:])
        both = functional.conv_transpose2d(apart, window[None, None])  # the product of two convolutions
        both = both.reshape(*weight.shape[:2], *both.shape[2:]).contiguous(memory_format=torch.channels_last)
        return functional.conv2d(padded, both, self.biases[0], stride=2)


def _apart(a: Tensor, b: Tensor, head: Float[Tensor, "channel"]) -> Float[Tensor, ""]:
    """Weighted squared differences of features scaled to unit length, mean over positions. Both are used up: they are large."""
    for maps in (a, b):
        maps.div_(torch.linalg.vector_norm(maps, dim=1, keepdim=True).add_(_EPS))
    return (a.sub_(b).square_().movedim(1, -1) @ head).mean()


@functools.cache
def _network() -> _Network | None:
    package = importlib.util.find_spec(PACKAGE)
    if package is None or package.origin is None:
        _log.info("stlpips-pytorch is not installed: no ST-LPIPS")
        return None
    # Nothing but plain tensors is read: no code of the file is run.
    return _Network.of(torch.load(Path(package.origin).parent / _WEIGHTS, map_location="cpu", weights_only=True))
