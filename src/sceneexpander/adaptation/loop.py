"""Algorithm 1: adapt a reconstructor to one inserted view, held to its own predictions on the captured views."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from sceneexpander.adaptation.checkpoint import Checkpoint
from sceneexpander.adaptation.config import AdaptConfig, DriftForm, InsertedWeights, Precision
from sceneexpander.adaptation.consistency import inserted_weights
from sceneexpander.adaptation.inputs import AdaptationInputs, StepViews, ViewSource, geometry_of, run_key
from sceneexpander.adaptation.ledger import WeightLedger, teacher_of
from sceneexpander.adaptation.losses import ViewGeometry
from sceneexpander.adaptation.objective import NonFiniteLoss, anchor_targets, step_losses
from sceneexpander.adaptation.photometric import learn_from_photo
from sceneexpander.adaptation.sampling import sample_batch
from sceneexpander.models.protocol import Reconstructor, as_module

_log = logging.getLogger(__name__)

__all__ = ["AdaptationInputs", "AdaptationResult", "NonFiniteLoss", "StepRecord", "adapt", "run_key"]


@dataclass(frozen=True, slots=True, kw_only=True)
class StepRecord:
    """What one step did. Loss terms are weighted as they enter the objective (before lambda)."""

    step: int
    captured: int
    inserted: bool
    loss: float
    anchor_camera: float
    anchor_depth: float
    anchor_normal: float
    gen_camera: float
    gen_depth: float
    gen_normal: float
    splat: float  # colour error of the rendered captured view, 0 in steps that render none; see `photometric`
    drift: float  # L_reg before lambda_reg
    gradient_norm: float
    restored: int


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptationResult:
    """theta* and the log. ``seconds`` is the wall time of the steps run by this call."""

    student: dict[str, Tensor]
    teacher: dict[str, Tensor]
    records: tuple[StepRecord, ...]
    seconds: float


def adapt(
    model: Reconstructor,
    inputs: AdaptationInputs,
    config: AdaptConfig,
    *,
    seed: int,
    checkpoint_folder: Path | None = None,
    on_step: Callable[[StepRecord], None] | None = None,
) -> AdaptationResult:
    """Run Algorithm 1 and leave ``model`` with the adapted weights theta*.

    The anchors are read, never recomputed (no resident anchor model); the teacher runs only on steps that see the inserted view; heads
    that no loss uses are not run. With ``config.steps == 0`` the model is untouched.

    Args:
        checkpoint_folder: where resume points live; an unfinished run with the same key continues from its last one. Removed at the end
            by the caller once the result is safe on disk.
        on_step: called with every step's record, resumed ones included.

    Raises:
        NonFiniteLoss: a loss term or the gradient is not finite.
    """
    key = run_key(model, inputs, config, seed)
    run = Run(model, inputs, config, seed)
    records: list[StepRecord] = []
    if checkpoint_folder is not None and (saved := Checkpoint.load(checkpoint_folder, key)) is not None:
        records = run.resume(saved)
        _log.info("resumed the adaptation after step %d", saved.step)
        for record in records:
            if on_step is not None:
                on_step(record)
    started = time.perf_counter()
    for step in range(len(records) + 1, config.steps + 1):
        record = run.step(step)
        records.append(record)
        if on_step is not None:
            on_step(record)
        due = config.checkpoint_every and step % config.checkpoint_every == 0 and step < config.steps
        if checkpoint_folder is not None and due:
            run.checkpoint(key, step, records).save(checkpoint_folder)
    return AdaptationResult(
        student={k: v.detach().clone() for k, v in as_module(run.model).state_dict().items()},
        teacher={k: v.detach().clone() for k, v in as_module(run.teacher).state_dict().items()},
        records=tuple(records),
        seconds=time.perf_counter() - started,
    )


class Run:
    """A running adaptation: student, teacher and the ledger of their weights."""

    def __init__(self, model: Reconstructor, inputs: AdaptationInputs, config: AdaptConfig, seed: int) -> None:
        if inputs.captured.shape[0] != len(inputs.anchors.view_ids):
            raise ValueError(f"{inputs.captured.shape[0]} captured views, {len(inputs.anchors.view_ids)} anchors")
        self.model, self.inputs, self.config, self.seed = model, inputs, config, seed
        self.teacher: Reconstructor = teacher_of(model)
        self.source = ViewSource(model, inputs, config, seed=seed)
        self.ledger = WeightLedger(as_module(model), as_module(self.teacher), config, seed=seed)
        anchors = inputs.anchors
        self.anchors = ViewGeometry(camera_vector=anchors.camera_vector, depth=anchors.depth, normals=anchors.normals)

    def step(self, step: int) -> StepRecord:
        """One pass of the loop body of Algorithm 1."""
        config = self.config
        batch = sample_batch(self.inputs.captured.shape[0], config, seed=self.seed, step=step)
        views = self.source.views(batch, step)
        # First the teacher: its activations are gone when the student's, which are kept, are made.
        teacher, weights = self._teach(views, batch.captured) if batch.inserted else (None, None)
        with self._autocast():
            student = geometry_of(views.predict(self.model))
        targets = anchor_targets(self.anchors, batch, views.grids, student, config)
        losses = step_losses(student, targets, teacher, config, weights)
        values = losses.values(step)
        losses.objective.backward()  # type: ignore[no-untyped-call]
        del student, losses
        splat = 0.0
        if config.lambda_splat > 0 and step % config.splat_every == 0:
            with self._autocast():
                splat = learn_from_photo(
                    self.model, self.inputs, config, inserted=batch.inserted, seed=self.seed, step=step
                )
        done = self.ledger.update(step)
        if not math.isfinite(done.gradient):
            raise NonFiniteLoss(f"the gradient is not finite at step {step}")
        drift = done.drift if config.drift is DriftForm.SUM else done.drift / self.ledger.adapted
        return StepRecord(
            step=step,
            captured=len(batch.captured),
            inserted=batch.inserted,
            loss=values.pop("objective") + config.lambda_splat * splat + config.lambda_reg * drift,
            splat=splat,
            drift=drift,
            gradient_norm=done.gradient,
            restored=done.restored,
            **values,
        )

    def _teach(self, views: StepViews, captured: tuple[int, ...]) -> tuple[ViewGeometry, Tensor | None]:
        """The EMA teacher's prediction of the inserted view, from the step's very views, and how its pixels count (None: alike)."""
        with torch.inference_mode(), self._autocast():
            prediction = views.predict(self.teacher)
            taught = geometry_of(prediction).view(len(captured))
            weights = None
            if self.config.inserted_weights is InsertedWeights.CONSISTENT:
                weights = inserted_weights(prediction, self.anchors.depth[list(captured)])
        # As ordinary tensors, which a loss may keep.
        return taught.clone(), None if weights is None else weights.clone()

    def _autocast(self) -> torch.autocast:
        device = self.inputs.captured.device.type
        return torch.autocast(device, dtype=torch.bfloat16, enabled=self.config.precision is Precision.BF16)

    def checkpoint(self, key: str, step: int, records: list[StepRecord]) -> Checkpoint:
        """Everything that step ``step + 1`` depends on."""
        plain = [asdict(record) for record in records]
        return Checkpoint(run_key=key, step=step, buckets=self.ledger.state(), records=plain)

    def resume(self, saved: Checkpoint) -> list[StepRecord]:
        """Take over a checkpoint's state; returns its records."""
        self.ledger.load(saved.buckets)
        return [StepRecord(**record) for record in saved.records]
