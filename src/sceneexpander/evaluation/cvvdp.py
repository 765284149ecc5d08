"""ColorVideoVDP (Mantiuk et al., SIGGRAPH 2024): how visible the difference of two pictures is to people, by its package ``cvvdp``.

In just-objectionable-differences: 10 for equal pictures, one less for each step that people would object to. Seen on the package's
``standard_4k`` display: 30 inches, 200 cd/m2, from 0.75 m, 75 pixels per degree.

Of the package only the metric is loaded, without its readers of files and its learned variants. What the metric itself imports of
torchvision, one Gaussian blur, is here: torchvision comes with compiled parts that load beside few builds of torch.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import logging
import sys
from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from sceneexpander.evaluation.image import check_comparable

PACKAGE = "pycvvdp"
_DISPLAY = "standard_4k"
_log = logging.getLogger(__name__)


class GaussianBlur(nn.Module):
    """What torchvision's class of this name does with a fixed deviation: a normalised window, borders reflected, every plane by itself."""

    def __init__(self, kernel_size: int, sigma: float) -> None:
        super().__init__()
        line = torch.exp(-0.5 * ((torch.arange(kernel_size) - (kernel_size - 1) / 2) / sigma) ** 2)
        self.window = line / line.sum()

    def forward(self, maps: Float[Tensor, "*batch height width"]) -> Float[Tensor, "*batch height width"]:
        """Of a picture that is larger than half the window."""
        reach = len(self.window) // 2
        planes = functional.pad(maps.reshape(-1, 1, *maps.shape[-2:]), (reach,) * 4, mode="reflect")
        window = self.window.to(planes)
        rows = functional.conv2d(planes, window[None, None, :, None])
        return functional.conv2d(rows, window[None, None, None]).reshape(maps.shape)


@torch.no_grad()
def cvvdp(image: Float[Tensor, "3 height width"], reference: Float[Tensor, "3 height width"]) -> float | None:
    """Quality of a picture (sRGB, clamped to [0, 1]) beside its reference in JOD; None where the package is not installed.

    Raises:
        ValueError: shapes differ, or values are not finite.
    """
    check_comparable(image, reference)
    metric = _metric()
    if metric is None:
        return None
    shown, wanted = (picture.detach().to("cpu", torch.float32).clamp(0, 1)[None] for picture in (image, reference))
    quality, _ = metric.predict(shown, wanted, dim_order="BCHW")
    return float(quality)


@functools.cache
def _metric() -> Any | None:
    package = importlib.util.find_spec(PACKAGE)
    if package is None:
        _log.warning("the package cvvdp is not installed: no CVVDP; pip install --no-deps cvvdp==0.5.7")
        return None
    with _only_the_metric(package.submodule_search_locations or ()):
        module = importlib.import_module("pycvvdp.cvvdp_metric")
        return module.cvvdp(display_name=_DISPLAY, device=torch.device("cpu"), quiet=True)


@contextlib.contextmanager
def _only_the_metric(folders: Sequence[str]) -> Iterator[None]:
    """Inside, the package is a bare one, and what it imports and does not use stands in; afterwards all is as before.

    The package also puts its folder on the path, and modules of names like ``interp`` beside everybody's.
    """
    modules, path = dict(sys.modules), list(sys.path)
    bare = ModuleType(PACKAGE)
    bare.__path__ = list(folders)
    transforms = ModuleType("torchvision.transforms")
    transforms.GaussianBlur = GaussianBlur  # type: ignore[attr-defined]
    sys.modules |= {
        PACKAGE: bare,
        "ffmpeg": ModuleType("ffmpeg"),
        "torchvision": ModuleType("torchvision"),
        "torchvision.transforms": transforms,
    }
    own = (PACKAGE, "ffmpeg", "torchvision", "interp", "third_party")
    try:
        yield
    finally:
        for name in [name for name in sys.modules if name.partition(".")[0] in own]:
            del sys.modules[name]
        sys.modules |= {name: module for name, module in modules.items() if name.partition(".")[0] in own}
        sys.path[:] = path
