"""All numbers about one reconstruction as one row."""

from __future__ import annotations

import platform
from collections.abc import Iterable
from dataclasses import dataclass, fields
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.metrics import SIZES, Fit, MetricsRow, SizeMetrics, ViewMetrics
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.truth import SceneTruth, against_truth
from sceneexpander.evaluation.views import insertion_fidelity, navigation_coverage, preservation


@dataclass(frozen=True, slots=True, kw_only=True)
class Navigation:
    """Frames of a camera path, in the frame of the reconstruction that is evaluated."""

    world_from_cam: Float[Tensor, "frame 4 4"]
    intrinsics_px: Float[Tensor, "frame 3 3"]
    height: int
    width: int


def evaluate(
    reconstruction: Reconstruction,
    views: ViewSet,
    config: EvaluateConfig,
    *,
    scene: str,
    round_number: int,
    seed: int,
    navigation: Navigation | None = None,
    truth: SceneTruth | None = None,
    fit: Fit = Fit.PREDICTED,
) -> MetricsRow:
    """Measure a reconstruction.

    Args:
        reconstruction: of captured and perhaps generated views.
        views: pictures of at least the reconstruction's views.
        config: settings.
        scene: name for the row.
        round_number: the round; the ``inserted_`` numbers are those of the view inserted in it, if the reconstruction has it with a pose.
        seed: for the row.
        navigation: frames for the coverage, if wanted.
        truth: known truth, if any.
        fit: what was done to its Gaussians after they were predicted.
    """
    captured = preservation(reconstruction, views, config)
    inserted = insertion_fidelity(reconstruction, views, config)
    in_this_round = {record.view_id for record in views.records if record.round == round_number}
    new = next((row for row in inserted if row.view_id in in_this_round and row.posed), None)
    posed = tuple(row for row in captured if row.posed)
    counted = posed or captured
    frames = None
    if navigation is not None:
        frames = navigation_coverage(
            reconstruction,
            navigation.world_from_cam,
            navigation.intrinsics_px,
            navigation.height,
            navigation.width,
            config,
        )
    return MetricsRow(
        scene=scene,
        round=round_number,
        method=reconstruction.method,
        model=reconstruction.model,
        weights_sha256=reconstruction.weights_sha256,
        seed=seed,
        captured_views=len(captured),
        generated_views=len(inserted),
        gaussians=len(reconstruction.gaussians),
        generated_gaussians=int(reconstruction.gaussians.generated.sum()),
        captured_views_posed=len(posed),
        fit=fit,
        psnr_db=_mean(row.psnr_db for row in counted),
        ssim=_mean(row.ssim for row in counted),
        coverage=_mean(row.coverage for row in counted),
        depth_disagreement=_mean_of_all(counted, "depth_disagreement"),
        others_psnr_db=_mean_of_all(counted, "others_psnr_db"),
        st_lpips=_mean_of_all(counted, "st_lpips"),
        inserted_psnr_db=None if new is None else new.psnr_db,
        inserted_ssim=None if new is None else new.ssim,
        inserted_st_lpips=None if new is None else new.st_lpips,
        inserted_generated_share=None if new is None else new.generated_share,
        inserted_others_psnr_db=None if new is None else new.others_psnr_db,
        navigation_coverage=None if frames is None else float(frames.double().mean()),
        navigation_frames=0 if frames is None else len(frames),
        **{name: _mean_size([getattr(row, name) for row in counted]) for name in SIZES},  # type: ignore[arg-type]
        inserted_own=None if new is None else new.own,
        truth=None if truth is None else against_truth(reconstruction, views, truth, round_number=round_number),
        views=(*captured, *inserted),
        versions=_versions(),
    )


def _mean(values: Iterable[float]) -> float:
    found = list(values)
    if not found:
        raise ValueError("the reconstruction has no captured view")
    return sum(found) / len(found)


def _mean_of_all(rows: tuple[ViewMetrics, ...], name: str) -> float | None:
    """Mean over the views, or None as soon as one of them has no value: a mean over fewer views is another number."""
    values = [getattr(row, name) for row in rows]
    return None if any(value is None for value in values) else _mean(values)


def _mean_size(sizes: list[SizeMetrics | None]) -> SizeMetrics | None:
    """Means over the views; a number that one of them lacks is left out."""
    known = [size for size in sizes if size is not None]
    if len(known) < len(sizes):
        return None
    columns = {f.name: [getattr(size, f.name) for size in known] for f in fields(SizeMetrics)}
    means: dict[str, Any] = {name: None if None in values else _mean(values) for name, values in columns.items()}
    return SizeMetrics(**means)


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in ("sceneexpander", "torch", "numpy"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "source"
    return found
