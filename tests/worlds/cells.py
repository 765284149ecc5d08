"""Measured cells of the benchmark."""

from __future__ import annotations

from sceneexpander.expandbench.measure import BenchNumbers
from sceneexpander.expandbench.run import CellResult

NUMBERS = BenchNumbers(
    values={
        "psnr_at_photo_size_db": 19.0, "seen_through_at_photo_size": 0.0, "psnr_captured_db": 20.0, "ssim_captured": 0.8,
        "st_lpips_captured": 0.01, "psnr_from_others_db": 19.0, "camera_rotation_deg": 0.1, "camera_direction_deg": 0.2,
        "depth_abs_rel": 0.05, "psnr_inserted_db": 25.0, "inserted_rotation_deg": 1.0, "inserted_direction_deg": 2.0,
        "psnr_new_region_db": 15.0, "new_region_drawn": 0.9, "new_region_drawn_abs_rel": 0.2, "psnr_half_way_db": 17.0,
    }
)  # fmt: skip


def changed(numbers: BenchNumbers, **values: float) -> BenchNumbers:
    return BenchNumbers(values={**numbers.values, **values})


def cell(
    scene: str, row: str, psnr: float, *, seed: int = 0, grade: str = "mixed_1", depth: float = 0.05
) -> CellResult:
    return CellResult(
        scene=scene, grade=grade, row=row, seed=seed, steps=0, seconds=0.0, code="c",
        numbers=changed(NUMBERS, psnr_captured_db=psnr, psnr_at_photo_size_db=psnr, depth_abs_rel=depth),
    )  # fmt: skip
