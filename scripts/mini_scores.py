"""Measure the shipped `mini` on held-out scenes: `python scripts/mini_scores.py [--scenes 200]`.

Writes outputs/mini_scores.json, rows of a value and of the same number of simpler estimates. The default takes two and
a half minutes on one core; the whole set is 200 scenes. With --samples, what the front-end makes of the scenes is kept, so that other
weights are compared on the same scenes in a fraction of the time.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from rich.progress import Progress

from sceneexpander.config.compose import compose
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.errors import UserError, entry_point
from sceneexpander.files import write_bytes_atomic
from sceneexpander.models.mini import Mini
from sceneexpander.models.weights import resolve_weights
from sceneexpander.photometric.config import WarmupConfig
from sceneexpander.photometric.report import FitReport
from sceneexpander.photometric.warmup import warm_up
from sceneexpander.pipeline.project import find_project
from sceneexpander.training.scores import (
    HEIGHT,
    INPUTS,
    WIDTH,
    SceneScores,
    ScoreRow,
    scene_samples,
    score_samples,
    score_table,
)

FIRST_SEED = 800_001  # of the held-out stream; training and validation draw from others


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=12, help="held-out scenes")
    parser.add_argument("--own-cameras", type=int, help="scenes that also run the whole front-end (default: a third)")
    parser.add_argument("--warm-ups", type=int, help="of these, scenes that are also warmed up (default: all of them)")
    parser.add_argument("--weights", default="builtin", help="builtin or a .safetensors path")
    parser.add_argument("--samples", type=Path, help="keep the front-end's results of the scenes in this folder")
    parser.add_argument("--processes", type=int, default=1, help="scenes at once, one thread each")
    parser.add_argument("--out", type=Path, default=Path("outputs/mini_scores.json"))
    return parser.parse_args()


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One scene to score."""

    seed: int
    more: bool  # with slightly wrong cameras and with the front-end's own, too
    warm_up: WarmupConfig | None  # with the front-end's own cameras
    weights: Path
    samples: Path | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Scored:
    """The numbers of one scene."""

    scores: SceneScores
    warm_up: FitReport | None


def score(job: Job) -> Scored:
    """Make the scene, or take it from where it is kept, and score the model on it."""
    samples = scene_samples(job.seed, noisy=job.more, front_end=job.more, kept=job.samples)
    model, own, report = Mini.from_weights(job.weights), samples.own_cameras, None
    scores = score_samples(model, samples)
    if job.warm_up is not None and own is not None:
        report = warm_up(model, own.input_images, own.priors(), job.warm_up, seed=job.seed)
    return Scored(scores=scores, warm_up=report)


def warm_up_table(reports: Sequence[FitReport]) -> list[ScoreRow]:
    """What the warm-up does to the error on cells that it does not see; it is put back where that does not fall."""
    changes = torch.tensor([report.after / report.before - 1 for report in reports])
    rows = (
        ("share of scenes better on held-out cells", float((changes < 0).float().mean()), "higher"),
        ("share of scenes worse on held-out cells (put back)", float((changes > 0).float().mean()), "lower"),
        ("median change of the error on held-out cells", float(changes.median()), "lower"),
    )
    return [
        ScoreRow(name=f"warm-up: {name}", value=value, better=better, baselines={}, scenes=len(reports))
        for name, value, better in rows
    ]


@entry_point
def main() -> None:
    """Entry point."""
    arguments = parse_arguments()
    if arguments.scenes < 1:
        raise UserError(f"must be at least 1, is {arguments.scenes}", where="--scenes", fix="ask for one scene or more")
    if arguments.processes < 1:
        raise UserError(f"must be at least 1, is {arguments.processes}", where="--processes", fix="ask for 1 or more")
    weights = resolve_weights(arguments.weights, model=Mini.name)
    own = -(-arguments.scenes // 3) if arguments.own_cameras is None else arguments.own_cameras
    warmed = own if arguments.warm_ups is None else min(own, arguments.warm_ups)
    config = parse_dataclass(ProjectConfig, compose(find_project() / "conf", ["model=mini"]))
    jobs = [
        Job(
            seed=FIRST_SEED + k,
            more=k < own,
            warm_up=config.warmup if k < warmed else None,
            weights=weights.path,
            samples=arguments.samples,
        )
        for k in range(arguments.scenes)
    ]
    with Progress(transient=True) as progress:
        if arguments.processes == 1:
            scored = [score(job) for job in progress.track(jobs, description="scenes")]
        else:
            context = multiprocessing.get_context("spawn")
            with ProcessPoolExecutor(
                arguments.processes, context, initializer=torch.set_num_threads, initargs=(1,)
            ) as pool:
                scored = list(progress.track(pool.map(score, jobs), total=len(jobs), description="scenes"))
    table = score_table([scene.scores for scene in scored])
    if reports := [scene.warm_up for scene in scored if scene.warm_up is not None]:
        table += warm_up_table(reports)
    report = {
        "schema": 2,
        "model": Mini.name,
        "weights_sha256": weights.sha256,
        "data": "procedural scenes, held-out textures; one depth scale per scene",
        "inputs": INPUTS,
        "image": [HEIGHT, WIDTH],
        "first_seed": FIRST_SEED,
        "scenes": arguments.scenes,
        "torch": torch.__version__,
        "rows": [asdict(row) for row in table],
    }
    write_bytes_atomic(arguments.out, (json.dumps(report, indent=1) + "\n").encode())
    for row in table:
        others = ", ".join(f"{name} {value:.3f}" for name, value in row.baselines.items())
        print(f"{row.name:62s} {row.value:8.3f}  {row.better:7s} n={row.scenes:<4d} {others}")


if __name__ == "__main__":
    main()
