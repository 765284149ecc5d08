"""Agreement of the rasterisers with recorded images and gradients (fixtures: ``conformance/gaussians``)."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor

from sceneexpander.errors import UserError
from sceneexpander.geometry.checks import OutputCheck
from sceneexpander.splatting.rasterise import rasterise
from sceneexpander.splatting.settings import Backend, RasterSettings

IMAGE_TOLERANCE = 2e-5  # max abs, rgb and alpha
DEPTH_TOLERANCE = 5e-5  # max abs where alpha > 0.1
GRADIENT_TOLERANCE = 1e-4  # relative L2
LOSS_TOLERANCE = 1e-4  # times (|loss| + 10)
INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmats")
ALPHA_CAPS = {"": 0.99, "_cap0999": 0.999}  # suffix of the recorded tensors -> cap they were made with


def run_case(path: Path, *, backend: Backend = "auto") -> list[OutputCheck]:
    """Render one recorded scene, differentiate its loss, compare everything. Names end in the suffix of the alpha cap."""
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - safe_open is no mapping
    if metadata is None or "in.means" not in tensors:
        raise UserError("is not a rasteriser case (no metadata or no in.means)", where=path)
    checks = []
    for suffix, cap in ALPHA_CAPS.items():
        if f"out{suffix}.rgb" in tensors:
            checks += _run_variant(tensors, metadata, suffix, cap, backend)
    return checks


def _run_variant(
    tensors: dict[str, Tensor], metadata: dict[str, str], suffix: str, cap: float, backend: Backend
) -> list[OutputCheck]:
    inputs = {name: tensors[f"in.{name}"].clone().requires_grad_() for name in INPUTS}
    settings = RasterSettings(
        near=float(metadata["near"]),
        far=float(metadata["far"]),
        eps2d=float(metadata["eps2d"]),
        antialiased=_text(metadata["rasterize_mode"]) == "antialiased",
        max_alpha=cap,
        backend=backend,
    )
    out = rasterise(
        inputs["means"],
        inputs["quats"],
        inputs["scales"],
        inputs["opacities"],
        inputs["colors"],
        inputs["viewmats"],
        tensors["in.Ks"],
        int(metadata["height"]),
        int(metadata["width"]),
        background=tensors.get("in.backgrounds"),
        settings=settings,
    )
    assert out.depth is not None  # noqa: S101 - asked for by default
    images = {"rgb": out.rgb.movedim(1, -1), "alpha": out.alpha[..., None], "depth": out.depth[..., None]}
    weighted = [(image * tensors[f"w_{name}"]).double().sum() for name, image in images.items()]
    loss = torch.stack(weighted).sum()
    loss.backward()  # type: ignore[no-untyped-call]

    covered = tensors[f"out{suffix}.alpha"] > 0.1
    checks = []
    for name, image in images.items():
        error = (image.detach() - tensors[f"out{suffix}.{name}"]).abs()
        if name == "depth":
            error = error[covered]
        tolerance = DEPTH_TOLERANCE if name == "depth" else IMAGE_TOLERANCE
        checks.append(
            OutputCheck(name=f"{name}{suffix}", error=float(error.max()), tolerance=tolerance, detail="max abs")
        )
    recorded = float(tensors[f"out{suffix}.loss"].sum())
    checks.append(
        OutputCheck(
            name=f"loss{suffix}",
            error=abs(float(loss.detach()) - recorded),
            tolerance=LOSS_TOLERANCE * (abs(recorded) + 10),
            detail=f"recorded {recorded:.6g}",
        )
    )
    for name, value in inputs.items():
        reference = tensors[f"grad{suffix}.{name}"].double()
        assert value.grad is not None  # noqa: S101 - every input reaches the loss
        error = (value.grad.double() - reference).norm() / reference.norm()
        checks.append(
            OutputCheck(
                name=f"grad.{name}{suffix}", error=float(error), tolerance=GRADIENT_TOLERANCE, detail="relative L2"
            )
        )
    return checks


def _text(value: str) -> str:
    """Metadata strings may be JSON-quoted."""
    return json.loads(value) if value.startswith('"') else value
