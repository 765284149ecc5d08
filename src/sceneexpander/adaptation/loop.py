"""Algorithm 1: adapt a reconstructor to one inserted view, held to its own predictions on the captured views."""

from __future__ import annotations

import copy
import hashlib
import json
import logging
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneexpander.adaptation import weights as weight_ops
from sceneexpander.adaptation.augmentation import augment_view, sample
from sceneexpander.adaptation.checkpoint import Checkpoint, optimiser_state, restore_optimiser
from sceneexpander.adaptation.config import AdaptConfig, Gauge, Precision
from sceneexpander.adaptation.losses import LossTerms, ViewGeometry, anchor_loss, generation_loss
from sceneexpander.adaptation.sampling import Batch, sample_batch
from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.artifacts.store import sha256_of_tensors, to_plain
from sceneexpander.geometry.gauge import camera_vectors_relative_to, priors_relative_to, scale_camera_vectors
from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.randomness import child_generator
from sceneexpander.models.protocol import GEOMETRY_HEADS, Prediction, Reconstructor, as_module

_log = logging.getLogger(__name__)


class NonFiniteLoss(RuntimeError):
    """A loss term became NaN or infinite; the message names the term and the step."""


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
    drift: float  # L_reg before lambda_reg
    gradient_norm: float
    restored: int


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptationInputs:
    """What a round adapts to: n captured views, one inserted view, and the frozen model's anchors on the captured ones.

    ``captured_priors`` describe the captured views alone, ``joint_priors`` the captured views followed by the inserted one; a
    step that does not see the inserted view uses the former, so that with p = 0 nothing of the inserted view reaches the student.
    Models without priors get None for both.
    """

    captured: Float[Tensor, "captured 3 height width"]
    inserted: Float[Tensor, "3 height width"]
    anchors: Anchors
    captured_priors: Priors | None
    joint_priors: Priors | None


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptationResult:
    """theta* and the log. ``seconds`` is the wall time of the steps run by this call."""

    student: dict[str, Tensor]
    teacher: dict[str, Tensor]
    records: tuple[StepRecord, ...]
    seconds: float


def geometry_of(prediction: Prediction) -> ViewGeometry:
    """The part of a prediction that the losses read."""
    if prediction.depth is None or prediction.normals is None:
        raise ValueError("the adaptation needs the depth and normal heads")
    return ViewGeometry(camera_vector=prediction.camera_vector, depth=prediction.depth, normals=prediction.normals)


def run_key(model: Reconstructor, inputs: AdaptationInputs, config: AdaptConfig, seed: int) -> str:
    """Hash of everything that determines an adaptation: weights, views, anchors, priors, configuration, seed."""
    tensors: dict[str, Tensor] = {f"weights/{k}": v for k, v in as_module(model).state_dict().items()}
    tensors |= {"captured": inputs.captured, "inserted": inputs.inserted}
    for label, value in (
        ("anchors", inputs.anchors),
        ("captured", inputs.captured_priors),
        ("joint", inputs.joint_priors),
    ):
        if value is not None:
            plain = {f.name: getattr(value, f.name) for f in value.__dataclass_fields__.values()}
            tensors |= {f"{label}/{k}": v for k, v in plain.items() if isinstance(v, Tensor)}
    settings = json.dumps({"config": to_plain(config), "seed": seed, "model": model.name}, sort_keys=True)
    return hashlib.sha256(f"{sha256_of_tensors(tensors)}:{settings}".encode()).hexdigest()


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
    run = _Run(model, inputs, config, seed)
    key = run_key(model, inputs, config, seed)
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
        student={k: v.detach().clone() for k, v in run.module.state_dict().items()},
        teacher={k: v.detach().clone() for k, v in run.teacher_module.state_dict().items()},
        records=tuple(records),
        seconds=time.perf_counter() - started,
    )


