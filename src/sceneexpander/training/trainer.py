"""The training loop: gradient accumulation over single scenes, EMA, cosine schedule, resumable checkpoints."""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from sceneexpander.files import complete_file
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.models.mini.config import MiniConfig
from sceneexpander.models.mini.model import Mini
from sceneexpander.models.protocol import ALL_HEADS, GEOMETRY_HEADS, Head, Prediction
from sceneexpander.splatting import render
from sceneexpander.training.augment import augment
from sceneexpander.training.buffer import BufferReader, stored_indices
from sceneexpander.training.losses import (
    camera_loss,
    confidence_loss,
    depth_loss,
    gradient_loss,
    log_depth_error,
    normal_losses,
    render_loss,
    scale_loss,
    supervised_pixels,
)
from sceneexpander.training.measure import geometry_row, mean_row
from sceneexpander.training.sample import Sample

_LOG = logging.getLogger(__name__)
CHECKPOINT = "checkpoint.safetensors"
CURVE = "curve.jsonl"


@dataclass(frozen=True, slots=True, kw_only=True)
class LossWeights:
    """What each term counts."""

    depth: float = 1.0
    scale: float = 0.3  # of views without a pose
    confidence: float = 0.05
    gradient: float = 0.5
    normals: float = 1.0
    normals_confidence: float = 0.05
    camera: float = 0.0  # 0: the prior cameras; measured to be better than a trained head's
    render: float = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """One training run."""

    seed: int = 0
    steps: int = 20000  # of the schedule
    max_hours: float = 2.0  # the schedule also ends by then, whatever comes first
    batch: int = 2  # scenes per step
    learning_rate: float = 8e-4
    final_learning_rate: float = 1e-5
    warmup_steps: int = 100
    weight_decay: float = 0.02
    betas: tuple[float, float] = (0.9, 0.98)
    clip: float = 1.0
    ema: float = 0.99
    uses: int = 8  # how often a sample is drawn
    half_share: float = 0.4  # of the schedule: scenes at half their resolution, which cost a third
    half_work_px: int = 128  # working resolution meanwhile
    render_every: int = 2  # steps between rendering losses, each on one scene
    checkpoint_minutes: float = 10.0
    threads: int = 1
    weights: LossWeights = field(default_factory=LossWeights)


def sample_losses(
    model: Mini, sample: Sample, generator: torch.Generator, weights: LossWeights, *, rendering: bool
) -> dict[str, Tensor]:
    """Weighted loss terms of one scene."""
    heads = ALL_HEADS - {Head.POINTS} if rendering else GEOMETRY_HEADS
    prediction = model.predict(sample.input_images, sample.priors(), heads=heads)
    assert prediction.depth is not None and prediction.depth_conf is not None  # noqa: S101, PT018 - asked for
    assert prediction.normals is not None and prediction.normals_conf is not None  # noqa: S101, PT018
    valid = supervised_pixels(sample)
    error = log_depth_error(prediction.depth.log(), sample, valid)
    confident = sample.priors_confident().float()
    normals, normals_confidence = normal_losses(prediction.normals, prediction.normals_conf, sample)
    terms = {
        "depth": weights.depth * depth_loss(error, valid, confident),
        "scale": weights.scale * scale_loss(prediction.depth.log(), sample, valid),
        "confidence": weights.confidence * confidence_loss(error, prediction.depth_conf, valid),
        "gradient": weights.gradient * gradient_loss(error, valid),
        "normals": weights.normals * normals,
        "normals_confidence": weights.normals_confidence * normals_confidence,
    }
    if weights.camera and not sample.wrong_focal:
        scale = float(sample.prior_log_depth.median().exp())
        terms["camera"] = weights.camera * camera_loss(prediction, sample, scale)
    if rendering:
        terms["render"] = weights.render * _rendering_term(prediction, sample, generator)
    return terms


def _rendering_term(prediction: Prediction, sample: Sample, generator: torch.Generator) -> Tensor:
    """Render one input view, and one held-out view where the priors' cameras are good enough to expect agreement."""
    assert prediction.gaussians is not None  # noqa: S101 - asked for
    height, width = sample.images.shape[-2:]
    posed = torch.nonzero(sample.posed)[:, 0]
    view = int(posed[int(torch.randint(len(posed), (), generator=generator))])
    poses = [prediction.world_from_cam[view].detach()]
    intrinsics = [prediction.intrinsics_px[view].detach()]
    truth = [sample.images[view]]
    if len(sample.images) > sample.inputs and not sample.wrong_focal and _pose_error(sample) < 0.01:
        poses.append(sample.world_from_cam[sample.inputs])
        intrinsics.append(sample.intrinsics_px[sample.inputs])
        truth.append(sample.images[sample.inputs])
    rendered = render(prediction.gaussians, Cameras(torch.stack(poses), torch.stack(intrinsics), height, width))
    losses = [render_loss(rendered.rgb[:1], torch.stack(truth[:1]))]
    if len(truth) > 1:
        # Only what the inputs show: nobody can know the rest.
        known = sample.visible_from(sample.inputs, posed.tolist()).float()[None, None]
        new = ((rendered.rgb[1:] - torch.stack(truth[1:])).abs() * known).mean() / known.mean().clamp(min=0.1)
        # Inputs are easy to fit by shrinking every Gaussian, so the held-out view counts twice.
        losses += [new, new]
    return torch.stack(losses).mean()


