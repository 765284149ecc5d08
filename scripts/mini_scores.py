"""Recompute the quality bars of the shipped `mini` on held-out scenes: `python scripts/mini_scores.py [--scenes 200]`.

Writes outputs/mini_scores.json, one row per bar with its value, the baselines and the demand. The default takes about three
minutes on two cores; the whole set is 200 scenes. With --samples, what the front-end makes of the scenes is kept, so that other
weights are compared on the same scenes in a fraction of the time.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from rich.progress import Progress

from sceneexpander.errors import UserError, entry_point
from sceneexpander.models.mini import Mini
from sceneexpander.models.mini.training.scores import (
    HEIGHT,
    INPUTS,
    WIDTH,
    SceneScores,
    bars,
    scene_samples,
    score_samples,
)
from sceneexpander.models.weights import resolve_weights

FIRST_SEED = 800_001  # of the held-out stream; training and validation draw from others


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=12, help="held-out scenes")
    parser.add_argument("--own-cameras", type=int, help="scenes that also run the whole front-end (default: a third)")
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
    weights: Path
    samples: Path | None


def score(job: Job) -> SceneScores:
    """The numbers of one scene."""
    samples = scene_samples(job.seed, noisy=job.more, front_end=job.more, kept=job.samples)
    return score_samples(Mini.from_weights(job.weights), samples)


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
    jobs = [
        Job(seed=FIRST_SEED + k, more=k < own, weights=weights.path, samples=arguments.samples)
        for k in range(arguments.scenes)
    ]
    with Progress(transient=True) as progress:
        if arguments.processes == 1:
            scores = [score(job) for job in progress.track(jobs, description="scenes")]
        else:
            context = multiprocessing.get_context("spawn")
            with ProcessPoolExecutor(
                arguments.processes, context, initializer=torch.set_num_threads, initargs=(1,)
            ) as pool:
                scores = list(progress.track(pool.map(score, jobs), total=len(jobs), description="scenes"))
    table = bars(scores)
    report = {
        "schema": 1,
        "model": Mini.name,
        "weights_sha256": weights.sha256,
        "data": "procedural scenes, held-out textures; one depth scale per scene",
        "inputs": INPUTS,
        "image": [HEIGHT, WIDTH],
        "first_seed": FIRST_SEED,
        "scenes": arguments.scenes,
        "torch": torch.__version__,
        "rows": [asdict(bar) | {"met": bar.met} for bar in table],
    }
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    scratch = arguments.out.with_suffix(f".{os.getpid()}.partial")
    scratch.write_text(json.dumps(report, indent=1) + "\n")
    os.replace(scratch, arguments.out)
    for bar in table:
        verdict = {True: "met", False: "MISSED", None: ""}[bar.met]
        demand = "" if bar.demand is None else f"demand {bar.demand:g}"
        others = ", ".join(f"{name} {value:.3f}" for name, value in bar.baselines.items())
        print(f"{bar.bar:62s} {bar.value:8.3f}  {demand:12s} {verdict:7s} n={bar.scenes:<4d} {others}")


if __name__ == "__main__":
    main()
