"""How good the cameras of the sparse front-end are, with the focal unknown.

    python benchmarks/frontend_poses.py --scenes 20 --posed FOLDER --photos FOLDER [FOLDER ...] --json poses.json
    python benchmarks/frontend_poses.py --cases all [--seeds courtyard,3] [--no-learned] [--known] [--verbose] [--json cases.json]

Synthetic scenes have true cameras. ``--posed`` is a folder with ``images/`` and ``cameras/<name>.txt`` (3x4 camera-to-world,
then 3x3 intrinsics). ``--photos`` are folders of pictures without truth: only registration, focal and errors are printed.
Pair errors: rotation angle, and angle between the translation directions, of every pair of views; AUC@30 is the mean over
thresholds 1..30 degrees of the share of pairs whose larger error is below (a pair with an unposed view counts as wrong).

``--cases`` measures sets of unlike photos (`unlike_photos`) instead, as files through the door that users' photos come in by. Cameras are
compared in the pixels of the files. A view's error is its median over the other views with a pose of the larger of rotation and direction;
directions count between cameras at least 5 % of the widest distance apart. "sure" is posed and not loose; "wrong" are sure views that are
more than 2 degrees off or that no camera of the place took (the first view of a set without any other pose is only the origin), "silent"
those of them about which nothing is said, neither of the view nor of the set. ``--known`` gives the true lenses: what is wrong then is
not the focal's fault.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from unlike_photos import CASES, SEEDS, Photo, place_of, write_photo

from sceneexpander.artifacts.views import ViewSet
from sceneexpander.errors import UserError
from sceneexpander.frontend.dense import DenseConfig
from sceneexpander.frontend.prior import picture_judge
from sceneexpander.frontend.sfm import SfmConfig, SparseReconstruction, estimate_cameras
from sceneexpander.frontend.sfm_types import LearnedUse
from sceneexpander.geometry.rigid import rigid_inverse, rotation_angle_deg
from sceneexpander.ingest import IngestConfig, read_views
from sceneexpander.reconstruction.optics import optics_of
from sceneexpander.synthetic import make_views

SUFFIXES = {".jpg", ".jpeg", ".png", ".webp"}
UNPOSED_DEG = 180.0
WRONG_DEG = 2.0
SHORT_BASELINE = 0.05  # of the widest of the set: the direction between closer cameras says nothing


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


# --- sets of unlike photos -----------------------------------------------------------------------------------------------------------


def estimate(views: ViewSet, config: SfmConfig, known_intrinsics_px: Tensor | None = None) -> SparseReconstruction:
    """The front-end as a user's photos meet it."""
    return estimate_cameras(
        views.images,
        config,
        generator=torch.Generator().manual_seed(0),
        feature_images=views.detail_images,
        known_intrinsics_px=known_intrinsics_px,
        judge=picture_judge(views.images, DenseConfig(threads=1)),
        names=[record.name for record in views.records],
        optics=optics_of(views),
        valid=views.valid,
    )


@dataclass(frozen=True, kw_only=True)
class CaseView:
    """One photo of a set and what became of it."""

    name: str
    true_camera: bool  # some camera of the place took it
    posed: bool
    sure: bool
    remark: str
    focal_ratio: float  # of the file's long side
    focal_error: float | None = None  # absolute logarithm of estimated / true
    centre_error: float | None = None  # of the principal point, over the long side
    error_deg: float | None = None


@dataclass(frozen=True, kw_only=True)
class CaseSet:
    """One set of one case."""

    case: str
    place: str
    refused: str = ""  # the one line in which the door refused it
    views: tuple[CaseView, ...] = ()
    left_out: int = 0  # files that did not become views
    notes: tuple[str, ...] = ()  # of the front-end
    door_notes: tuple[str, ...] = ()
    focal_source: str = ""
    rotation_deg: tuple[float, ...] = ()  # per pair of posed views with a true camera
    direction_deg: tuple[float, ...] = ()
    cpu_s: float = 0.0

    @property
    def wrong(self) -> list[str]:
        """Names of the sure views that are wrong."""
        sure = [view for view in self.views if view.sure]
        if len(sure) < 2:
            return []
        return [v.name for v in sure if not v.true_camera or (v.error_deg is not None and v.error_deg > WRONG_DEG)]

    @property
    def silent_wrong(self) -> list[str]:
        """Names of those about which nothing is said."""
        said = {view.name for view in self.views if view.remark}
        return [] if self.notes else [name for name in self.wrong if name not in said]


