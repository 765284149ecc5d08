"""The part of the model that the paper's losses never reach, held to the captured photos (beyond the paper).

Eq. (anchor) and Eq. (gen) see cameras, depth and normals; what is rendered comes from the Gaussian head, which they leave as it
was while the features under it move. After Algorithm 1, a few steps train that head alone: everything else stays as it was
adapted, and all Gaussians, those of the inserted view included, are shown at captured cameras and compared with the photos taken
there. No pixel of the inserted view is a target.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.randomness import child_generator
from sceneexpander.models.protocol import ALL_HEADS, GEOMETRY_HEADS, Head, Prediction, Reconstructor, as_module
from sceneexpander.photometric.config import HeadConfig
from sceneexpander.photometric.error import photometric_error, renderable
from sceneexpander.photometric.report import FitReport

MIN_ALPHA = 0.5  # the other views' Gaussians are compared where they cover a pixel at least this much
_HEADS = ALL_HEADS - {Head.POINTS}


def fit_gaussian_head(
    model: Reconstructor,
    images: Float[Tensor, "view 3 height width"],
    generated: Bool[Tensor, "view"],
    priors: Priors | None,
    config: HeadConfig,
    *,
    fade: Callable[[Prediction], Tensor | None] | None = None,
    seed: int,
) -> FitReport | None:
    """Train the Gaussian head in place on the captured photos of ``images``; None if there is nothing to do.

    The steps are taken back if the mean photometric error over the photos did not fall.

    Args:
        model: adapted; only what the geometry heads do not use changes.
        images: all views, as the scene is made from them.
        generated: which of them are generated: never targets.
        priors: of all views.
        config: settings; without steps nothing is done.
        fade: of a prediction, what to multiply its Gaussians' opacities by wherever they are shown (None: nothing).
        seed: order of the photos.
    """
    if config.steps == 0:
        return None
    parameters = head_parameters(model, images[:1], None if priors is None else priors.select([0]))
    if not parameters:
        return None
    everything = list(as_module(model).parameters())
    required = [p.requires_grad for p in everything]
    start = [p.detach().clone() for p in parameters]
    for weight in everything:
        weight.requires_grad_(False)
    for chosen in parameters:
        chosen.requires_grad_(True)
    try:
        factors = None
        if fade is not None:
            with torch.no_grad():
                factors = fade(model.predict(images, priors, heads=_HEADS, generated=generated))
        targets = torch.nonzero(~generated)[:, 0].tolist()
        before = _mean_error(model, images, generated, priors, factors, targets, config)
        optimiser = torch.optim.AdamW(parameters, lr=config.learning_rate, weight_decay=0.0)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.steps)
        for step in range(config.steps):
            if step % len(targets) == 0:
                generator = child_generator(seed, f"adapt/splat/{step}")
                order = [targets[i] for i in torch.randperm(len(targets), generator=generator).tolist()]
            prediction = _shown(model.predict(images, priors, heads=_HEADS, generated=generated), factors)
            optimiser.zero_grad(set_to_none=True)
            _error(prediction, images, order[step % len(targets)], config).backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            schedule.step()
        after = _mean_error(model, images, generated, priors, factors, targets, config)
        report = FitReport(steps=config.steps, before=before, after=after)
        if not report.accepted:
            with torch.no_grad():
                for p, old in zip(parameters, start, strict=True):
                    p.copy_(old)
        return report
    finally:
        for weight, needed in zip(everything, required, strict=True):
            weight.requires_grad_(needed)
            weight.grad = None


def head_parameters(
    model: Reconstructor, images: Float[Tensor, "1 3 height width"], priors: Priors | None
) -> list[Tensor]:
    """Parameters that the Gaussians depend on and cameras, depth and normals do not: found by asking for gradients."""
    parameters = [p for p in as_module(model).parameters() if p.requires_grad]
    geometry = model.predict(images, priors, heads=GEOMETRY_HEADS)
    parts = [geometry.camera_vector, geometry.depth, geometry.normals, geometry.depth_conf, geometry.normals_conf]
    reached = _reached([part for part in parts if part is not None], parameters)
    gaussians = model.predict(images, priors, heads=_HEADS).gaussians
    if gaussians is None:
        return []
    shown = _reached([gaussians.means, gaussians.scales, gaussians.opacities, gaussians.sh], parameters)
    return [p for p, used, seen in zip(parameters, reached, shown, strict=True) if seen and not used]


def _reached(outputs: Sequence[Tensor], parameters: Sequence[Tensor]) -> list[bool]:
    total = torch.stack([part.sum() for part in outputs if part.requires_grad]).sum()
    return [g is not None for g in torch.autograd.grad(total, list(parameters), allow_unused=True)]


def _shown(prediction: Prediction, factors: Tensor | None) -> Prediction:
    """The prediction as it will be shown: generated Gaussians faded."""
    if factors is None or prediction.gaussians is None:
        return prediction
    faded = replace(prediction.gaussians, opacities=prediction.gaussians.opacities * factors)
    return replace(prediction, gaussians=faded)


def _error(prediction: Prediction, images: Tensor, view: int, config: HeadConfig) -> Tensor:
    return photometric_error(
        prediction, images, view, others_weight=config.others_weight, min_alpha=MIN_ALPHA, squared=True
    )


@torch.no_grad()
def _mean_error(
    model: Reconstructor,
    images: Tensor,
    generated: Tensor,
    priors: Priors | None,
    factors: Tensor | None,
    targets: Sequence[int],
    config: HeadConfig,
) -> float:
    prediction = _shown(model.predict(images, priors, heads=_HEADS, generated=generated), factors)
    if not renderable(prediction):
        return float("inf")
    return float(torch.stack([_error(prediction, images, view, config) for view in targets]).mean())
