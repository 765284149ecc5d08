"""The method as a value: what a round does, composed once from the configuration and run alike by stages, benchmark and scripts.

A round is corrections of its inputs, Algorithm 1, corrections of the adapted weights, the expanded scene made with them, corrections of
that scene, and the fit of its Gaussians to the pictures. All but Algorithm 1 is beyond the paper, and off in ``method=paper``.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from torch import Tensor

from sceneexpander.adaptation.config import AdaptConfig, Spend
from sceneexpander.adaptation.loop import AdaptationInputs, AdaptationResult, StepRecord, adapt
from sceneexpander.adaptation.observe import Look
from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.state import ExpansionState, WeightsChange
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.insertion.acceptance import captured_moved
from sceneexpander.insertion.config import CorrectionsConfig
from sceneexpander.insertion.contradiction import pixel_trust
from sceneexpander.insertion.protocol import (
    InputsCorrection,
    RoundContext,
    RoundInputs,
    SceneCorrection,
    WeightsCorrection,
)
from sceneexpander.insertion.report import CorrectionsReport
from sceneexpander.photometric.config import RefineConfig
from sceneexpander.photometric.fitting import fit_to_views
from sceneexpander.photometric.report import FitReport
from sceneexpander.reconstruction.loaded import LoadedModel
from sceneexpander.reconstruction.views import device_priors, predict, reconstruct

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodConfig:
    """The sections that say what a round does to one scene: Algorithm 1, and what is done around it."""

    adapt: AdaptConfig
    corrections: CorrectionsConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Watch:
    """What a caller wants to be told of the steps of Algorithm 1, and where their resume points and pictures go; see `adapt`."""

    on_step: Callable[[StepRecord], None] | None = None
    on_look: Callable[[Look], None] | None = None
    checkpoint_folder: Path | None = None
    looks_folder: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Adapted:
    """A round after Algorithm 1: the corrected inputs, the adapted weights, and the log of the steps."""

    inputs: RoundInputs
    weights: WeightsChange
    result: AdaptationResult


@dataclass(frozen=True, slots=True, kw_only=True)
class Expanded:
    """A finished round: what the next one starts from, the expanded scene, and what was done.

    ``fit`` is None if the Gaussians stayed as the model made them.
    """

    state: ExpansionState
    scene: Reconstruction
    adaptation: AdaptationResult
    corrections: CorrectionsReport
    fit: FitReport | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Procedure:
    """One round's method, see `compose_procedure`.

    Attributes:
        before: corrections of the inputs, in order.
        algorithm: Algorithm 1.
        weights: corrections of the adapted weights, in order.
        after: corrections of the expanded scene, in order.
        fit: of the scene's Gaussians to the pictures that the round worked with.
        doubted: whether that fit, and whatever else asks, weighs generated pictures by what photos say of them.
        name: the method's, in tables.
    """

    before: tuple[InputsCorrection, ...]
    algorithm: AdaptConfig
    weights: tuple[WeightsCorrection, ...]
    after: tuple[SceneCorrection, ...]
    fit: RefineConfig
    doubted: bool
    name: str = "sceneexpander"

    def without_steps(self) -> Procedure:
        """The method ``corrected``: everything that is beyond the paper, with the weights that the round starts from.

        What the whole procedure brings more is due to what changes weights.
        """
        return replace(self, algorithm=replace(self.algorithm, steps=0), weights=(), name="corrected")

    def run(self, inputs: RoundInputs, loaded: LoadedModel, *, seed: int, watch: Watch | None = None) -> Expanded:
        """The whole round: `adapt`, then `finish`."""
        return self.finish(self.adapt(inputs, loaded, seed=seed, watch=watch), loaded, seed=seed)

    def adapt(self, inputs: RoundInputs, loaded: LoadedModel, *, seed: int, watch: Watch | None = None) -> Adapted:
        """The corrections of the inputs, then Algorithm 1; without a step where `Spend` does not want any."""
        inputs = self.correct_inputs(inputs, loaded, seed=seed)
        watch = Watch() if watch is None else watch
        config, state = self.algorithm, inputs.state
        if config.steps and not _worth_adapting(inputs, loaded, config):
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
            checkpoint_folder=watch.checkpoint_folder,
            on_step=watch.on_step,
            on_look=watch.on_look,
            looks_folder=watch.looks_folder,
        )
        # Without a step nothing changed: keep the very change that the round started from, bit for bit.
        weights = WeightsChange.between(loaded.base, result.student) if config.steps else state.weights
        return Adapted(inputs=inputs, weights=weights, result=result)

    def correct_inputs(self, inputs: RoundInputs, loaded: LoadedModel, *, seed: int) -> RoundInputs:
        """What Algorithm 1 takes."""
        for correction in self.before:
            inputs = correction.correct_inputs(inputs, self._context(loaded, seed))
        return inputs

    def finish(
        self,
        adapted: Adapted,
        loaded: LoadedModel,
        *,
        seed: int,
        on_fit_step: Callable[[int, float], None] | None = None,
    ) -> Expanded:
        """Everything after Algorithm 1. ``on_fit_step`` is told the number of finished steps of the fit and the last loss."""
        inputs, weights, context = adapted.inputs, adapted.weights, self._context(loaded, seed)
        for change in self.weights:
            weights = change.correct_weights(weights, inputs, context)
        views = inputs.views
        scene = reconstruct(views, inputs.joint_priors, loaded, weights, method=self.name)
        for correction in self.after:
            scene = correction.correct_scene(scene, inputs, context)
        trust = None
        if self.fit.visits and self.doubted and bool(scene.generated.any()):
            trust = pixel_trust(scene, views.images)
        scene, fit = fit_to_views(
            scene, views, self.fit, weights=trust, seed=seed, device=loaded.device, on_step=on_fit_step
        )
        return Expanded(
            state=_next_state(inputs, weights),
            scene=scene,
            adaptation=adapted.result,
            corrections=inputs.report,
            fit=fit,
        )

    def _context(self, loaded: LoadedModel, seed: int) -> RoundContext:
        return RoundContext(loaded=loaded, seed=seed, doubted=self.doubted)


def compose_procedure(method: MethodConfig, fit: RefineConfig) -> Procedure:
    """The procedure that a configuration describes."""
    corrections = method.corrections.in_order()
    return Procedure(
        before=tuple(one for one in corrections if isinstance(one, InputsCorrection)),
        algorithm=method.adapt,
        weights=tuple(one for one in corrections if isinstance(one, WeightsCorrection)),
        after=tuple(one for one in corrections if isinstance(one, SceneCorrection)),
        fit=fit,
        doubted=method.corrections.contradiction.fade,
    )


def _worth_adapting(inputs: RoundInputs, loaded: LoadedModel, config: AdaptConfig) -> bool:
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


def _next_state(inputs: RoundInputs, weights: WeightsChange) -> ExpansionState:
    state = inputs.state
    return ExpansionState(
        views=state.views.append(inputs.inserted.view),
        priors=inputs.joint_priors,
        weights=weights,
        first_weights=state.unadapted,
        toned=_join_views(state.toned, inputs.toned),
        known=state.known,
    )


def _join_views(before: ViewSet | None, new: ViewSet | None) -> ViewSet | None:
    if before is None or new is None:
        return before if new is None else new
    return before.append(new)


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