def _pose_error(sample: Sample) -> float:
    """Largest displacement of a camera's picture by its pose error, as a share of depth: rotation (rad) + centre."""
    kept = sample.posed
    difference = sample.prior_world_from_cam[kept] - sample.world_from_cam[: sample.inputs][kept]
    scale = float(sample.prior_log_depth.median().exp())
    return float(difference[:, :3, :3].abs().amax() + difference[:, :3, 3].abs().amax() / scale)


class Trainer:
    """Owns model, EMA weights, optimiser and the state that makes a run resumable."""

    def __init__(self, config: TrainConfig, model_config: MiniConfig, folder: Path, samples: Path) -> None:
        torch.set_num_threads(config.threads)
        self.config = config
        self.folder = folder
        with torch.random.fork_rng():  # layers draw their initial values from torch's global stream
            torch.manual_seed(config.seed)
            self.model = Mini(model_config)
        self.ema = {name: value.clone() for name, value in self.model.state_dict().items()}
        self.optimizer = torch.optim.AdamW(
            self._groups(), lr=config.learning_rate, betas=config.betas, weight_decay=config.weight_decay
        )
        self.generator = torch.Generator().manual_seed(config.seed)
        self.reader = BufferReader(samples, config.uses, self.generator)
        self.step = 0
        self.seen = 0  # scenes
        self.seconds = 0.0  # of training, over all resumes
        self.cpu_seconds = 0.0

    def start_from(self, weights: Path) -> None:
        """Begin with the weights of a file instead of random ones. Raises what `Mini.from_weights` raises."""
        self.model.load_state_dict(Mini.from_weights(weights).state_dict())
        self.ema = {name: value.clone() for name, value in self.model.state_dict().items()}

    def _groups(self) -> list[dict[str, object]]:
        decayed = [p for p in self.model.parameters() if p.ndim > 1]
        plain = [p for p in self.model.parameters() if p.ndim <= 1]
        return [{"params": decayed}, {"params": plain, "weight_decay": 0.0}]

    @property
    def progress(self) -> float:
        """Position in the schedule, 0 to 1."""
        return min(max(self.step / self.config.steps, self.seconds / 3600 / self.config.max_hours), 1.0)

    @property
    def _half(self) -> bool:
        return self.progress < self.config.half_share

    def learning_rate(self) -> float:
        """Linear warm-up, then cosine."""
        config = self.config
        cosine = (1 + math.cos(math.pi * self.progress)) / 2
        rate = config.final_learning_rate + (config.learning_rate - config.final_learning_rate) * cosine
        return rate * min((self.step + 1) / config.warmup_steps, 1.0)

    def train_step(self, samples: list[Sample]) -> dict[str, float]:
        """One optimiser step on these scenes; returns the mean of every loss term."""
        rendering = self.config.weights.render > 0 and self.step % self.config.render_every == 0
        sums: dict[str, list[float]] = {}
        self.optimizer.zero_grad(set_to_none=True)
        for index, sample in enumerate(samples):
            renders = rendering and index == 0
            terms = sample_losses(self.model, sample, self.generator, self.config.weights, rendering=renders)
            total = torch.stack(list(terms.values())).sum()
            if not bool(torch.isfinite(total)):
                raise FloatingPointError(
                    f"loss not finite at step {self.step}: { ({k: float(v) for k, v in terms.items()}) }, seed {sample.seed}"
                )
            torch.autograd.backward(total / len(samples))
            for name, value in terms.items():
                sums.setdefault(name, []).append(float(value.detach()))
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.config.clip)
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate()
        self.optimizer.step()
        decay = min(self.config.ema, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for name, value in self.model.state_dict().items():
                self.ema[name].lerp_(value, 1 - decay)
        self.step += 1
        self.seen += len(samples)
        return {name: sum(values) / len(values) for name, values in sums.items()} | {"grad_norm": float(norm)}

    def batches(self) -> Iterator[list[Sample]]:
        """Augmented scenes from the buffer."""
        while True:
            samples = [augment(self.reader.draw(), self.generator) for _ in range(self.config.batch)]
            yield [sample.halved() for sample in samples] if self._half else samples

    def run(self, validation: list[Sample], report: Callable[[dict[str, Any]], None] = lambda line: None) -> None:
        """Train to the end of the schedule, with a checkpoint and a validation every few minutes.

        ``report`` gets every new line of the learning curve.
        """
        full = self.model.config
        clock, clock_cpu = time.monotonic(), time.process_time()
        last_saved = clock
        recent: list[dict[str, float]] = []
        for batch in self.batches():
            self.model.config = replace(full, work_px=self.config.half_work_px) if self._half else full
            recent.append(self.train_step(batch))
            now, now_cpu = time.monotonic(), time.process_time()
            self.seconds, clock = self.seconds + now - clock, now
            self.cpu_seconds, clock_cpu = self.cpu_seconds + now_cpu - clock_cpu, now_cpu
            done = self.progress >= 1
            if done or time.monotonic() - last_saved > self.config.checkpoint_minutes * 60:
                self.model.config = full
                self.save()
                report(self.log(recent, self.validate(validation)))
                recent, last_saved = [], time.monotonic()
            if done:
                return

    def validate(self, samples: list[Sample]) -> dict[str, float]:
        """Mean scores of the EMA weights on the fixed held-out scenes."""
        model = self.ema_model()
        return mean_row(geometry_row(model, sample) for sample in samples)

    def ema_model(self) -> Mini:
        """A model with the averaged weights."""
        model = Mini(self.model.config)
        model.load_state_dict(self.ema)
        return model

    def log(self, recent: list[dict[str, float]], scores: dict[str, float]) -> dict[str, Any]:
        """Append one line to the learning curve, and return it."""
        names = sorted({name for row in recent for name in row})
        means = {
            name: sum(row[name] for row in recent if name in row) / sum(name in row for row in recent) for name in names
        }
        line = {
            "step": self.step,
            "scenes": self.seen,
            "minutes": self.seconds / 60,
            "cpu_minutes": self.cpu_seconds / 60,
            "learning_rate": self.learning_rate(),
            "buffer": len(stored_indices(self.reader.folder)),
            "loss": means,
            "validation": scores,
        }
        with (self.folder / CURVE).open("a") as file:
            file.write(json.dumps(line) + "\n")
        keys = ("network/within", "base/within", "network/within_unconfident", "base/within_unconfident")
        shown = {key: round(scores[key], 3) for key in keys if key in scores}
        _LOG.info("step %d, %d scenes, %.1f min: %s", self.step, self.seen, self.seconds / 60, shown)
        return line

    def save(self) -> None:
        """Write the whole state atomically."""
        self.folder.mkdir(parents=True, exist_ok=True)
        tensors = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        tensors |= {f"ema.{name}": value for name, value in self.ema.items()}
        for index, state in self.optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{index}.{key}": torch.as_tensor(value) for key, value in state.items()}
        tensors["generator"] = self.generator.get_state()
        facts = {
            "step": self.step,
            "seen": self.seen,
            "seconds": self.seconds,
            "cpu_seconds": self.cpu_seconds,
            "used": self.reader.used,
            "model": self.model.config.to_dict(),
            "config": asdict(self.config),
        }
        whole = {name: value.contiguous() for name, value in tensors.items()}
        with complete_file(self.folder / CHECKPOINT) as scratch:
            save_file(whole, scratch, {"state": json.dumps(facts)})

    def resume(self) -> bool:
        """Continue from the folder's checkpoint, if there is one."""
        path = self.folder / CHECKPOINT
        if not path.exists():
            return False
        with safe_open(path, framework="pt") as file:
            facts = json.loads(file.metadata()["state"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict

        def part(prefix: str) -> dict[str, Tensor]:
            return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}

        self.model.load_state_dict(part("model."))
        self.ema = part("ema.")
        states: dict[int, dict[str, Tensor]] = {}
        for name, value in part("optimizer.").items():
            index, key = name.split(".", 1)
            states.setdefault(int(index), {})[key] = value
        packed = self.optimizer.state_dict()
        self.optimizer.load_state_dict({"state": states, "param_groups": packed["param_groups"]})
        self.generator.set_state(tensors["generator"])
        self.step, self.seen = int(facts["step"]), int(facts["seen"])
        self.seconds, self.cpu_seconds = float(facts["seconds"]), float(facts["cpu_seconds"])
        self.reader.used = {int(index): int(count) for index, count in facts["used"].items()}
        if not self.config.weights.camera:
            self._drop_camera_residual()
        return True

    def _drop_camera_residual(self) -> None:
        """Cameras that are not trained stay the priors', whatever an earlier part of the run taught the head."""
        self.model.network.reset_camera_residual()
        for name, value in self.model.state_dict().items():
            if name.startswith("network.camera_head."):
                self.ema[name].copy_(value)
