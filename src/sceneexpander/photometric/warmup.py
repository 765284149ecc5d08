"""Per-scene warm-up: a few steps on the captured views alone, so that a small model starts from a theta_0 that fits the scene.

The supervision is photometric: the Gaussians of all views are rendered at a captured camera, once all of them and once without
those of that view itself, and compared with the photo. A share of 16 x 16 pixel cells is held out; if the held-out error does not
fall, the old weights are kept. Models with strong weights of their own do not need it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.randomness import child_generator
from sceneexpander.models.protocol import ALL_HEADS, Prediction, Reconstructor, as_module
from sceneexpander.photometric.config import WarmupConfig
from sceneexpander.photometric.error import photometric_error, renderable
from sceneexpander.photometric.report import FitReport


def held_out_cells(
    views: int, height: int, width: int, config: WarmupConfig, *, seed: int
) -> Bool[Tensor, "view height width"]:
    """True where a pixel belongs to a held-out cell."""
    generator = child_generator(seed, "warmup/cells")
    rows, columns = -(-height // config.cell_px), -(-width // config.cell_px)
    cells = torch.rand(views, rows, columns, generator=generator) < config.held_out
    grown = cells.repeat_interleave(config.cell_px, -2).repeat_interleave(config.cell_px, -1)
    return grown[:, :height, :width]


def _error(
    prediction: Prediction,
    images: Float[Tensor, "view 3 height width"],
    view: int,
    mask: Bool[Tensor, "height width"],
    config: WarmupConfig,
) -> Float[Tensor, ""]:
    return photometric_error(
        prediction, images, view, mask, others_weight=config.others_weight, min_alpha=config.min_alpha
    )


def warm_up(
    model: Reconstructor,
    images: Float[Tensor, "view 3 height width"],
    priors: Priors | None,
    config: WarmupConfig,
    *,
    seed: int,
    on_step: Callable[[int, float], None] | None = None,
) -> FitReport | None:
    """Fit ``model`` to its captured views in place; returns None if the warm-up is off.

    If the held-out error (mean absolute colour difference, weighted like the loss) does not fall, the weights are put back bit for bit.
    """
    if config.steps == 0:
        return None
    module = as_module(model)
    start = {name: value.detach().clone() for name, value in module.state_dict().items()}
    views, _, height, width = images.shape
    hidden = held_out_cells(views, height, width, config, seed=seed).to(images.device)
    before = _held_out_error(model, images, priors, hidden, config)
    parameters = [p for p in module.parameters() if p.requires_grad]
    optimiser = torch.optim.AdamW(parameters, lr=config.learning_rate, weight_decay=0.0, foreach=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.steps, config.learning_rate / 10)
    order = torch.randperm(views, generator=child_generator(seed, "warmup/order")).tolist()
    for step in range(config.steps):
        view = order[step % views]
        prediction = model.predict(images, priors, heads=ALL_HEADS)
        if not renderable(prediction):
            break  # the steps were too large for this scene: the check below rejects the result
        loss = _error(prediction, images, view, ~hidden[view], config)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        optimiser.step()
        schedule.step()
        if on_step is not None:
            on_step(step + 1, float(loss.detach()))
    optimiser.zero_grad(set_to_none=True)
    after = _held_out_error(model, images, priors, hidden, config)
    report = FitReport(steps=config.steps, before=before, after=after)
    if not report.accepted:
        module.load_state_dict(start)
    return report


@torch.no_grad()
def _held_out_error(
    model: Reconstructor,
    images: Float[Tensor, "view 3 height width"],
    priors: Priors | None,
    hidden: Bool[Tensor, "view height width"],
    config: WarmupConfig,
) -> float:
    prediction = model.predict(images, priors, heads=ALL_HEADS)
    if not renderable(prediction):
        return math.inf
    errors = [_error(prediction, images, v, hidden[v], config) for v in range(images.shape[0])]
    return float(torch.stack(errors).mean())