def measure_case(case: str, seed: str, config: SfmConfig, *, known: bool) -> CaseSet:
    """Make the files of one set, read them, estimate their cameras and compare."""
    photos = CASES[case](place_of(seed))
    with tempfile.TemporaryDirectory() as folder:
        by_name: dict[str, Photo] = {}
        for number, photo in enumerate(photos, start=1):
            by_name[write_photo(photo, Path(folder), f"photo_{number}").name] = photo
        try:
            loaded = read_views([Path(folder) / name for name in by_name], IngestConfig())
        except UserError as error:
            return CaseSet(case=case, place=seed, refused=str(error).replace(folder, "FOLDER"))
    photos = [by_name[record.name] for record in loaded.views.records]
    lenses = None
    if known:
        affine = [np.vstack([record.stored_from_original, [0, 0, 1]]) for record in loaded.views.records]
        true = [matrix @ photo.intrinsics for matrix, photo in zip(affine, photos, strict=True)]
        lenses = torch.from_numpy(np.stack(true))
    start = time.process_time()
    found = estimate(loaded.views, config, lenses)
    return compare(case, seed, loaded.views, photos, found, len(by_name), loaded.notes, time.process_time() - start)


def compare(
    case: str,
    seed: str,
    views: ViewSet,
    photos: Sequence[Photo],
    found: SparseReconstruction,
    files: int,
    door_notes: tuple[str, ...],
    cpu_s: float,
) -> CaseSet:
    """Estimated against true cameras, in the pixels of the files."""
    outcomes = []
    for index, (record, photo, report) in enumerate(zip(views.records, photos, found.report.views, strict=True)):
        to_original = np.vstack([record.original_from_stored(), [0, 0, 1]])
        mine = to_original @ found.intrinsics_px[index].double().numpy()
        long_side = max(record.original_height, record.original_width)
        outcome = CaseView(
            name=record.name,
            true_camera=photo.world_from_cam is not None,
            posed=bool(found.posed[index]),
            sure=bool(found.posed[index]) and not report.loose,
            remark="; ".join([*([report.reason] if report.reason else []), *report.warnings]),
            focal_ratio=float(mine[0, 0]) / long_side,
        )
        if photo.world_from_cam is not None:
            outcome = replace(
                outcome,
                focal_error=abs(float(np.log(mine[0, 0] / photo.intrinsics[0, 0]))),
                centre_error=float(np.linalg.norm((mine - photo.intrinsics)[:2, 2])) / long_side,
            )
        outcomes.append(outcome)
    usable = [k for k, v in enumerate(outcomes) if v.posed and v.true_camera]
    truth = {k: torch.from_numpy(photos[k].world_from_cam).double() for k in usable}
    widest = max((float((truth[a] - truth[b])[:3, 3].norm()) for a, b in combinations(usable, 2)), default=0.0)
    rotation, direction = [], []
    worse: dict[int, list[float]] = {k: [] for k in usable}
    for a, b in combinations(usable, 2):
        mine = rigid_inverse(found.world_from_cam[a].double()) @ found.world_from_cam[b].double()
        true = rigid_inverse(truth[a]) @ truth[b]
        rotation.append(float(rotation_angle_deg(mine[:3, :3], true[:3, :3])))
        errors = [rotation[-1]]
        if float(true[:3, 3].norm()) > max(SHORT_BASELINE * widest, 1e-6):
            cross = torch.linalg.cross(mine[:3, 3], true[:3, 3]).norm()
            direction.append(float(torch.rad2deg(torch.atan2(cross, mine[:3, 3] @ true[:3, 3]))))
            errors.append(direction[-1])
        for k in (a, b):
            worse[k].append(max(errors))
    for k in usable:
        if worse[k]:
            outcomes[k] = replace(outcomes[k], error_deg=statistics.median(worse[k]))
    return CaseSet(
        case=case,
        place=seed,
        views=tuple(outcomes),
        left_out=files - len(views),
        notes=found.report.notes,
        door_notes=door_notes,
        focal_source=str(found.report.focal_source),
        rotation_deg=tuple(rotation),
        direction_deg=tuple(direction),
        cpu_s=cpu_s,
    )


CASE_HEADER = (
    "| case | sets | sure of photos | rotation, deg | direction, deg | focal, % | said | wrong | silent | CPU-s |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
)


