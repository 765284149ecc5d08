"""The steps of a round as functions from artefacts to artefacts. No paths, no configuration files, no tracking."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from sceneexpander.adaptation.acceptance import Acceptance, AcceptanceLimits, captured_moved, judge_candidate
from sceneexpander.adaptation.config import AdaptConfig, Realign, Spend
from sceneexpander.adaptation.consistency import trusted
from sceneexpander.adaptation.corrections import Corrections, Estimate
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
from sceneexpander.artifacts.store import sha256_of_tensors
from sceneexpander.artifacts.views import ViewSet, to_bytes
from sceneexpander.geometry.gauge import posed_in_both
from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.randomness import child_generator
from sceneexpander.models.protocol import Prediction
from sceneexpander.optimisation.config import RefineConfig
from sceneexpander.optimisation.refine import RefineReport
from sceneexpander.reconstruction.loaded import LoadedModel
from sceneexpander.reconstruction.refining import refined
from sceneexpander.reconstruction.views import device_priors, predict, reconstruct
from sceneexpander.splatting import render

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundInputs:
    """What a round starts from.

    ``joint_priors`` have the gauge of the state's (`in_gauge_of`). ``toned`` is the inserted view in the photos' tone, which the
    adaptation takes instead of the given one (None: as given); ``corrections`` say what `aligned` changed.
    """

    state: ExpansionState
    inserted: InsertedView
    anchors: Anchors
    joint_priors: Priors
    toned: ViewSet | None = None
    corrections: Corrections = field(default_factory=Corrections)

    @property
    def inserted_view(self) -> ViewSet:
        """The inserted view as the adaptation takes it."""
        return self.inserted.view if self.toned is None else self.toned

    @property
    def views(self) -> ViewSet:
        """All views as the adaptation takes them, the inserted one last."""
        return self.state.toned_views.append(self.inserted_view)


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
    expanded, reconstruction = finished_round(inputs, weights, loaded, config, seed=seed)
    return expanded, reconstruction, replace(result, corrections=inputs.corrections)


def correct_round(
    inputs: RoundInputs, loaded: LoadedModel, config: AdaptConfig, *, seed: int
) -> tuple[ExpansionState, Reconstruction, Corrections]:
    """The round without a step: everything that is beyond the paper (`aligned`, `finished_round`) with the weights it starts from.

    What `adapt_round` brings more is Algorithm 1's. The reconstruction is of the method ``corrected``.
    """
    still = replace(config, steps=0, splat_steps=0)
    inputs = aligned(inputs, loaded, still, seed=seed)
    state, reconstruction = finished_round(inputs, inputs.state.weights, loaded, still, seed=seed)
    return state, replace(reconstruction, method="corrected"), inputs.corrections


def aligned(inputs: RoundInputs, loaded: LoadedModel, config: AdaptConfig, *, seed: int) -> RoundInputs:
    """What the adaptation takes instead of the given estimate and picture: `realigned_priors`, and the photos' tone (`match_tone`)."""
    priors, corrections = realigned_priors(inputs, loaded, config.realign, seed=seed)
    inputs = replace(inputs, joint_priors=priors, corrections=corrections)
    return toned(inputs, loaded) if config.tone else inputs


