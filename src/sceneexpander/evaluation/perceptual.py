"""Shift-tolerant LPIPS (Ghildyal and Liu, ECCV 2022; AlexNet variant): network and weights are those of ``stlpips-pytorch``.

It is not LPIPS and never reported as such: other weights, other numbers. Being tolerant to shifts it punishes a ghost mildly: ghosting is
measured by `evaluation.ghosting`.

The package is under BSD licences but for its blur-pooling module (CC BY-NC-SA), which is never imported: `BlurPool` takes its place.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import logging
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

PACKAGE = "stlpips_pytorch"
# The package imports these at its top and uses none of them for the variant that is loaded here.
_UNUSED = {"torchvision": ("models",), "IPython": ("embed",), "torchsummary": ("summary",)}
_BLUR_MODULE = f"{PACKAGE}.models_lpf"
_log = logging.getLogger(__name__)


class BlurPool(nn.Module):
    """Anti-aliased subsampling (Zhang, ICML 2019): a binomial 3 x 3 window on a reflected border of two pixels, every second position."""

    filt: Tensor  # named as in the published weights, which hold the window

    def __init__(self, *, channels: int, filt_size: int, stride: int, pad_more: bool) -> None:
        super().__init__()
        if (filt_size, stride, pad_more) != (3, 2, True):
            raise ValueError(f"no such blur-pooling is known: {filt_size}, {stride}, {pad_more}")
        line = torch.tensor([1.0, 2.0, 1.0]) / 4
        self.register_buffer("filt", torch.outer(line, line).expand(channels, 1, 3, 3).clone())

    def forward(
        self, maps: Float[Tensor, "1 channel height width"]
    ) -> Float[Tensor, "1 channel half_height half_width"]:
        """Each channel by itself."""
        padded = functional.pad(maps, (2, 2, 2, 2), mode="reflect")
        return functional.conv2d(padded, self.filt, stride=2, groups=len(self.filt))


@torch.no_grad()
def st_lpips(image: Float[Tensor, "3 height width"], reference: Float[Tensor, "3 height width"]) -> float | None:
    """Perceptual distance of two pictures (RGB, clamped to [0, 1]): 0 for equal ones; None where the package is not installed.

    Raises:
        ValueError: shapes differ, or values are not finite.
    """
    if image.shape != reference.shape:
        raise ValueError(f"cannot compare images of {tuple(image.shape)} and {tuple(reference.shape)}")
    if not bool(torch.isfinite(image).all() and torch.isfinite(reference).all()):
        raise ValueError("cannot compare images that hold non-finite values")
    network = _network()
    if network is None:
        return None
    pair = torch.stack([image, reference]).detach().to("cpu", torch.float32).clamp(0, 1)
    pair = pair.contiguous(memory_format=torch.channels_last)  # a quarter less time on CPUs, as the network
    return float(network(pair[:1], pair[1:], normalize=True))


@functools.cache
def _network() -> Any | None:
    if importlib.util.find_spec(PACKAGE) is None:
        _log.info("stlpips-pytorch is not installed: no ST-LPIPS")
        return None
    with _stand_ins():
        from stlpips_pytorch import stlpips
    # Its weights are read by torch.load, which has refused everything but plain tensors since torch 2.6.
    network = stlpips.LPIPS(net="alex", variant="shift_tolerant", verbose=False).eval()
    return network.to(memory_format=torch.channels_last)


@contextlib.contextmanager
def _stand_ins() -> Iterator[None]:
    """Inside, modules stand in: empty ones for those of `_UNUSED` that are not installed, ours for the package's blur-pooling."""
    absent = [name for name in _UNUSED if name not in sys.modules and importlib.util.find_spec(name) is None]
    for name in absent:
        module = ModuleType(name)
        for attribute in _UNUSED[name]:
            setattr(module, attribute, None)
        sys.modules[name] = module
    ours = ModuleType(_BLUR_MODULE)
    ours.Downsample = BlurPool  # type: ignore[attr-defined]
    sys.modules[_BLUR_MODULE] = ours
    try:
        yield
    finally:
        for name in (*absent, _BLUR_MODULE):
            del sys.modules[name]
