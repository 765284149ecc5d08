"""The steps of a round as functions from artefacts to artefacts. No paths, no configuration files, no tracking."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from sceneexpander.adaptation.acceptance import Acceptance, AcceptanceLimits, judge_candidate
from sceneexpander.adaptation.config import AdaptConfig, Realign
from sceneexpander.adaptation.consistency import trusted
from sceneexpander.adaptation.gaps import closed
from sceneexpander.adaptation.gaussian_head import fit_gaussian_head
from sceneexpander.adaptation.loop import AdaptationInputs, AdaptationResult, StepRecord, adapt
from sceneexpander.adaptation.observe import Look
from sceneexpander.adaptation.realign import realign
from sceneexpander.adaptation.tone import match_tone
from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.artifacts.inserted import InsertedView
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.state import ExpansionState, WeightsChange
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.randomness import child_generator
from sceneexpander.models.protocol import Prediction
from sceneexpander.reconstruction.loaded import LoadedModel
from sceneexpander.reconstruction.views import device_priors, predict, reconstruct
from sceneexpander.splatting import render

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundInputs:
    """What a round starts from."""

    state: ExpansionState
    inserted: InsertedView
    anchors: Anchors
    joint_priors: Priors


def adapt_round(
    inputs: RoundInputs,
    loaded: LoadedModel,
    config: AdaptConfig,
    *,
    seed: int,
    checkpoint_folder: Path | None = None,
    on_step: Callable[[StepRecord], None] | None = None,
    on_look: Callable[[Look], None] | None = None,
    looks_folder: Path | None = None,
) -> tuple[ExpansionState, Reconstruction, AdaptationResult]:
    """Algorithm 1, then the expanded scene with the adapted weights: the state that the next round starts from."""
    inputs = aligned(inputs, loaded, config, seed=seed)
    weights, result = adapted_weights(
        inputs,
        loaded,
        config,
        seed=seed,
        checkpoint_folder=checkpoint_folder,
        on_step=on_step,
        on_look=on_look,
        looks_folder=looks_folder,
    )
    return *finished_round(inputs, weights, loaded, config, seed=seed), result


def aligned(inputs: RoundInputs, loaded: LoadedModel, config: AdaptConfig, *, seed: int) -> RoundInputs:
    """What the adaptation takes instead of the given estimate and picture: `realigned_priors`, and the photos' tone (`match_tone`)."""
    inputs = replace(inputs, joint_priors=realigned_priors(inputs, loaded, config.realign, seed=seed))
    return toned(inputs, loaded) if config.tone else inputs


def toned(inputs: RoundInputs, loaded: LoadedModel) -> RoundInputs:
    """The inserted picture in the photos' tone, by the geometry of the weights that the round starts from."""
    inserted = inputs.inserted
    views = inputs.state.views.append(inserted.view)
    seen = predict(views, inputs.joint_priors, loaded, inputs.state.weights)
    if seen.depth is None:
        raise ValueError("the tone is compared by means of the depth head")
    tone = match_tone(
        views.images,
        seen.depth.cpu(),
        seen.world_from_cam.cpu(),
        seen.intrinsics_px.cpu(),
        generated=views.generated,
        view=len(views) - 1,
    )
    if tone is None:
        _log.info("the inserted view shares too little with the photos to compare their tone")
        return inputs
    _log.info("the inserted picture x (%.2f, %.2f, %.2f) has the photos' tone", *tone.gains)
    view = inserted.view
    changed = replace(view, images=tone.applied(view.images), detail_images=tone.applied(view.detail_images))
    return replace(inputs, inserted=replace(inserted, view=changed))


def adapted_weights(
    inputs: RoundInputs,
    loaded: LoadedModel,
    config: AdaptConfig,
    *,
    seed: int,
    checkpoint_folder: Path | None = None,
    on_step: Callable[[StepRecord], None] | None = None,
    on_look: Callable[[Look], None] | None = None,
    looks_folder: Path | None = None,
) -> tuple[WeightsChange, AdaptationResult]:
    """Algorithm 1 alone, on inputs as `aligned` leaves them."""
    state = inputs.state
    loaded.apply(state.weights)
    result = adapt(
        loaded.model,
        AdaptationInputs(
            captured=state.views.images.to(loaded.device),
            inserted=inputs.inserted.view.images[0].to(loaded.device),
            anchors=_device_anchors(inputs.anchors, loaded),
            captured_priors=device_priors(state.priors, loaded),
            joint_priors=device_priors(inputs.joint_priors, loaded),
        ),
        config,
        seed=seed,
        checkpoint_folder=checkpoint_folder,
        on_step=on_step,
        on_look=on_look,
        looks_folder=looks_folder,
    )
    # Without a step nothing changed: keep the very change that the round started from, bit for bit.
    return (WeightsChange.between(loaded.base, result.student) if config.steps else state.weights), result


