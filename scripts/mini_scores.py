"""Recompute the quality bars of the shipped `mini` on held-out scenes: `python scripts/mini_scores.py [--scenes 200]`.

Writes outputs/mini_scores.json, one row per bar with its value, the baselines and the demand. The default takes about three
minutes on two cores; the whole set is 200 scenes.
"""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import asdict
from pathlib import Path

import torch
from rich.progress import Progress

from sceneexpander.errors import UserError, entry_point
from sceneexpander.models.mini import Mini
from sceneexpander.models.mini.training.scores import HEIGHT, INPUTS, WIDTH, bars, score_scene
from sceneexpander.models.weights import resolve_weights

FIRST_SEED = 800_001  # of the held-out stream; training and validation draw from others


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=12, help="held-out scenes")
    parser.add_argument("--own-cameras", type=int, help="scenes that also run the whole front-end (default: a third)")
    parser.add_argument("--weights", default="builtin", help="builtin or a .safetensors path")
    parser.add_argument("--out", type=Path, default=Path("outputs/mini_scores.json"))
    return parser.parse_args()


@entry_point
def main() -> None:
    """Entry point."""
    arguments = parse_arguments()
    if arguments.scenes < 1:
        raise UserError(f"must be at least 1, is {arguments.scenes}", where="--scenes", fix="ask for one scene or more")
    weights = resolve_weights(arguments.weights, model=Mini.name)
    model = Mini.from_weights(weights.path)
    own = -(-arguments.scenes // 3) if arguments.own_cameras is None else arguments.own_cameras
    seeds = range(FIRST_SEED, FIRST_SEED + arguments.scenes)
    scores = []
    with Progress(transient=True) as progress:
        for k, seed in enumerate(progress.track(seeds, description="scenes")):
            scores.append(score_scene(model, seed, noisy=k < own, front_end=k < own))
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