class _Run:
    """The three sets of weights and one optimiser of a running adaptation."""

    def __init__(self, model: Reconstructor, inputs: AdaptationInputs, config: AdaptConfig, seed: int) -> None:
        if inputs.captured.shape[0] != len(inputs.anchors.view_ids):
            raise ValueError(f"{inputs.captured.shape[0]} captured views, {len(inputs.anchors.view_ids)} anchors")
        self.model, self.inputs, self.config, self.seed = model, inputs, config, seed
        self.module: nn.Module = as_module(model)
        self.parameters: dict[str, Tensor] = {
            name: p for name, p in self.module.named_parameters() if p.requires_grad and p.is_floating_point()
        }
        self.names = {p: name for name, p in self.parameters.items()}
        self.teacher: Reconstructor = copy.deepcopy(model)
        self.teacher_module = as_module(self.teacher)
        self.teacher_module.requires_grad_(False)
        teacher_parameters = dict(self.teacher_module.named_parameters())
        self.teacher_parameters = [teacher_parameters[name] for name in self.parameters]
        self.start = {name: p.detach().clone() for name, p in self.parameters.items()}
        self.optimiser = torch.optim.AdamW(
            list(self.parameters.values()), lr=config.learning_rate, weight_decay=config.weight_decay, foreach=True
        )
        anchors = inputs.anchors
        self.anchor_geometry = ViewGeometry(
            camera_vector=anchors.camera_vector, depth=anchors.depth, normals=anchors.normals
        )

    def step(self, step: int) -> StepRecord:
        """One pass of the loop body of Algorithm 1."""
        config = self.config
        batch = sample_batch(self.inputs.captured.shape[0], config, seed=self.seed, step=step)
        images, grids = self._images(batch, step)
        priors = self._priors(batch)
        count = len(batch.captured)

        with self._autocast():
            student = geometry_of(self.model.predict(images, priors, heads=GEOMETRY_HEADS))
        targets = self._anchor_targets(batch, grids, student)
        anchor = anchor_loss(student.view(0, count), targets, config)
        zero = anchor.total.new_zeros(())
        gen = LossTerms(camera=zero, depth=zero, normal=zero)
        if batch.inserted:
            with torch.no_grad(), self._autocast():
                teacher = geometry_of(self.teacher.predict(images, priors, heads=GEOMETRY_HEADS))
            gen = generation_loss(student.view(count), teacher.view(count), config)
        objective = config.lambda_anchor * anchor.total + config.lambda_gen * gen.total
        # One transfer for all terms: they are needed on the host for the log and for the check.
        values = torch.stack(
            [anchor.camera, anchor.depth, anchor.normal, gen.camera, gen.depth, gen.normal, objective]
        ).tolist()
        self._check_finite(values, step)
        self.optimiser.zero_grad(set_to_none=True)
        objective.backward()  # type: ignore[no-untyped-call]
        drift, gradient_norm = self._regularise(step)
        self.optimiser.step()
        with torch.no_grad():
            student_weights = list(self.parameters.values())
            weight_ops.ema_update(self.teacher_parameters, student_weights, config.ema_momentum)
            restored = 0
            if config.restore_interval and step % config.restore_interval == 0:
                start = list(self.start.values())
                restored = weight_ops.restore(student_weights, start, config.restore_rate, seed=self.seed, step=step)
        return StepRecord(
            step=step,
            captured=count,
            inserted=batch.inserted,
            loss=values[6] + config.lambda_reg * drift,
            anchor_camera=values[0],
            anchor_depth=values[1],
            anchor_normal=values[2],
            gen_camera=values[3],
            gen_depth=values[4],
            gen_normal=values[5],
            drift=drift,
            gradient_norm=gradient_norm,
            restored=restored,
        )

    def _autocast(self) -> torch.autocast:
        device = self.inputs.captured.device.type
        return torch.autocast(device, dtype=torch.bfloat16, enabled=self.config.precision is Precision.BF16)

    def _images(self, batch: Batch, step: int) -> tuple[Tensor, list[Tensor | None]]:
        """The step's views (captured ones augmented, the inserted one as it is) and the warps of the captured ones."""
        images, grids = [], []
        for index in batch.captured:
            generator = child_generator(self.seed, f"adapt/augment/{step}/{index}")
            image, grid = augment_view(self.inputs.captured[index], self.config.augment, generator)
            images.append(image)
            grids.append(grid)
        if batch.inserted:
            images.append(self.inputs.inserted)
        return torch.stack(images), grids

    def _priors(self, batch: Batch) -> Priors | None:
        source = self.inputs.joint_priors if batch.inserted else self.inputs.captured_priors
        if source is None:
            return None
        views = [*batch.captured, self.inputs.captured.shape[0]] if batch.inserted else list(batch.captured)
        picked = source.select(views)
        return picked if batch.captured[0] == 0 else priors_relative_to(picked, 0)

    def _anchor_targets(self, batch: Batch, grids: list[Tensor | None], student: ViewGeometry) -> ViewGeometry:
        """Anchors of the batch's captured views, in the gauge of the batch's first view."""
        index = list(batch.captured)
        geometry = self.anchor_geometry
        depth, normals = geometry.depth[index], geometry.normals[index]
        camera = geometry.camera_vector[index]
        if self.config.gauge is Gauge.REALIGN and index[0] != 0:
            camera = camera_vectors_relative_to(camera, 0)
            # Another first view may also change the scale that the model chooses: compare in the student's.
            ratio = (student.depth[: len(index)].detach() / depth).flatten().median()
            camera, depth = scale_camera_vectors(camera, ratio), depth * ratio
        if self.config.warp_targets:
            depth, normals = _warp_maps(depth, normals, grids)
        return ViewGeometry(camera_vector=camera, depth=depth, normals=normals)

    def _regularise(self, step: int) -> tuple[float, float]:
        """Add the drift gradient; returns (L_reg, norm of the whole gradient)."""
        stepped = [name for name, p in self.parameters.items() if p.grad is not None]
        weights = [self.parameters[name] for name in stepped]
        gradients = [w.grad for w in weights if w.grad is not None]
        start = [self.start[name] for name in stepped]
        with torch.no_grad():
            weight_ops.add_drift_gradient(weights, gradients, start, self.config.lambda_reg, self.config.drift)
            drift = weight_ops.drift_squared(weights, start, self.config.drift)
            norm = torch.stack(torch._foreach_norm(gradients)).norm()
        if not torch.isfinite(norm):
            raise NonFiniteLoss(f"the gradient is not finite at step {step}")
        return float(drift), float(norm)

    @staticmethod
    def _check_finite(values: list[float], step: int) -> None:
        names = ("anchor_camera", "anchor_depth", "anchor_normal", "gen_camera", "gen_depth", "gen_normal", "objective")
        for name, value in zip(names, values, strict=True):
            if not math.isfinite(value):
                raise NonFiniteLoss(f"{name} is {value} at step {step}")

    def checkpoint(self, key: str, step: int, records: list[StepRecord]) -> Checkpoint:
        """Everything that step ``step + 1`` depends on."""
        first, second, steps = optimiser_state(self.optimiser, self.names)
        return Checkpoint(
            run_key=key,
            step=step,
            student=dict(self.module.state_dict()),
            teacher=dict(self.teacher_module.state_dict()),
            first_moment=first,
            second_moment=second,
            optimiser_steps=steps,
            records=[asdict(record) for record in records],
        )

    def resume(self, saved: Checkpoint) -> list[StepRecord]:
        """Take over a checkpoint's state; returns its records."""
        self.module.load_state_dict(saved.student)
        self.teacher_module.load_state_dict(saved.teacher)
        restore_optimiser(self.optimiser, self.parameters, saved)
        return [StepRecord(**record) for record in saved.records]


def _warp_maps(depth: Tensor, normals: Tensor, grids: list[Tensor | None]) -> tuple[Tensor, Tensor]:
    """Move depth and normals with the pixels of their views (option ``warp_targets``)."""
    moved_depth, moved_normals = [], []
    for view, grid in enumerate(grids):
        if grid is None:
            moved_depth.append(depth[view])
            moved_normals.append(normals[view])
            continue
        maps = sample(torch.cat([depth[view][None], normals[view].permute(2, 0, 1)]), grid)
        moved_depth.append(maps[0])
        moved_normals.append(torch.nn.functional.normalize(maps[1:].permute(1, 2, 0), dim=-1))
    return torch.stack(moved_depth), torch.stack(moved_normals)