def case_row(case: str, sets: Sequence[CaseSet]) -> str:
    """One line of the table, pooled over the sets; errors are median / worst."""
    views = [view for item in sets for view in item.views]
    focal = [100 * np.expm1(v.focal_error) for v in views if v.focal_error is not None and v.posed]
    remarks = sum(bool(view.remark) for view in views)
    said = [f"{remarks} views"] if remarks else []
    said += [f"{count} sets" for count in [sum(bool(item.notes) for item in sets)] if count]
    said += [f"{count} at the door" for count in [sum(bool(i.door_notes) or bool(i.refused) for i in sets)] if count]

    def spread(values: Sequence[float]) -> str:
        return f"{statistics.median(values):.2f} / {max(values):.1f}" if values else "-"

    files = sum(len(item.views) + item.left_out for item in sets)
    loose = sum(view.posed and not view.sure for view in views)
    cells = [
        case,
        str(len(sets)),
        f"{sum(view.sure for view in views)} of {files}" + (f", {loose} loose" if loose else ""),
        spread([error for item in sets for error in item.rotation_deg]),
        spread([error for item in sets for error in item.direction_deg]),
        spread(focal),
        ", ".join(said) or "-",
        str(sum(len(item.wrong) for item in sets)),
        str(sum(len(item.silent_wrong) for item in sets)),
        f"{statistics.fmean(item.cpu_s for item in sets):.1f}",
    ]
    return "| " + " | ".join(cells) + " |"


def show_set(item: CaseSet) -> None:
    """A line per view and note, for people who look into one set."""
    print(f"  {item.case} {item.place}: {item.refused or f'focal {item.focal_source}, {item.cpu_s:.1f} CPU-s'}")
    for v in item.views:
        state = "sure" if v.sure else "loose" if v.posed else "out"
        numbers = f"focal {v.focal_ratio:.3f}"
        if v.focal_error is not None:
            numbers += f" ({100 * np.expm1(v.focal_error):.1f} % off), centre {100 * (v.centre_error or 0):.1f} % off"
        error = "" if v.error_deg is None else f", {v.error_deg:.2f} deg"
        mark = "  WRONG" if v.name in item.wrong else ""
        mark += ", SILENT" if v.name in item.silent_wrong else ""
        print(f"    {v.name} {state:5s} {numbers}{error}  {v.remark}{mark}")
    for note in (*item.notes, *item.door_notes):
        print(f"    note: {note}")


def run_cases(
    names: Sequence[str], seeds: Sequence[str], config: SfmConfig, *, known: bool, verbose: bool, json_path: Path | None
) -> None:
    """Measure and print case after case; the file is written anew after each, since all of them take an hour."""
    print(CASE_HEADER, flush=True)
    every: list[CaseSet] = []
    for name in names:
        sets = []
        for seed in seeds:
            sets.append(measure_case(name, seed, config, known=known))
            if verbose:
                show_set(sets[-1])
        print(case_row(name, sets), flush=True)
        every += sets
        if json_path is not None:
            json_path.write_text(json.dumps([asdict(item) for item in every], indent=1))
    wrong, silent = sum(len(item.wrong) for item in every), sum(len(item.silent_wrong) for item in every)
    print(f"{len(every)} sets, {wrong} views wrong, {silent} of them silently, {sum(i.cpu_s for i in every):.0f} CPU-s")


def main() -> None:
    """Parse arguments, measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--posed", type=Path)
    parser.add_argument("--photos", type=Path, nargs="*", default=[])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--cases", help=f"'all' or some of: {', '.join(CASES)}")
    parser.add_argument("--seeds", default=",".join(SEEDS), help="places for --cases: 'courtyard' or seeds of scenes")
    parser.add_argument("--no-learned", action="store_true", help="without learned keypoints: three times as fast")
    parser.add_argument("--known", action="store_true", help="--cases with the true lenses given")
    parser.add_argument("--verbose", action="store_true", help="--cases with a line per view")
    arguments = parser.parse_intermixed_args()
    torch.set_num_threads(1)
    config = SfmConfig(learned=LearnedUse.NEVER) if arguments.no_learned else SfmConfig()
    if arguments.cases:
        names = list(CASES) if arguments.cases == "all" else arguments.cases.split(",")
        if unknown := [name for name in names if name not in CASES]:
            parser.error(f"no such case: {', '.join(unknown)}; there are {', '.join(CASES)}")
        seeds = arguments.seeds.split(",")
        run_cases(names, seeds, config, known=arguments.known, verbose=arguments.verbose, json_path=arguments.json)
        return
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
