"""Train the embedded reconstructor on procedural scenes: `python scripts/train_mini.py [key=value ...]` (conf/train_mini.yaml).

Resumes from the folder's checkpoint. Stop it at any time; run it again to go on.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig, OmegaConf

from sceneexpander.artifacts.page import flatten
from sceneexpander.errors import entry_point
from sceneexpander.models.mini import Mini, MiniConfig
from sceneexpander.models.weights import resolve_weights
from sceneexpander.pipeline.project import find_project
from sceneexpander.tracking.config import TrackingConfig
from sceneexpander.tracking.curve import CurveRun
from sceneexpander.tracking.record import run_key
from sceneexpander.training.buffer import fill_buffer, sample_path, stored_indices
from sceneexpander.training.generate import GeneratorConfig, training_sample
from sceneexpander.training.sample import Sample
from sceneexpander.training.trainer import LossWeights, TrainConfig, Trainer

MIN_SAMPLES = 40  # in the buffer before training starts


def make_validation(folder: Path, scenes: int, seed: int) -> list[Sample]:
    """The fixed held-out scenes (held-out textures), made where they are missing."""
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(scenes):
        path = sample_path(folder, index)
        if not path.exists():
            training_sample(index, seed, GeneratorConfig(), split="test").save(path)
    return [Sample.load(sample_path(folder, index)) for index in range(scenes)]


def start_filler(config: DictConfig) -> subprocess.Popen[bytes]:
    """A `role=fill` process with low priority; it ends when its standard input closes, so never outlives the trainer."""
    command = [sys.executable, __file__, "role=fill", f"folder={config.folder}", f"samples={config.samples}"]
    command += [f"capacity={config.capacity}", f"data_seed={config.data_seed}"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.Popen(["nice", "-n", "5", *command], stdin=subprocess.PIPE, env=environment)


def wait_for_samples(folder: Path) -> None:
    """Block until the buffer has enough scenes to start."""
    import time

    while len(stored_indices(folder)) < MIN_SAMPLES:
        time.sleep(2)


def settings(config: DictConfig) -> TrainConfig:
    """The typed form of the configuration."""
    values: dict[str, Any] = OmegaConf.to_container(config.train, resolve=True)  # type: ignore[assignment]
    weights: dict[str, Any] = OmegaConf.to_container(config.weights, resolve=True)  # type: ignore[assignment]
    return replace(TrainConfig(**values), weights=LossWeights(**weights))


def train(config: DictConfig) -> None:
    """Train, or go on training."""
    folder, samples = Path(config.folder), Path(config.samples)
    folder.mkdir(parents=True, exist_ok=True)
    validation = make_validation(Path(config.validation), config.validation_scenes, config.validation_seed)
    trainer = Trainer(settings(config), MiniConfig(), folder, samples)
    resumed = trainer.resume()
    if not resumed and config.initial_weights is not None:
        trainer.start_from(resolve_weights(config.initial_weights, model=Mini.name).path)
    logging.info(
        "%s at step %d, %d parameters", "resumed" if resumed else "started", trainer.step, parameters(trainer.model)
    )
    filler = start_filler(config) if config.fill_in_background else None
    try:
        wait_for_samples(samples)
        curve = learning_curve(config)
        trainer.run(validation, lambda line: curve.add(line["step"], curve_points(line)))
        curve.finish()
    finally:
        if filler is not None and filler.stdin is not None:
            filler.stdin.close()
            filler.wait()


def learning_curve(config: DictConfig) -> CurveRun:
    """The run of MLflow that holds this training's curves; a resumed training goes on with the run it began."""
    values: dict[str, Any] = OmegaConf.to_container(config, resolve=True)  # type: ignore[assignment]
    return CurveRun(
        run_key("train_mini", str(Path(config.folder).resolve())),
        name=f"mini, training in {config.folder}",
        params=flatten({key: values[key] for key in ("train", "weights", "data_seed", "initial_weights")}),
        config=TrackingConfig(uri=config.tracking.uri, experiment=config.tracking.experiment),
        root=find_project(),
    )


def curve_points(line: dict[str, Any]) -> dict[str, float]:
    """The numbers of a line of the learning curve, by the names of their curves."""
    plain = {key: float(line[key]) for key in ("scenes", "cpu_minutes", "learning_rate", "buffer")}
    return plain | {f"loss/{k}": v for k, v in line["loss"].items()} | line["validation"]


def parameters(model: torch.nn.Module) -> int:
    """Number of parameters."""
    return sum(parameter.numel() for parameter in model.parameters())


def fill(config: DictConfig) -> None:
    """Make samples until standard input closes (the parent has ended) or the process is stopped."""
    import select

    def parent_alive() -> bool:
        return not select.select([sys.stdin], [], [], 0)[0]

    watch = parent_alive if not sys.stdin.isatty() else (lambda: True)
    fill_buffer(Path(config.samples), GeneratorConfig(), config.data_seed, capacity=config.capacity, keep_going=watch)


def export(config: DictConfig) -> None:
    """Write the averaged weights of the checkpoint as the package ships them (half precision, configuration inside)."""
    trainer = Trainer(settings(config), MiniConfig(), Path(config.folder), Path(config.samples))
    if not trainer.resume():
        raise SystemExit(f"no checkpoint in {config.folder}")
    model: Mini = trainer.ema_model()
    model.network.shrink_depth_residual(config.export_gain)
    model.save_weights(Path(config.export_to))
    logging.info("step %d, %.0f minutes -> %s", trainer.step, trainer.seconds / 60, config.export_to)


@hydra.main(version_base="1.3", config_path="../conf", config_name="train_mini")  # type: ignore[untyped-decorator]
@entry_point
def main(config: DictConfig) -> None:
    """Entry point."""
    torch.set_num_threads(1)
    {"train": train, "fill": fill, "export": export}[config.role](config)


if __name__ == "__main__":
    main()
