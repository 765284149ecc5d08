"""Algorithm 1: adapt a reconstructor to one inserted view, held to its own predictions on the captured views."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from sceneexpander.adaptation import plateau
from sceneexpander.adaptation.checkpoint import Checkpoint
from sceneexpander.adaptation.config import AdaptConfig, DriftForm
from sceneexpander.adaptation.inputs import AdaptationInputs, ViewSource, geometry_of, heads_of, run_key
from sceneexpander.adaptation.learner import Learner
from sceneexpander.adaptation.losses import ViewGeometry
from sceneexpander.adaptation.objective import NonFiniteLoss
from sceneexpander.adaptation.observe import Look, Observer, warnings_of
from sceneexpander.adaptation.records import StepRecord
from sceneexpander.adaptation.sampling import Batch, sample_batch
from sceneexpander.adaptation.trainable import plain_state, trained_parts
from sceneexpander.geometry.gauge import in_gauge_of
from sceneexpander.models.protocol import Reconstructor, as_module

_log = logging.getLogger(__name__)

__all__ = ["AdaptationInputs", "AdaptationResult", "NonFiniteLoss", "StepRecord", "adapt", "run_key"]


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptationResult:
    """theta* and the log, on the host. ``seconds`` is the wall time of the steps run by this call."""

    student: dict[str, Tensor]
    records: tuple[StepRecord, ...]
    looks: tuple[Look, ...]
    steps_saved: int  # by stopping early
    seconds: float


def adapt(
    model: Reconstructor,
    inputs: AdaptationInputs,
    config: AdaptConfig,
    *,
    seed: int,
    checkpoint_folder: Path | None = None,
    on_step: Callable[[StepRecord], None] | None = None,
    on_look: Callable[[Look], None] | None = None,
    looks_folder: Path | None = None,
) -> AdaptationResult:
    """Run Algorithm 1 and leave ``model`` with the adapted weights theta*.

    The anchors are read, never recomputed (no resident anchor model); the teacher runs only on steps that see the inserted view; heads
    that no loss uses are not run. With ``config.steps == 0`` the model is untouched.

    Args:
        checkpoint_folder: where resume points live; an unfinished run with the same key continues from its last one. Removed at the end
            by the caller once the result is safe on disk.
        on_step: called with every step's record, resumed ones included.
        on_look: the same with every look (each ``observe_every`` steps, before the first and after the last).
        looks_folder: where looks leave their pictures.

    Raises:
        NonFiniteLoss: a loss term or the gradient is not finite.
    """
    key = run_key(model, inputs, config, seed)
    log = RunLog(on_step=on_step, on_look=on_look)
    started = time.perf_counter()
    with trained_parts(model, config, seed=seed):
        run = Run(model, inputs, config, seed)
        run.go(log, Observer(run.learner, run.source, looks_folder), key, checkpoint_folder)
        student = _on_host(run.learner.model)
    for warning in warnings_of(log.looks):
        _log.warning("%s", warning)
    return AdaptationResult(
        student=student,
        records=tuple(log.records),
        looks=tuple(log.looks),
        steps_saved=config.steps - len(log.records),
        seconds=time.perf_counter() - started,
    )


def _look_due(step: int, config: AdaptConfig) -> bool:
    """Before the first step, every so many steps, and after the last."""
    every = config.observe_every
    return bool(every and config.steps) and (step % every == 0 or step == config.steps)


class RunLog:
    """Records and looks so far, told to whoever listens."""

    def __init__(self, *, on_step: Callable[[StepRecord], None] | None, on_look: Callable[[Look], None] | None) -> None:
        self.records: list[StepRecord] = []
        self.looks: list[Look] = []
        self.on_step, self.on_look = on_step, on_look

    @property
    def looked_at(self) -> set[int]:
        """Steps that have been looked at."""
        return {look.step for look in self.looks}

    def add(self, entry: StepRecord | Look) -> None:
        """Keep an entry and pass it on."""
        if isinstance(entry, Look):
            self.looks.append(entry)
            if self.on_look is not None:
                self.on_look(entry)
            return
        self.records.append(entry)
        if self.on_step is not None:
            self.on_step(entry)


class Run:
    """A running adaptation: the learner and where its views come from."""

    def __init__(self, model: Reconstructor, inputs: AdaptationInputs, config: AdaptConfig, seed: int) -> None:
        if inputs.captured.shape[0] != len(inputs.anchors.view_ids):
            raise ValueError(f"{inputs.captured.shape[0]} captured views, {len(inputs.anchors.view_ids)} anchors")
        if inputs.captured_priors is not None and inputs.joint_priors is not None:
            inputs = replace(inputs, joint_priors=in_gauge_of(inputs.captured_priors, inputs.joint_priors))
        self.inputs, self.config, self.seed = inputs, config, seed
        self.source = ViewSource(model, inputs, config, seed=seed)
        anchors = ViewGeometry(
            camera_vector=inputs.anchors.camera_vector,
            depth=inputs.anchors.depth,
            normals=inputs.anchors.normals,
            splats=self._frozen_splats(model) if config.alpha_gaussian > 0 else None,
        )
        self.learner = Learner(model, anchors, config, seed=seed, support=inputs.support)

    @torch.no_grad()
    def _frozen_splats(self, model: Reconstructor) -> Tensor | None:
        """The captured views' Gaussians as the model makes them before its first step, from those views alone."""
        everything = Batch(captured=tuple(range(len(self.inputs.captured))), inserted=False)
        return geometry_of(self.source.plain_views(everything).predict(model, heads_of(self.config))).splats

    def go(self, log: RunLog, observer: Observer, key: str, checkpoint_folder: Path | None) -> None:
        """All steps that are left, with their looks and resume points."""
        config = self.config
        if checkpoint_folder is not None and (saved := Checkpoint.load(checkpoint_folder, key)) is not None:
            self.resume(saved, log)
            _log.info("resumed the adaptation after step %d", saved.step)
        for step in range(len(log.records), config.steps + 1):
            if step > len(log.records):
                log.add(self.step(step))
            stop = plateau.has_plateaued(log.records, config)
            if (_look_due(step, config) or (stop and config.observe_every)) and step not in log.looked_at:
                log.add(observer.look(step))
            if stop and step < config.steps:
                _log.info("the losses no longer fall: stopped after step %d of %d", step, config.steps)
                return
            due = config.checkpoint_every and step and step % config.checkpoint_every == 0 and step < config.steps
            if checkpoint_folder is not None and due:
                self.checkpoint(key, step, log).save(checkpoint_folder)

    def step(self, step: int) -> StepRecord:
        """One pass of the loop body of Algorithm 1."""
        config, ledger = self.config, self.learner.ledger
        batch = sample_batch(self.inputs.captured.shape[0], config, seed=self.seed, step=step)
        losses = self.learner.losses(self.source.views(batch, step), batch)
        values = losses.values(step)
        losses.objective.backward()  # type: ignore[no-untyped-call]
        del losses  # and the activations with them
        done = ledger.update(step)
        if not math.isfinite(done.gradient):
            raise NonFiniteLoss("the gradient is not finite", step)
        drift = done.drift if config.drift is DriftForm.SUM else done.drift / ledger.adapted
        return StepRecord(
            step=step,
            captured=len(batch.captured),
            inserted=batch.inserted,
            loss=values.pop("objective") + config.lambda_reg * drift,
            drift=drift,
            gradient_norm=done.gradient,
            restored=done.restored,
            **values,
        )

    def checkpoint(self, key: str, step: int, log: RunLog) -> Checkpoint:
        """Everything that step ``step + 1`` depends on."""
        return Checkpoint(
            run_key=key,
            step=step,
            buckets=self.learner.ledger.state(),
            records=[asdict(record) for record in log.records],
            looks=[asdict(look) for look in log.looks],
        )

    def resume(self, saved: Checkpoint, log: RunLog) -> None:
        """Take over a checkpoint's state and log."""
        self.learner.ledger.load(saved.buckets)
        for record in saved.records:
            log.add(StepRecord(**record))
        for look in saved.looks:
            log.add(Look(**look))


def _on_host(model: Reconstructor) -> dict[str, Tensor]:
    state = plain_state(as_module(model))
    return {name: value.detach().to("cpu", copy=True) for name, value in state.items()}
