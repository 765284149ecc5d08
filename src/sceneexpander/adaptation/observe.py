"""Looks at the whole prediction while an adaptation runs: what the losses do not show. Nothing here changes a number of the run.

The losses reach neither the Gaussian head nor the rendering. A look predicts all views without augmentation, renders some of them,
and compares. Preservation counts as harmed once the captured views that are looked at render `HARM_DB` worse than at the first look.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from sceneexpander.adaptation.engine import autocast
from sceneexpander.adaptation.inputs import ViewSource
from sceneexpander.adaptation.learner import Learner
from sceneexpander.adaptation.sampling import Batch
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.models.protocol import ALL_HEADS
from sceneexpander.splatting import render

HARM_DB = 0.5  # loss of PSNR on captured views that is worth a warning
LOOKED_AT = 3  # captured views that are rendered, evenly spread over those with a camera
MODULE_DEPTH = 2  # parts of a parameter's name that make its module
MOST_DB = 100.0  # of equal pictures


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """What one look saw. Renderings are from the cameras that the model itself gives the views."""

    step: int  # finished steps
    captured_psnr: float  # dB, mean over the captured views looked at
    inserted_psnr: float  # dB
    captured_depth_change: float  # mean |log(depth / anchor)|
    head_disagreement: float  # mean |log(depth / depth that places the Gaussians)|
    drift: dict[str, float]  # norm of theta - theta_0 by module


class Observer:
    """Makes looks; pictures go into ``folder`` if there is one."""

    def __init__(self, learner: Learner, source: ViewSource, folder: Path | None) -> None:
        self.learner, self.source, self.folder = learner, source, folder

    @torch.no_grad()
    def look(self, step: int) -> Look:
        """Predict all views, render some, compare."""
        inputs = self.source.inputs
        count, _, height, width = inputs.captured.shape
        views = self.source.plain_views(Batch(captured=tuple(range(count)), inserted=True))
        with autocast(self.learner.config, self.learner.device):
            prediction = views.predict(self.learner.model, ALL_HEADS)
        depth, gaussians = prediction.depth, prediction.gaussians
        if depth is None or gaussians is None or prediction.gaussian_depth is None:
            raise ValueError("a look needs the depth and Gaussian heads")
        posed = None if inputs.captured_priors is None else inputs.captured_priors.posed
        placed = list(range(count)) if posed is None or not bool(posed.any()) else torch.nonzero(posed)[:, 0].tolist()
        chosen = [*(placed[index] for index in spread(len(placed), LOOKED_AT)), count]
        drawn = render(
            gaussians, Cameras(prediction.world_from_cam[chosen], prediction.intrinsics_px[chosen], height, width)
        ).rgb.clamp(0, 1)
        quality = [psnr_db(picture, views.images[view]) for picture, view in zip(drawn, chosen, strict=True)]
        if self.folder is not None:
            self._save(step, drawn[0], drawn[-1], depth[-1])
        return Look(
            step=step,
            captured_psnr=sum(quality[:-1]) / (len(quality) - 1),
            inserted_psnr=quality[-1],
            captured_depth_change=float((depth[:count] / self.learner.anchors.depth).log().abs().mean()),
            head_disagreement=float((depth / prediction.gaussian_depth).log().abs().mean()),
            drift=self.learner.ledger.drift_by_module(MODULE_DEPTH),
        )

    def _save(self, step: int, captured: Tensor, inserted: Tensor, depth: Tensor) -> None:
        assert self.folder is not None  # noqa: S101 - for the type checker
        self.folder.mkdir(parents=True, exist_ok=True)
        near, far = depth.log().quantile(torch.tensor([0.02, 0.98], device=depth.device))
        shade = 1 - ((depth.log() - near) / (far - near).clamp(min=1e-6)).clamp(0, 1)
        for name, picture in (("captured", captured), ("inserted", inserted), ("depth", shade.expand(3, -1, -1))):
            pixels = (picture * 255).round().to(torch.uint8).movedim(0, -1).cpu().numpy()
            Image.fromarray(pixels).save(self.folder / f"{name}_{step:04d}.jpg", quality=85)


def spread(count: int, most: int) -> list[int]:
    """At most ``most`` of ``count`` indices, the first and the last among them."""
    if count <= most:
        return list(range(count))
    return [round(i * (count - 1) / (most - 1)) for i in range(most)]


def psnr_db(picture: Float[Tensor, "3 height width"], truth: Float[Tensor, "3 height width"]) -> float:
    """Peak signal-to-noise ratio of values in [0, 1], at most `MOST_DB`."""
    error = float((picture - truth).square().mean())
    return min(MOST_DB, -10 * math.log10(error)) if error > 0 else MOST_DB


def warnings_of(looks: Sequence[Look]) -> list[str]:
    """Sentences about looks that show harm."""
    if not looks:
        return []
    before, worst = looks[0].captured_psnr, min(looks, key=lambda look: look.captured_psnr)
    if worst.captured_psnr > before - HARM_DB:
        return []
    return [
        f"the adaptation harms the captured views: they rendered at {before:.2f} dB before it and at "
        f"{worst.captured_psnr:.2f} dB after step {worst.step}"
    ]
