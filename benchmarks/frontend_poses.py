"""How good the cameras of the sparse front-end are, with the focal unknown.

    python benchmarks/frontend_poses.py --scenes 20 --posed FOLDER --photos FOLDER [FOLDER ...] --json poses.json

Synthetic scenes have true cameras. ``--posed`` is a folder with ``images/`` and ``cameras/<name>.txt`` (3x4 camera-to-world,
then 3x3 intrinsics). ``--photos`` are folders of pictures without truth: only registration, focal and errors are printed.
Pair errors: rotation angle, and angle between the translation directions, of every pair of views; AUC@30 is the mean over
thresholds 1..30 degrees of the share of pairs whose larger error is below (a pair with an unposed view counts as wrong).
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from sceneexpander.frontend.dense import DenseConfig
from sceneexpander.frontend.prior import picture_judge
from sceneexpander.frontend.sfm import SfmConfig, SparseReconstruction, estimate_cameras
from sceneexpander.geometry.rigid import rigid_inverse, rotation_angle_deg
from sceneexpander.synthetic import make_views

SUFFIXES = {".jpg", ".jpeg", ".png", ".webp"}
UNPOSED_DEG = 180.0


@dataclass(frozen=True, kw_only=True)
class Row:
    """One image set."""

    name: str
    views: int
    registered: int
    loose: int
    focal_ratio: float
    focal_source: str
    points: int
    angle_deg: float
    error_px: float
    cpu_s: float
    true_focal_ratio: float | None = None
    rotation_deg: tuple[float, ...] = ()
    translation_deg: tuple[float, ...] = ()

    @property
    def worst_deg(self) -> list[float]:
        """The larger error of each pair."""
        return [max(pair) for pair in zip(self.rotation_deg, self.translation_deg, strict=True)]


def auc(errors_deg: Sequence[float], limit: int = 30) -> float:
    """Mean over integer thresholds up to ``limit`` of the share of errors below."""
    return statistics.fmean(
        sum(e < bound for e in errors_deg) / max(len(errors_deg), 1) for bound in range(1, limit + 1)
    )


def measure(
    name: str, images: Tensor, config: SfmConfig, truth: Tensor | None = None, true_intrinsics: Tensor | None = None
) -> Row:
    """Estimate the cameras of one set and compare them with the truth where there is one."""
    start = time.process_time()
    judge = picture_judge(images, DenseConfig(threads=1))
    found = estimate_cameras(images, config, generator=torch.Generator().manual_seed(0), judge=judge)
    spent = time.process_time() - start
    rotation, translation = ((), ()) if truth is None else pair_errors(found, truth)
    report = found.report
    return Row(
        name=name,
        views=len(report.views),
        registered=report.registered,
        loose=sum(view.loose for view in report.views),
        focal_ratio=report.focal_ratio,
        focal_source=str(report.focal_source),
        points=report.points,
        angle_deg=report.median_angle_deg,
        error_px=report.mean_error_px,
        cpu_s=spent,
        true_focal_ratio=None if true_intrinsics is None else float(true_intrinsics[0, 0, 0]) / max(images.shape[-2:]),
        rotation_deg=rotation,
        translation_deg=translation,
    )


def pair_errors(found: SparseReconstruction, truth: Tensor) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """(rotation, translation direction) errors in degrees of every pair of views."""
    rotation, translation = [], []
    estimate, truth = found.world_from_cam.double(), truth.double()
    for a, b in combinations(range(len(truth)), 2):
        if not bool(found.posed[a] & found.posed[b]):
            rotation.append(UNPOSED_DEG)
            translation.append(UNPOSED_DEG)
            continue
        mine = rigid_inverse(estimate[a]) @ estimate[b]
        true = rigid_inverse(truth[a]) @ truth[b]
        rotation.append(float(rotation_angle_deg(mine[:3, :3], true[:3, :3])))
        cross = torch.linalg.cross(mine[:3, 3], true[:3, 3]).norm()
        translation.append(float(torch.rad2deg(torch.atan2(cross, mine[:3, 3] @ true[:3, 3]))))
    return tuple(rotation), tuple(translation)


def load_photos(files: Sequence[Path], long_side: int) -> Tensor:
    """Pictures at one size, (view, 3, height, width) in [0, 1]; the first one's shape decides."""
    pictures = [Image.open(path).convert("RGB") for path in files]
    scale = long_side / max(pictures[0].size)
    size = (round(pictures[0].width * scale), round(pictures[0].height * scale))
    arrays = [np.asarray(p.resize(size, Image.Resampling.LANCZOS), np.float32) / 255 for p in pictures]
    return torch.from_numpy(np.stack(arrays)).permute(0, 3, 1, 2).contiguous()


