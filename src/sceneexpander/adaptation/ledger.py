"""All weights of a running adaptation, and the one pass over them that a step makes.

Parameters live in flat buckets: the student's tensors are views into them, so are the teacher's. Every operation of the update
(drift gradient, norms, AdamW, EMA, restoration) is then one kernel per bucket, whatever the number of parameters. All are float32:
at a learning rate of 1e-5 a bfloat16 weight would never move.
"""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneexpander.adaptation.config import AdaptConfig, DriftForm
from sceneexpander.adaptation.moments import BLOCK, Moments, make_moments
from sceneexpander.geometry.randomness import child_generator
from sceneexpander.models.protocol import as_module

Model = TypeVar("Model", bound=object)

# Small enough for a core's cache; on a GPU large enough for its bandwidth, and small beside the weights.
BUCKET_ELEMENTS = {"cpu": 1 << 18, "cuda": 1 << 23}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bucket:
    """Some adapted parameters in flat tensors, and where each lies in them."""

    names: tuple[str, ...]
    student: Tensor
    teacher: Tensor
    start: Tensor  # theta_0; may live on the host
    moments: Moments

    def tensors(self) -> dict[str, Tensor]:
        """Everything that changes, by name. theta_0 does not."""
        return {"student": self.student, "teacher": self.teacher, **self.moments.state()}


@dataclass(frozen=True, slots=True, kw_only=True)
class UpdateReport:
    """What an update did. ``drift`` is the sum of (theta - theta_0)^2 before it, ``gradient`` the norm with the drift's part."""

    drift: float
    gradient: float
    restored: int


def teacher_of(model: Model) -> Model:
    """A copy without gradients that shares all numbers with the model until a `WeightLedger` gives it its own."""
    module = as_module(model)
    memo: dict[int, object] = {id(p): nn.Parameter(p.detach(), requires_grad=False) for p in module.parameters()}
    memo |= {id(b): b for b in module.buffers()}
    return copy.deepcopy(model, memo=memo)


