"""A guard, not a benchmark: a compiler or a change that leaves the inner loops unvectorised costs a factor, and must not pass."""

from __future__ import annotations

import time

import pytest
import torch

from sceneexpander.geometry.rigid import rigid_inverse
from sceneexpander.splatting import RasterSettings, rasterise
from sceneexpander.splatting.kernel_backend import load_kernel
from tests.worlds.random_gaussians import cameras, intrinsics, random_gaussians

HEIGHT, WIDTH, COUNT = 144, 192, 20_000


def cpu_seconds(backend: str, repeats: int) -> float:
    """Of the process, forward and backward, the best of some: the machine may be shared."""
    scene = random_gaussians(COUNT, sh_coefficients=1)
    scales = scene.scales * 0.15
    view, lens = rigid_inverse(cameras(1)), intrinsics(1, HEIGHT, WIDTH)
    best = float("inf")
    for _ in range(repeats):
        leaves = [t.clone().requires_grad_() for t in (scene.means, scene.quat_wxyz, scales, scene.opacities, scene.sh)]
        begin = time.process_time()
        out = rasterise(*leaves, view, lens, HEIGHT, WIDTH, settings=RasterSettings(backend=backend, threads=1))  # type: ignore[arg-type]
        (out.rgb**2).sum().backward()
        best = min(best, time.process_time() - begin)
    return best


@pytest.mark.skipif(load_kernel() is None, reason="no compiled kernel (no compiler at install)")
def test_the_kernel_is_many_times_faster_than_torch() -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        ratio = cpu_seconds("torch", 2) / cpu_seconds("cpu", 5)
    finally:
        torch.set_num_threads(threads)
    assert ratio > 9, f"forward and backward only {ratio:.1f} times as fast"