def pictures_in(folder: Path) -> list[Path]:
    """Picture files of a folder, sorted."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)


def synthetic_rows(seeds: Iterable[int], views: int, config: SfmConfig) -> Iterable[Row]:
    """Held-out procedural scenes at 768 x 576."""
    for seed in seeds:
        made = make_views(seed, views=views, height=576, width=768, split="test", supersample=1.0)
        yield measure(f"synthetic {seed}", made.images, config, made.world_from_cam, made.intrinsics_px)


def posed_rows(folder: Path, config: SfmConfig) -> Iterable[Row]:
    """Sliding windows of four frames, then all frames."""
    files = pictures_in(folder / "images")
    poses, matrices = [], []
    for path in files:
        numbers = np.loadtxt((folder / "cameras" / f"{path.stem}.txt").read_text().split(), dtype=np.float64)
        pose = np.eye(4)
        pose[:3] = numbers[:12].reshape(3, 4)
        poses.append(pose)
        matrices.append(numbers[12:].reshape(3, 3))
    truth, intrinsics = torch.from_numpy(np.stack(poses)), torch.from_numpy(np.stack(matrices))
    size = max(Image.open(files[0]).size)
    images = load_photos(files, size)
    for first in range(0, len(files) - 3, 2):
        window = slice(first, first + 4)
        yield measure(f"{folder.name} {first}-{first + 3}", images[window], config, truth[window], intrinsics[window])
    yield measure(f"{folder.name} all", images, config, truth, intrinsics)


def show(row: Row) -> None:
    """One line."""
    truth = ""
    if row.rotation_deg:
        truth = (
            f"  AUC@30 {auc(row.worst_deg):.2f}  rotation {statistics.median(row.rotation_deg):6.2f}"
            f"  translation {statistics.median(row.translation_deg):6.2f} deg  true focal {row.true_focal_ratio:.3f}"
        )
    print(
        f"{row.name:24s} {row.registered}/{row.views} posed ({row.loose} loose)  focal {row.focal_ratio:.3f}"
        f" {row.focal_source:8s} {row.points:5d} points  {row.angle_deg:5.1f} deg  {row.error_px:.2f} px"
        f"  {row.cpu_s:5.1f} CPU-s{truth}",
        flush=True,
    )


def summary(title: str, rows: Sequence[Row]) -> dict[str, float]:
    """Pooled over all pairs of all sets."""
    errors = [error for row in rows for error in row.worst_deg]
    posed = [row for row in rows if row.true_focal_ratio and row.points]
    focal = [abs(np.log(row.focal_ratio / row.true_focal_ratio)) for row in posed if row.true_focal_ratio]
    result = {
        "auc30": auc(errors),
        "auc5": auc(errors, 5),
        "median_rotation_deg": statistics.median(e for row in rows for e in row.rotation_deg),
        "median_translation_deg": statistics.median(e for row in rows for e in row.translation_deg),
        "median_focal_error": float(statistics.median(focal)) if focal else float("nan"),
        "cpu_s": statistics.fmean(row.cpu_s for row in rows),
    }
    print(title, "  ".join(f"{key} {value:.3f}" for key, value in result.items()), flush=True)
    return result


def main() -> None:
    """Parse arguments, measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--posed", type=Path)
    parser.add_argument("--photos", type=Path, nargs="*", default=[])
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    config = SfmConfig()
    rows: list[Row] = []
    summaries: dict[str, dict[str, float]] = {}

    def run(title: str, source: Iterable[Row]) -> None:
        group = []
        for row in source:
            show(row)
            group.append(row)
        rows.extend(group)
        if any(row.rotation_deg for row in group):
            summaries[title] = summary(title, group)

    if arguments.scenes:
        seeds = range(arguments.first_seed, arguments.first_seed + arguments.scenes)
        run("synthetic", synthetic_rows(seeds, arguments.views, config))
    if arguments.posed:
        run("posed", posed_rows(arguments.posed, config))
    for folder in arguments.photos:
        run(folder.name, [measure(folder.name, load_photos(pictures_in(folder), 768), config)])
    if arguments.json:
        arguments.json.write_text(json.dumps({"summary": summaries, "rows": [asdict(row) for row in rows]}, indent=1))


if __name__ == "__main__":
    main()
