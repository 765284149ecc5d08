"""How good the dense base is on synthetic scenes with known cameras, beside two trivial baselines.

    python benchmarks/dense_base.py --scenes 20 --height 256 --width 320 --json dense_base.json

Every method gets one scale per scene (the median ratio to the truth). AbsRel is the mean of |depth / truth - 1|, d the share
of pixels whose ratio to the truth is under 1.25, both over pixels with a surface. Sparse points are simulated (see
`sceneexpander.training.simulated`).
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
from torch import Tensor

from sceneexpander.frontend.dense import DenseConfig, dense_depth
from sceneexpander.geometry.priors import EVIDENCE_CHANNELS
from sceneexpander.synthetic import make_views
from sceneexpander.training.simulated import perturb_poses, sample_sparse_points


@dataclass(frozen=True, kw_only=True)
class Score:
    """Errors of one depth estimate of one scene."""

    abs_rel: float
    within: float  # share under a ratio of 1.25


@dataclass(frozen=True, kw_only=True)
class SceneResult:
    """One scene: scores of the dense base and the baselines, on all pixels and on the confident ones."""

    seed: int
    dense: Score
    sparse: Score
    constant: Score
    confident: Score | None
    confident_sparse: Score | None
    rest: Score | None
    confident_share: float
    cpu_seconds: float


def score(estimate: Tensor, truth: Tensor, scale: float, where: Tensor) -> Score | None:
    """Errors of ``estimate * scale`` on the pixels ``where``; None if there are none."""
    if not bool(where.any()):
        return None
    ratio = estimate[where] * scale / truth[where]
    within = torch.maximum(ratio, 1 / ratio) < 1.25
    return Score(abs_rel=float((ratio - 1).abs().mean()), within=float(within.float().mean()))


def run_scene(seed: int, args: argparse.Namespace) -> SceneResult:
    """Make a scene, run the dense base on it, score it."""
    scene = make_views(seed, views=args.views, height=args.height, width=args.width, split=args.split)
    generator = torch.Generator().manual_seed(seed)
    sparse = sample_sparse_points(
        scene.images,
        scene.depth,
        scene.valid,
        scene.cameras,
        generator,
        per_view=(args.points_min, args.points_max),
    )
    poses = perturb_poses(scene.world_from_cam, args.pose_noise_deg, args.baseline_noise, generator)
    config = DenseConfig(threads=args.threads)
    start = time.process_time()
    result = dense_depth(scene.images, replace(scene.cameras, world_from_cam=poses), sparse, config)
    seconds = time.process_time() - start

    interpolated = result.depth * result.evidence[:, EVIDENCE_CHANNELS.index("sparse")].exp()
    constant = torch.ones_like(result.depth)
    everywhere, confident = scene.valid, scene.valid & result.confident

    def one_scale(estimate: Tensor) -> float:
        return float((scene.depth[everywhere] / estimate[everywhere]).median())

    def scored(estimate: Tensor, where: Tensor) -> Score | None:
        return score(estimate, scene.depth, one_scale(estimate), where)

    dense, plain, flat = (scored(d, everywhere) for d in (result.depth, interpolated, constant))
    if dense is None or plain is None or flat is None:
        raise ValueError(f"scene {seed} shows no surface")
    return SceneResult(
        seed=seed,
        dense=dense,
        sparse=plain,
        constant=flat,
        confident=scored(result.depth, confident),
        confident_sparse=scored(interpolated, confident),
        rest=scored(result.depth, everywhere & ~result.confident),
        confident_share=float(confident.sum() / everywhere.sum()),
        cpu_seconds=seconds,
    )


def summarise(results: list[SceneResult]) -> dict[str, float]:
    """Means and medians over the scenes."""
    summary: dict[str, float] = {"scenes": len(results)}
    for name in ("dense", "sparse", "constant", "confident", "confident_sparse", "rest"):
        scores = [value for value in (getattr(r, name) for r in results) if value is not None]
        for field in ("abs_rel", "within"):
            values = [getattr(s, field) for s in scores]
            summary[f"{name}/{field}/mean"] = statistics.fmean(values) if values else float("nan")
            summary[f"{name}/{field}/median"] = statistics.median(values) if values else float("nan")
    better = [r.dense.within > r.sparse.within for r in results]
    summary["better_than_sparse"] = sum(better) / len(better)
    summary["confident_share"] = statistics.fmean(r.confident_share for r in results)
    summary["cpu_seconds"] = statistics.fmean(r.cpu_seconds for r in results)
    return summary


def table(summary: dict[str, float]) -> str:
    """The summary as text."""
    lines = [f"{'':18s}{'AbsRel mean':>12s}{'median':>9s}{'d mean':>9s}{'median':>9s}"]
    for name in ("dense", "sparse", "constant", "confident", "confident_sparse", "rest"):
        row = [summary[f"{name}/{field}/{kind}"] for field in ("abs_rel", "within") for kind in ("mean", "median")]
        lines.append(f"{name:18s}{row[0]:12.3f}{row[1]:9.3f}{row[2]:9.3f}{row[3]:9.3f}")
    lines.append(
        f"{int(summary['scenes'])} scenes, confident share {summary['confident_share']:.3f}, d better than sparse in "
        f"{100 * summary['better_than_sparse']:.0f} %, {summary['cpu_seconds']:.2f} CPU-s per scene"
    )
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--height", type=int, default=256)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--split", choices=("train", "test"), default="test")
    parser.add_argument("--points-min", type=int, default=50, help="fewest sparse points drawn per view")
    parser.add_argument("--points-max", type=int, default=150, help="most sparse points drawn per view")
    parser.add_argument("--pose-noise-deg", type=float, default=0.0)
    parser.add_argument("--baseline-noise", type=float, default=0.0, help="as a share of the mean baseline")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write every scene's scores and the summary here")
    args = parser.parse_args()
    torch.set_num_threads(1)
    results = []
    for seed in range(args.first_seed, args.first_seed + args.scenes):
        result = run_scene(seed, args)
        results.append(result)
        print(
            f"seed {seed}: dense {result.dense.abs_rel:.3f} / {result.dense.within:.3f}, sparse "
            f"{result.sparse.abs_rel:.3f} / {result.sparse.within:.3f}, confident {result.confident_share:.2f}, "
            f"{result.cpu_seconds:.2f} CPU-s",
            flush=True,
        )
    summary = summarise(results)
    print(table(summary))
    if args.json:
        args.json.write_text(json.dumps({"summary": summary, "scenes": [asdict(r) for r in results]}, indent=1) + "\n")


if __name__ == "__main__":
    main()
