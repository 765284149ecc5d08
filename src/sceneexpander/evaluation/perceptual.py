"""Shift-tolerant LPIPS (Ghildyal and Liu, ECCV 2022; AlexNet variant): network and weights are those of ``stlpips-pytorch``.

It is not LPIPS and never reported as such: other weights, other numbers.
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
from torch import Tensor

PACKAGE = "stlpips_pytorch"
# The package imports these at its top and uses none of them for the variant that is loaded here.
_UNUSED = {"torchvision": ("models",), "IPython": ("embed",), "torchsummary": ("summary",)}
_log = logging.getLogger(__name__)


@torch.no_grad()
def st_lpips(image: Float[Tensor, "3 height width"], reference: Float[Tensor, "3 height width"]) -> float | None:
    """Perceptual distance of two pictures (RGB, clamped to [0, 1]): 0 for equal ones; None where the package is not installed."""
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
    """Inside, empty modules stand in for those of `_UNUSED` that are not installed."""
    absent = [name for name in _UNUSED if name not in sys.modules and importlib.util.find_spec(name) is None]
    for name in absent:
        module = ModuleType(name)
        for attribute in _UNUSED[name]:
            setattr(module, attribute, None)
        sys.modules[name] = module
    try:
        yield
    finally:
        for name in absent:
            del sys.modules[name]
