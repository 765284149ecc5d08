"""Which estimate of cameras and depths a round takes: with the inserted view's say, or without it (beyond the paper)."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from sceneexpander.artifacts.views import ViewSet
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gauge import posed_in_both
from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.randomness import child_generator
from sceneexpander.insertion.protocol import RoundContext, RoundInputs
from sceneexpander.insertion.realign import Realign, realign
from sceneexpander.insertion.report import CorrectionsReport, Estimate
from sceneexpander.models.protocol import Prediction
from sceneexpander.reconstruction.loaded import LoadedModel
from sceneexpander.reconstruction.views import predict
from sceneexpander.splatting import render

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """What becomes of the joint estimate, see `Realign`."""

    realign: Realign = Realign.NONE

    def correct_inputs(self, inputs: RoundInputs, context: RoundContext) -> RoundInputs:
        """The inputs with the chosen estimate; the report says which."""
        priors, report = realign_priors(inputs, context.loaded, self.realign, seed=context.seed)
        return replace(inputs, joint_priors=priors, report=report)


def realign_priors(
    inputs: RoundInputs, loaded: LoadedModel, mode: Realign, *, seed: int
) -> tuple[Priors, CorrectionsReport]:
    """The joint priors as the adaptation takes them, see `realign`, and what was done.

    `Realign.CHOOSE` makes the scene from both estimates with the weights that the round starts from, and takes the one whose
    Gaussians show the captured photos with the smaller squared error. Only what the user gave is looked at.
    """
    state, joint, generator = inputs.state, inputs.joint_priors, child_generator(seed, "realign")
    views = inputs.views
    arguments = (state.priors, joint, inputs.anchors, views.images[:-1], views.images[-1])
    if mode is not Realign.CHOOSE:
        priors, moved = realign(*arguments, mode, generator=generator)
        return priors, CorrectionsReport(
            estimate=Estimate.JOINT if priors is joint else Estimate.HELD, refinement=moved
        )
    held, _ = realign(*arguments, Realign.HOLD, generator=generator)
    if held is joint:
        _log.info("cameras: the front-end did not run, so there is one estimate only")
        return joint, CorrectionsReport()
    photos = ~views.generated
    placed = photos.clone()
    placed[:-1] &= posed_in_both(state.priors, joint, len(views) - 1).cpu()
    compared = placed if bool(placed.any()) else photos
    joint_error, held_error = (
        _photo_error(predict(views, priors, loaded, state.weights), views, compared) for priors in (joint, held)
    )
    estimate = Estimate.HELD if held_error < joint_error else Estimate.JOINT
    _log.info("cameras and depths: the %s estimate (errors: joint %.3g, held %.3g)", estimate, joint_error, held_error)
    report = CorrectionsReport(estimate=estimate, joint_error=joint_error, held_error=held_error)
    return (held if estimate is Estimate.HELD else joint), report


def _photo_error(prediction: Prediction, views: ViewSet, compared: Bool[Tensor, "view"]) -> float:
    """Mean squared error of some photos against what all Gaussians show there."""
    if prediction.gaussians is None:
        raise ValueError("a rendered picture needs the Gaussian head")
    captured = torch.nonzero(compared)[:, 0].tolist()
    poses, intrinsics = prediction.world_from_cam[captured], prediction.intrinsics_px[captured]
    shown = render(prediction.gaussians, Cameras(poses, intrinsics, views.height, views.width)).rgb.clamp(0, 1)
    return float((shown.cpu() - views.images[captured]).square().mean())