class WeightLedger:
    """Student, teacher, theta_0 and moments of the parameters that are adapted.

    A parameter is taken in at its first gradient. Those that no loss reaches (heads that are not run) keep one set of numbers, which
    student and teacher share.

    Args:
        student: the model; trainable parameters must be float32.
        teacher: a copy of it made by `teacher_of`.
        config: learning rate, momentum, drift, restoration, and how to keep things.
        seed: of restoration and rounding.
        bucket_elements: weights per bucket; default: what suits the device (`BUCKET_ELEMENTS`).
    """

    def __init__(
        self,
        student: nn.Module,
        teacher: nn.Module,
        config: AdaptConfig,
        *,
        seed: int,
        bucket_elements: int | None = None,
    ) -> None:
        self.config, self.seed = config, seed
        self.parameters = {name: p for name, p in student.named_parameters() if p.requires_grad}
        self.teacher_parameters = dict(teacher.named_parameters())
        wrong = [name for name, p in self.parameters.items() if p.dtype != torch.float32]
        if wrong:
            raise ValueError(f"adapted weights must be float32; {wrong[0]} is {self.parameters[wrong[0]].dtype}")
        self.device = next(student.parameters()).device
        self.bucket_elements = bucket_elements or BUCKET_ELEMENTS.get(self.device.type, BUCKET_ELEMENTS["cuda"])
        self.buckets: list[Bucket] = []
        self.pending = set(self.parameters)
        for parameter in self.parameters.values():
            parameter.grad = None  # one left over from other training would take its parameter in

    @property
    def adapted(self) -> int:
        """Number of adapted weights."""
        return sum(bucket.student.numel() for bucket in self.buckets)

    def take_in(self) -> None:
        """Make buckets for parameters that have a gradient for the first time."""
        fresh = [name for name in self.parameters if name in self.pending and self.parameters[name].grad is not None]
        self.pending -= set(fresh)
        # Whole blocks first: then parameters keep their alignment, and eight-bit blocks do not mix two of them.
        fresh.sort(key=lambda name: self.parameters[name].numel() % BLOCK != 0)
        for names in _split(fresh, self.parameters, self.bucket_elements):
            self._add_bucket(names)

    def _add_bucket(self, names: tuple[str, ...]) -> None:
        student = torch.cat([self.parameters[name].detach().flatten() for name in names])
        bucket = Bucket(
            names=names,
            student=student,
            teacher=student.clone(),
            start=self._kept_start(student),
            moments=make_moments(self.config.engine.moments, student, seed=_stream(self.seed, names)),
        )
        self._bind(bucket)
        self.buckets.append(bucket)

    def _bind(self, bucket: Bucket) -> None:
        """Make the models' parameters views into the bucket."""
        parameters = [self.parameters[name] for name in bucket.names]
        for name, view, teacher_view in zip(
            bucket.names, _views(bucket.student, parameters), _views(bucket.teacher, parameters), strict=True
        ):
            self.parameters[name].data = view
            self.teacher_parameters[name].data = teacher_view

    def split_idle(self) -> None:
        """Give parameters without a gradient a bucket apart from neighbours that have one: those take a step, they do not."""
        for bucket in list(self.buckets):
            idle = [self.parameters[name].grad is None for name in bucket.names]
            if all(idle) or not any(idle):
                continue
            sizes = [self.parameters[name].numel() for name in bucket.names]
            places = torch.split(torch.arange(sum(sizes), device=bucket.student.device), sizes)
            parts = []
            for wanted in (False, True):
                chosen = [k for k, without in enumerate(idle) if without is wanted]
                names = tuple(bucket.names[k] for k in chosen)
                index = torch.cat([places[k] for k in chosen])
                start = bucket.start[index.to(bucket.start.device)]
                parts.append(
                    Bucket(
                        names=names,
                        student=bucket.student[index],
                        teacher=bucket.teacher[index],
                        start=start.pin_memory() if bucket.start.is_pinned() else start,
                        moments=bucket.moments.part(index, seed=_stream(self.seed, names)),
                    )
                )
            at = self.buckets.index(bucket)
            self.buckets[at : at + 1] = parts
            for part in parts:
                self._bind(part)

    def _kept_start(self, student: Tensor) -> Tensor:
        if not self.config.engine.start_on_host or student.device.type == "cpu":
            return student.clone()
        return student.cpu().pin_memory()

    def update(self, step: int) -> UpdateReport:
        """Make the update and read what it did: the only transfer, everything before it runs ahead of the host."""
        drift, squares, restored = self.apply(step).tolist()
        return UpdateReport(drift=drift, gradient=squares**0.5, restored=int(restored))

    @torch.no_grad()
    def apply(self, step: int) -> Float[Tensor, "3"]:
        """Drift gradient, AdamW, EMA (Eq. ema) and every K steps restoration (Eq. restore), bucket by bucket.

        The gradient of ``lambda_reg * L_reg``, 2 lambda (theta - theta_0), is exact and cheap, so it is added here and not by
        autograd. Returns the sum of (theta - theta_0)^2 before the step, the squared norm of the gradient, and how many elements
        were restored. Gradients are consumed. A parameter without one gets no AdamW step, as in torch; the teacher still follows.
        """
        self.take_in()
        self.split_idle()
        config = self.config
        rate = 2 * config.lambda_reg / (1 if config.drift is DriftForm.SUM else self.adapted)
        due = config.restore_interval and step % config.restore_interval == 0
        drift, squares, restored = [], [], []
        for index, bucket in enumerate(self.buckets):
            start = bucket.start.to(bucket.student.device, non_blocking=True)
            difference = bucket.student - start
            drift.append(torch.dot(difference, difference))
            gradient = self._gathered(bucket)
            if gradient is not None:
                gradient.add_(difference, alpha=rate)
                squares.append(torch.dot(gradient, gradient))
                bucket.moments.update(bucket.student, gradient, rate=config.learning_rate, decay=config.weight_decay)
            bucket.teacher.lerp_(bucket.student, 1 - config.ema_momentum)
            if due:
                generator = child_generator(self.seed, f"adapt/restore/{step}/{index}", bucket.student.device)
                restored.append(restore(bucket.student, start, config.restore_rate, generator))
        return torch.stack([_total(values, self.device) for values in (drift, squares, restored)])

    def _gathered(self, bucket: Bucket) -> Tensor | None:
        """The gradients of a bucket in one tensor, taken from the parameters; None if there are none."""
        parameters = [self.parameters[name] for name in bucket.names]
        parts = [p.grad.flatten() for p in parameters if p.grad is not None]
        for parameter in parameters:
            parameter.grad = None
        return torch.cat(parts) if parts else None

    def drift_by_module(self, depth: int) -> dict[str, float]:
        """Norm of theta - theta_0 by the first ``depth`` parts of the parameters' names."""
        squares: dict[str, list[Tensor]] = {}
        for bucket in self.buckets:
            difference = bucket.student - bucket.start.to(bucket.student.device)
            parameters = [self.parameters[name] for name in bucket.names]
            for name, part in zip(bucket.names, _views(difference, parameters), strict=True):
                squares.setdefault(".".join(name.split(".")[:depth]), []).append(part.square().sum())
        return {module: float(torch.stack(values).sum().sqrt()) for module, values in sorted(squares.items())}

    def state(self) -> list[tuple[tuple[str, ...], dict[str, Tensor]]]:
        """(names, tensors) of every bucket: everything the next step depends on besides the model as it was given."""
        return [(bucket.names, bucket.tensors()) for bucket in self.buckets]

    def load(self, state: Sequence[tuple[Sequence[str], Mapping[str, Tensor]]]) -> None:
        """Inverse of `state`, on a fresh ledger over the same model."""
        for names, tensors in state:
            self.pending -= set(names)
            self._add_bucket(tuple(names))
            bucket = self.buckets[-1]
            bucket.student.copy_(tensors["student"])
            bucket.teacher.copy_(tensors["teacher"])
            bucket.moments.load({k: v for k, v in tensors.items() if k not in ("student", "teacher")})


def restore(weights: Tensor, start: Tensor, rate: float, generator: torch.Generator) -> Tensor:
    """Eq. (restore) in place: every element returns to theta_0 with probability ``rate``. Returns how many did, on the device."""
    mask = torch.rand(weights.shape, generator=generator, device=weights.device) < rate
    torch.where(mask, start, weights, out=weights)
    return mask.sum()


def _split(names: Sequence[str], parameters: Mapping[str, Tensor], limit: int) -> Iterator[tuple[str, ...]]:
    """Runs of names whose parameters fill a bucket."""
    bucket: list[str] = []
    filled = 0
    for name in names:
        if bucket and filled + parameters[name].numel() > limit:
            yield tuple(bucket)
            bucket, filled = [], 0
        bucket.append(name)
        filled += parameters[name].numel()
    if bucket:
        yield tuple(bucket)


def _views(flat: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    """Parts of a flat tensor in the shapes of ``like``."""
    parts = torch.split(flat, [p.numel() for p in like])
    return [part.view(p.shape) for part, p in zip(parts, like, strict=True)]


def _total(values: Sequence[Tensor], device: torch.device) -> Tensor:
    if not values:
        return torch.zeros((), dtype=torch.float64, device=device)
    return torch.stack(list(values)).sum(dtype=torch.float64)


def _stream(seed: int, names: Sequence[str]) -> int:
    digest = hashlib.sha256(f"{seed}:adapt/rounding:{names[0]}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 2
