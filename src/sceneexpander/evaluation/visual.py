"""LPIPS and FLIP: how different two pictures look, by measures that others report.

- LPIPS (Zhang et al., CVPR 2018), version 0.1, AlexNet: RGB in [-1, 1], normalised; after each of the five rectifiers the squared
  differences of features scaled to unit length, weighted by the published heads; means over positions, added up. The network is written
  here; the weights are the official ones and never downloaded: AlexNet's from a file that `evaluate.lpips_weights` names (torchvision's
  ``alexnet-owt-7be5be79.pth``, or the same as safetensors), the heads from the installed package ``lpips``, of which no code is run.
- FLIP (Andersson et al., HPG 2020) for ordinary pictures, by NVIDIA's package ``flip-evaluator``: sRGB, 67 pixels per degree; the mean of
  its map over the pixels that count.

Both are 0 for equal pictures.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from sceneexpander.catalogue.metrics import metrics_named
from sceneexpander.errors import UserError
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.measure import Measure, SeenView, UnseenView, Values

LEAST_SIDE_PX = 35  # smaller pictures vanish inside AlexNet
_PPD = 67.0
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
_CONVOLUTIONS = (0, 3, 6, 8, 10)  # their places in torchvision's ``features``
_POOLED = (0, 3)  # after the rectifiers of these
_HEADS = "weights/v0.1/alex.pth"
_EPS = 1e-10
_WHERE = "evaluate.lpips_weights"


class Lpips(nn.Module):
    """The network: AlexNet's convolutions and the heads over them."""

    def __init__(self) -> None:
        super().__init__()
        self.convolutions = nn.ModuleList(
            [
                nn.Conv2d(3, 64, 11, stride=4, padding=2),
                nn.Conv2d(64, 192, 5, padding=2),
                nn.Conv2d(192, 384, 3, padding=1),
                nn.Conv2d(384, 256, 3, padding=1),
                nn.Conv2d(256, 256, 3, padding=1),
            ]
        )
        self.heads = nn.ParameterList([nn.Parameter(torch.zeros(own.out_channels)) for own in self.convolutions])
        self.register_buffer("shift", torch.tensor(_SHIFT)[:, None, None])
        self.register_buffer("scale", torch.tensor(_SCALE)[:, None, None])

    def load(self, backbone: Mapping[str, Tensor], heads: Mapping[str, Tensor]) -> None:
        """Take torchvision's weights and the package's heads. Raises `KeyError` or `RuntimeError` if they are others."""
        with torch.no_grad():
            for number, (own, place) in enumerate(zip(self.convolutions, _CONVOLUTIONS, strict=True)):
                own.weight.copy_(backbone[f"features.{place}.weight"])
                own.bias.copy_(backbone[f"features.{place}.bias"])
                self.heads[number].copy_(heads[f"lin{number}.model.1.weight"].flatten())

    def forward(self, images: Float[Tensor, "2 3 height width"]) -> Float[Tensor, ""]:
        """Distance of two pictures in [0, 1]."""
        features = (2 * images - 1 - self.shift) / self.scale
        total = images.new_zeros(())
        for number, (own, place) in enumerate(zip(self.convolutions, _CONVOLUTIONS, strict=True)):
            features = functional.relu(own(features))
            unit = features / (features.square().sum(1, keepdim=True).sqrt() + _EPS)
            squares = (unit[0] - unit[1]).square().mean(dim=(1, 2))
            total = total + (squares * self.heads[number]).sum()
            if place in _POOLED:
                features = functional.max_pool2d(features, 3, 2)
        return total


@torch.no_grad()
def lpips(
    image: Float[Tensor, "3 height width"], reference: Float[Tensor, "3 height width"], weights: Path
) -> float | None:
    """LPIPS of two pictures (RGB, clamped to [0, 1]); None for pictures that are too small.

    Raises:
        UserError: the weights are missing or others.
        ValueError: shapes differ, or values are not finite.
    """
    pair = _pair(image, reference)
    return float(_network(weights)(pair)) if min(pair.shape[2:]) >= LEAST_SIDE_PX else None


@functools.cache
def _network(weights: Path) -> Lpips:
    package = importlib.util.find_spec("lpips")
    if package is None or package.origin is None:
        raise UserError(
            "needs the package lpips, whose heads it is used with",
            where=_WHERE,
            fix="pip install lpips==0.1.4 --no-deps",
        )
    network = Lpips().eval()
    try:
        network.load(_tensors(weights), _tensors(Path(package.origin).parent / _HEADS))
    except (KeyError, RuntimeError, AttributeError, ValueError, OSError, EOFError, UnpicklingError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(
            f"{weights} does not hold AlexNet's weights ({reason})",
            where=_WHERE,
            fix="give torchvision's alexnet-owt-7be5be79.pth",
        ) from None
    return network


def _tensors(path: Path) -> dict[str, Tensor]:
    if path.suffix == ".safetensors":
        from safetensors.torch import load_file

        return load_file(path)
    # Nothing but plain tensors is read: no code of the file is run.
    found: dict[str, Tensor] = torch.load(path, map_location="cpu", weights_only=True)
    return found


def flip_map(
    image: Float[Tensor, "3 height width"], reference: Float[Tensor, "3 height width"]
) -> Float[Tensor, "height width"] | None:
    """FLIP's error of every pixel, in [0, 1]; None where the package is not installed. Raises `ValueError` as `lpips`."""
    pair = _pair(image, reference).permute(0, 2, 3, 1).contiguous().numpy()
    if importlib.util.find_spec("flip_evaluator") is None:
        return None
    import flip_evaluator

    error, _, _ = flip_evaluator.evaluate(
        pair[1], pair[0], "LDR", applyMagma=False, computeMeanError=False, parameters={"ppd": _PPD}
    )
    return torch.from_numpy(np.ascontiguousarray(error[..., 0]))


def _pair(image: Tensor, reference: Tensor) -> Float[Tensor, "2 3 height width"]:
    if image.shape != reference.shape or image.ndim != 3:
        raise ValueError(f"cannot compare images of {tuple(image.shape)} and {tuple(reference.shape)}")
    pair = torch.stack([image, reference]).detach().to("cpu", torch.float32)
    if not bool(torch.isfinite(pair).all()):
        raise ValueError("cannot compare images that hold non-finite values")
    return pair.clamp(0, 1)


class Visual(Measure):
    """Both at the stored size; pixels that do not count are black on both sides for LPIPS and left out of FLIP's mean."""

    metrics = metrics_named(
        *(f"{kind}_{views}" for kind in ("lpips", "flip") for views in ("captured", "inserted", "held_out"))
    )

    def of_view(self, view: SeenView) -> Values:
        """Of a captured or an inserted view."""
        return _looks(
            view.render.rgb[0], view.picture, view.valid, view.config, "inserted" if view.generated else "captured"
        )

    def of_held_out(self, view: UnseenView) -> Values:
        """Of a photo that nothing was made from."""
        return _looks(view.render.rgb[0], view.picture, view.valid, view.config, "held_out")


def _looks(
    image: Tensor, picture: Tensor, valid: Bool[Tensor, "height width"] | None, config: EvaluateConfig, views: str
) -> Values:
    counted = torch.ones(picture.shape[1:], dtype=torch.bool) if valid is None else valid.cpu()
    values: dict[str, float | None] = {}
    if config.lpips_weights is not None:
        values[f"lpips_{views}"] = lpips(image.cpu() * counted, picture.cpu() * counted, Path(config.lpips_weights))
    if config.flip:
        error = flip_map(image, picture)
        values[f"flip_{views}"] = None if error is None else float(error[counted].double().mean())
    return values