def toned(inputs: RoundInputs, loaded: LoadedModel) -> RoundInputs:
    """The inserted picture in the photos' tone, by the geometry of the weights that the round starts from."""
    inserted = inputs.inserted
    views = inputs.state.toned_views.append(inserted.view)
    seen = predict(views, inputs.joint_priors, loaded, inputs.state.weights)
    if seen.depth is None:
        raise ValueError("the tone is compared by means of the depth head")
    tone = match_tone(
        views.images,
        seen.depth.cpu(),
        seen.world_from_cam.cpu(),
        seen.intrinsics_px.cpu(),
        generated=views.generated,
        posed=inputs.joint_priors.posed,
        view=len(views) - 1,
    )
    if tone is None:
        _log.info("the inserted view shares too little with the photos to compare their tone")
        return inputs
    _log.info("the inserted picture x (%.2f, %.2f, %.2f) has the photos' tone", *tone.gains)
    view = inserted.view
    images = tone.applied(view.images)
    record = replace(view.records[0], sha256=sha256_of_tensors({"toned": images}))
    changed = replace(
        view,
        records=(record,),
        images=images,
        detail_images=tone.applied(view.detail_images),
        photos=(to_bytes(tone.applied(view.photo(0))),),
    )
    return replace(inputs, toned=changed, corrections=replace(inputs.corrections, gains=tone.gains))


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
    """Algorithm 1 alone, on inputs as `aligned` leaves them; without a step where `Spend` does not want any."""
    state = inputs.state
    if config.steps and not worth_adapting(inputs, loaded, config):
        config = replace(config, steps=0)
    loaded.apply(state.weights)
    result = adapt(
        loaded.model,
        AdaptationInputs(
            captured=state.toned_views.images.to(loaded.device),
            inserted=inputs.inserted_view.images[0].to(loaded.device),
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


def worth_adapting(inputs: RoundInputs, loaded: LoadedModel, config: AdaptConfig) -> bool:
    """Whether the round runs its steps, see `Spend`: told by what the weights it starts from make of all views."""
    if config.spend is Spend.ALWAYS:
        return True
    seen = predict(inputs.views, inputs.joint_priors, loaded, inputs.state.weights)
    if seen.depth is None:
        raise ValueError("the anchors are compared with the depth head")
    count, posed = len(inputs.state.views), inputs.joint_priors.posed
    moved = captured_moved(inputs.anchors, seen.depth[:count].cpu(), None if posed is None else posed[:count])
    worth = moved > config.spend_above
    _log.info(
        "the insertion moves the captured depth by %.2f %%: %s", 100 * moved, "steps" if worth else "nothing to repair"
    )
    return worth


def finished_round(
    inputs: RoundInputs, weights: WeightsChange, loaded: LoadedModel, config: AdaptConfig, *, seed: int
) -> tuple[ExpansionState, Reconstruction]:
    """The expanded scene with adapted weights, after what may follow Algorithm 1: the Gaussian head, closing of gaps, and fading."""
    state, views, joint_priors = inputs.state, inputs.views, inputs.joint_priors
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
    expanded = ExpansionState(
        views=state.views.append(inputs.inserted.view),
        priors=joint_priors,
        weights=weights,
        first_weights=state.unadapted,
        toned=_joined(state.toned, inputs.toned),
        known=state.known,
    )
    reconstruction = closed(reconstruction, config.close_gaps)
    return expanded, trusted(reconstruction, views.images) if config.trust else reconstruction


def _joined(before: ViewSet | None, new: ViewSet | None) -> ViewSet | None:
    if before is None or new is None:
        return before if new is None else new
    return before.append(new)


def refined_round(
    reconstruction: Reconstruction,
    state: ExpansionState,
    adapt: AdaptConfig,
    config: RefineConfig,
    *,
    seed: int,
    device: torch.device | str = "cpu",
    on_step: Callable[[int, float], None] | None = None,
) -> tuple[Reconstruction, RefineReport | None]:
    """`refined` for the expanded scene of a round: to the pictures that the round worked with, doubting the generated as ``trust`` says."""
    return refined(
        reconstruction,
        state.toned_views,
        config,
        doubt_generated=adapt.trust,
        seed=seed,
        device=device,
        on_step=on_step,
    )


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


def realigned_priors(
    inputs: RoundInputs, loaded: LoadedModel, mode: Realign, *, seed: int
) -> tuple[Priors, Corrections]:
    """The joint priors as the adaptation takes them, see `realign`, and what was done.

    `Realign.CHOOSE` makes the scene from both estimates with the weights that the round starts from, and takes the one whose
    Gaussians show the captured photos with the smaller squared error. Only what the user gave is looked at.
    """
    state, joint, generator = inputs.state, inputs.joint_priors, child_generator(seed, "realign")
    views = inputs.views
    arguments = (state.priors, joint, inputs.anchors, views.images[:-1], views.images[-1])
    if mode is not Realign.CHOOSE:
        priors, report = realign(*arguments, mode, generator=generator)
        return priors, Corrections(estimate=Estimate.JOINT if priors is joint else Estimate.HELD, refinement=report)
    held, _ = realign(*arguments, Realign.HOLD, generator=generator)
    if held is joint:
        return joint, Corrections()
    photos = ~views.generated
    placed = photos.clone()
    placed[:-1] &= posed_in_both(state.priors, joint, len(views) - 1).cpu()
    compared = placed if bool(placed.any()) else photos
    joint_error, held_error = (
        _photo_error(predict(views, priors, loaded, state.weights), views, compared) for priors in (joint, held)
    )
    estimate = Estimate.HELD if held_error < joint_error else Estimate.JOINT
    _log.info("cameras and depths: the %s estimate (errors: joint %.3g, held %.3g)", estimate, joint_error, held_error)
    corrections = Corrections(estimate=estimate, joint_error=joint_error, held_error=held_error)
    return (held if estimate is Estimate.HELD else joint), corrections


def _photo_error(prediction: Prediction, views: ViewSet, compared: Bool[Tensor, "view"]) -> float:
    """Mean squared error of some photos against what all Gaussians show there."""
    if prediction.gaussians is None:
        raise ValueError("a rendered picture needs the Gaussian head")
    captured = torch.nonzero(compared)[:, 0].tolist()
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
    )