def finished_round(
    inputs: RoundInputs, weights: WeightsChange, loaded: LoadedModel, config: AdaptConfig, *, seed: int
) -> tuple[ExpansionState, Reconstruction]:
    """The expanded scene with adapted weights, after what may follow Algorithm 1: the Gaussian head, closing of gaps, and fading."""
    views, joint_priors = inputs.state.views.append(inputs.inserted.view), inputs.joint_priors
    if config.splat_steps:
        loaded.apply(weights)
        fit_gaussian_head(
            loaded.model,
            views.images.to(loaded.device),
            views.generated.to(loaded.device),
            device_priors(joint_priors, loaded),
            config,
            seed=seed,
        )
        weights = WeightsChange.between(loaded.base, loaded.state())
    reconstruction = reconstruct(views, joint_priors, loaded, weights, method="sceneexpander")
    expanded = ExpansionState(views=views, priors=joint_priors, weights=weights)
    reconstruction = closed(reconstruction, config.close_gaps)
    return expanded, trusted(reconstruction, views.images) if config.trust else reconstruction


def judge_round(inputs: RoundInputs) -> Acceptance | None:
    """Whether the inserted view fits the scene, see `judge_candidate`; None if the front-end did not run for it."""
    priors = inputs.joint_priors
    if priors.world_from_cam is None or priors.intrinsics_px is None or priors.depth is None:
        return None
    return judge_candidate(
        inputs.state.priors,
        priors,
        inputs.anchors,
        inputs.state.views.images,
        inputs.inserted.view.images[0],
        AcceptanceLimits(),
    )


def realigned_priors(inputs: RoundInputs, loaded: LoadedModel, mode: Realign, *, seed: int) -> Priors:
    """The joint priors as the adaptation takes them, see `realign`.

    `Realign.CHOOSE` makes the scene from both estimates with the weights that the round starts from, and takes the one whose
    Gaussians show the captured photos with the smaller squared error. Only what the user gave is looked at.
    """
    state, generator = inputs.state, child_generator(seed, "realign")
    arguments = (state.priors, inputs.joint_priors, inputs.anchors, state.views.images, inputs.inserted.view.images[0])
    if mode is not Realign.CHOOSE:
        return realign(*arguments, mode, generator=generator)[0]
    held, _ = realign(*arguments, Realign.HOLD, generator=generator)
    views = state.views.append(inputs.inserted.view)
    errors = [
        _photo_error(predict(views, priors, loaded, state.weights), views) for priors in (inputs.joint_priors, held)
    ]
    return held if errors[1] < errors[0] else inputs.joint_priors


def _photo_error(prediction: Prediction, views: ViewSet) -> float:
    """Mean squared error of the captured photos against what all Gaussians show there."""
    if prediction.gaussians is None:
        raise ValueError("a rendered picture needs the Gaussian head")
    captured = torch.nonzero(~views.generated)[:, 0].tolist()
    poses, intrinsics = prediction.world_from_cam[captured], prediction.intrinsics_px[captured]
    shown = render(prediction.gaussians, poses, intrinsics, views.height, views.width).rgb.clamp(0, 1)
    return float((shown.cpu() - views.images[captured]).square().mean())


def _device_anchors(anchors: Anchors, loaded: LoadedModel) -> Anchors:
    def moved(value: Tensor) -> Tensor:
        return value.to(loaded.device)

    return Anchors(
        weights_sha256=anchors.weights_sha256,
        view_ids=anchors.view_ids,
        camera_vector=moved(anchors.camera_vector),
        depth=moved(anchors.depth),
        depth_conf=moved(anchors.depth_conf),
        normals=moved(anchors.normals),
        normals_conf=moved(anchors.normals_conf),
        gauge_view=anchors.gauge_view,
    )
