"""LPIPS, FLIP and CVVDP: how different two pictures look, by measures that others report.

- LPIPS (Zhang et al., CVPR 2018), version 0.1, AlexNet: RGB in [-1, 1], normalised; after each of the five rectifiers the squared
  differences of features scaled to unit length, weighted by the published heads; means over positions, added up. The network is written
  here; the weights are the official ones and never downloaded: AlexNet's from a file that `evaluate.lpips_weights` names (torchvision's
  ``alexnet-owt-7be5be79.pth``, or the same as safetensors), the heads from the installed package ``lpips``, of which no code is run.
- FLIP (Andersson et al., HPG 2020) for ordinary pictures, by NVIDIA's package ``flip-evaluator``: sRGB, 67 pixels per degree; the mean of
  its map over the pixels that count.
- ColorVideoVDP: see `evaluation.cvvdp`.

The first two are 0 for equal pictures.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from sceneexpander.catalogue.metrics import metrics_named
from sceneexpander.errors import UserError
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.cvvdp import cvvdp
from sceneexpander.evaluation.image import check_comparable
from sceneexpander.evaluation.measure import Measure, SeenView, UnseenView, Values
from sceneexpander.plainfiles import require_plain_file

LEAST_SIDE_PX = 35  # smaller pictures vanish inside AlexNet
_PPD = 67.0
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
# Of AlexNet's convolutions: place in torchvision's ``features``, shape, stride, padding, and whether a pooling follows.
_LAYERS = (
    (0, (64, 3, 11, 11), 4, 2, True),
    (3, (192, 64, 5, 5), 1, 2, True),
    (6, (384, 192, 3, 3), 1, 1, False),
    (8, (256, 384, 3, 3), 1, 1, False),
    (10, (256, 256, 3, 3), 1, 1, False),
)
_HEADS = "weights/v0.1/alex.pth"
_EPS = 1e-10
_WHERE = "evaluate.lpips_weights"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Network:
    """Weights and biases of AlexNet's convolutions, and the heads over them."""

    weights: tuple[Tensor, ...]
    biases: tuple[Tensor, ...]
    heads: tuple[Tensor, ...]

    @classmethod
    def of(cls, backbone: Mapping[str, Tensor], heads: Mapping[str, Tensor]) -> _Network:
        """From torchvision's weights and the package's heads. Raises `KeyError` or `ValueError` if they are others."""
        weights = tuple(backbone[f"features.{place}.weight"].float() for place, *_ in _LAYERS)
        for weight, (place, shape, *_) in zip(weights, _LAYERS, strict=True):
            if tuple(weight.shape) != shape:
                raise ValueError(f"features.{place}.weight is {tuple(weight.shape)}, not {shape}")
        return cls(
            weights=weights,
            biases=tuple(backbone[f"features.{place}.bias"].float() for place, *_ in _LAYERS),
            heads=tuple(heads[f"lin{number}.model.1.weight"].float().flatten() for number in range(len(_LAYERS))),
        )

    def distance(self, pair: Float[Tensor, "2 3 height width"]) -> Float[Tensor, ""]:
        """Of two pictures in [0, 1]."""
        shift, scale = (pair.new_tensor(values)[:, None, None] for values in (_SHIFT, _SCALE))
        features = (2 * pair - 1 - shift) / scale
        total = pair.new_zeros(())
        for number, (_, _, stride, padding, pooled) in enumerate(_LAYERS):
            features = functional.relu(
                functional.conv2d(features, self.weights[number], self.biases[number], stride, padding)
            )
            unit = features / (features.square().sum(1, keepdim=True).sqrt() + _EPS)
            total = total + ((unit[0] - unit[1]).square().mean(dim=(1, 2)) * self.heads[number]).sum()
            if pooled:
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
    return float(_network(weights).distance(pair)) if min(pair.shape[2:]) >= LEAST_SIDE_PX else None


def check_lpips_weights(weights: Path) -> None:
    """Raise `UserError` if `lpips` cannot be measured with these weights."""
    require_plain_file(weights, where=f"{_WHERE} {weights}")
    _network(weights)


@functools.cache
def _network(weights: Path) -> _Network:
    package = importlib.util.find_spec("lpips")
    if package is None or package.origin is None:
        raise UserError(
            "needs the package lpips, whose heads it is used with",
            where=_WHERE,
            fix="pip install lpips==0.1.4 --no-deps",
        )
    try:
        return _Network.of(_tensors(weights), _tensors(Path(package.origin).parent / _HEADS))
    except (KeyError, RuntimeError, AttributeError, ValueError, OSError, EOFError, UnpicklingError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(
            f"{weights} does not hold AlexNet's weights ({reason})",
            where=_WHERE,
            fix="give torchvision's alexnet-owt-7be5be79.pth",
        ) from None


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
    check_comparable(image, reference)
    return torch.stack([image, reference]).detach().to("cpu", torch.float32).clamp(0, 1)


class Visual(Measure):
    """All at the stored size; pixels that do not count are black on both sides for LPIPS and CVVDP and left out of FLIP's mean."""

    metrics = metrics_named(
        *(f"{kind}_{views}" for kind in ("lpips", "flip", "cvvdp") for views in ("captured", "inserted", "held_out"))
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
    if config.cvvdp:
        values[f"cvvdp_{views}"] = cvvdp(image.cpu() * counted, picture.cpu() * counted)
    return values
