"""Rows of a table."""

from __future__ import annotations

from sceneexpander.artifacts.metrics import Fit, MetricsRow


def row(
    scene: str,
    method: str,
    psnr_db: float,
    *,
    round_number: int = 1,
    seed: int = 0,
    fit: Fit = Fit.PREDICTED,
    **more: float,
) -> MetricsRow:
    return MetricsRow(
        scene=scene,
        round=round_number,
        method=method,
        model="made",
        weights_sha256="",
        seed=seed,
        fit=fit,
        values={"gaussians": 10.0, "psnr_captured_db": psnr_db, "ssim_captured": 0.5, **more},
    )
