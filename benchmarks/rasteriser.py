"""Speed of the CPU rasteriser as ratios to gsplat's own torch reference, in one process on one thread.

    python benchmarks/rasteriser.py [--scene S|M] [--antialiased] [--repeats 5] [--json FILE]     (M: about two minutes)

Every compiled build that this CPU can run is measured (AVX2, AVX-512). The scene is that of a feed-forward reconstruction: one
Gaussian per pixel of two source views of a wall with relief behind a disc, seen from a third camera; RGB, squared-error loss.
Figures are CPU time of the process (the machine may be shared), medians.

Baselines, from the installed ``gsplat`` package (pip install gsplat==1.5.3), whose functions are only called:
  ref   projection, tile lists, pixel lists and accumulation; what gsplat has only as CUDA code (tile intersection, pixel lists)
        and what it takes from nerfacc is replaced by vectorised functions (see gsplat_reference.py)
  core  projection and accumulation with the index lists given: gsplat's own differentiable code only
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from gsplat_reference import run_gsplat
from splat_scene import SCENES, Scene, make_scene
from torch import Tensor

from sceneexpander.splatting import RasterSettings, kernel_backend, rasterise

RATIOS = ("forward vs ref", "forward+backward vs ref", "forward+backward vs core")
LEVELS = {"v3": "AVX2", "v4": "AVX-512", "plain": "plain"}


def run_ours(
    scene: Scene, backend: str, threads: int, *, antialiased: bool
) -> Callable[[], tuple[Tensor, list[Tensor]]]:
    """A function that renders and returns (image, leaves)."""
    settings = RasterSettings(max_alpha=0.999, backend=backend, threads=threads, antialiased=antialiased)  # type: ignore[arg-type]

    def forward() -> tuple[Tensor, list[Tensor]]:
        leaves = scene.leaves()
        means, quat_wxyz, scales, opacities, colours = leaves
        out = rasterise(
            means,
            quat_wxyz,
            scales,
            opacities,
            colours,
            scene.viewmat[None],
            scene.intrinsics[None],
            scene.height,
            scene.width,
            with_depth=False,
            settings=settings,
        )
        return out.rgb[0].movedim(0, -1), leaves

    return forward


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """Medians, milliseconds."""

    forward_cpu: float
    both_cpu: float
    forward_wall: float
    both_wall: float


def measure(
    scene: Scene, forward: Callable[[], tuple[Tensor, Any] | tuple[Tensor, Any, Any]], repeats: int, warm_up: int = 1
) -> Timing:
    """Time forward and forward + backward of the squared-error loss."""
    rows = []
    for repeat in range(repeats + warm_up):
        cpu, wall = time.process_time(), time.perf_counter()
        image = forward()[0]
        cpu_forward, wall_forward = time.process_time() - cpu, time.perf_counter() - wall
        ((image - scene.target) ** 2).mean().backward()  # type: ignore[no-untyped-call]
        if repeat >= warm_up:
            rows.append((cpu_forward, time.process_time() - cpu, wall_forward, time.perf_counter() - wall))
        del image
    return Timing(
        **{name: 1000 * statistics.median(r[i] for r in rows) for i, name in enumerate(Timing.__dataclass_fields__)}
    )


def usable_builds() -> dict[str, str]:
    """Builds that are installed and that this CPU can run, by name: the level of instructions."""
    known = kernel_backend.BUILDS.get(torch.backends.cpu.get_cpu_capability(), ("plain",))
    return {build: LEVELS[build] for build in known if kernel_backend.open_build(build) is not None}


def measure_kernels(scene: Scene, repeats: int, *, antialiased: bool) -> dict[str, Timing]:
    """Every usable build on one thread, the one that would be chosen also on two."""
    timings: dict[str, Timing] = {}
    for build, level in usable_builds().items():
        kernel = kernel_backend.open_build(build)
        kernel_backend.load_kernel = lambda kernel=kernel: kernel  # type: ignore[assignment]
        for threads in (1, 2) if not timings else (1,):
            name = f"kernel {level}, {threads} thread{'s'[: threads - 1]}"
            timings[name] = report(
                name, measure(scene, run_ours(scene, "cpu", threads, antialiased=antialiased), repeats)
            )
    chosen = kernel_backend.open_build(next(iter(usable_builds())))
    kernel_backend.load_kernel = lambda: chosen  # type: ignore[assignment]
    return timings


def report(name: str, timing: Timing) -> Timing:
    """Print one line and hand the timing on."""
    print(f"{name:24s} forward {timing.forward_cpu:8.1f} ms   forward+backward {timing.both_cpu:8.1f} ms", flush=True)
    return timing


def compare_pictures(scene: Scene, theirs: Tensor, *, antialiased: bool) -> None:
    """How far apart the pictures are: nearly all pixels agree to rounding, some pairs of nearly equal depth change places."""
    difference = (run_ours(scene, "cpu", 1, antialiased=antialiased)()[0] - theirs).detach().abs().flatten()
    psnr = -10 * math.log10(float((difference**2).mean()))
    print(f"kernel against gsplat: {psnr:.1f} dB, median difference {float(difference.median()):.1e}", flush=True)


def ratios_of(timings: dict[str, Timing]) -> dict[str, float]:
    """Reference times divided by ours, printed."""
    ratios: dict[str, float] = {}
    ref, core = timings["gsplat ref"], timings["gsplat core"]
    for level in usable_builds().values():
        ours = timings[f"kernel {level}, 1 thread"]
        found = (
            ref.forward_cpu / ours.forward_cpu,
            ref.both_cpu / ours.both_cpu,
            core.both_cpu / ours.both_cpu,
        )
        for i, name in enumerate(RATIOS):
            ratios[f"{level}: {name}"] = found[i]
            print(f"{level + ': ' + name:36s} {found[i]:7.1f}x")
    ratios["torch fallback: forward+backward vs ref"] = ref.both_cpu / timings["torch fallback"].both_cpu
    return ratios


def main() -> None:
    """Run, print ratios, optionally write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", choices=sorted(SCENES), default="M")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--antialiased", action="store_true", help="opacities compensated for the blur, by all of them")
    parser.add_argument("--skip-reference", action="store_true", help="time our own backends only")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    scene = make_scene(args.scene)
    assert usable_builds(), "no compiled kernel: install the package with a C++ compiler"
    print(f"scene {args.scene}: {len(scene.means)} Gaussians, {scene.width}x{scene.height}", flush=True)
    timings = measure_kernels(scene, max(args.repeats, 7), antialiased=args.antialiased)
    one, two = (timings[f"kernel {next(iter(usable_builds().values()))}, {n}"] for n in ("1 thread", "2 threads"))
    ratios: dict[str, float] = {}
    pairs = 0
    if not args.skip_reference:
        fallback = measure(scene, run_ours(scene, "torch", 1, antialiased=args.antialiased), max(2, args.repeats // 2))
        timings["torch fallback"] = report("torch fallback", fallback)
        ref_image, _, lists = run_gsplat(scene, None, antialiased=args.antialiased)()
        pairs = len(lists[0])
        print(f"{pairs / (scene.width * scene.height):.1f} contributing pairs per pixel")
        compare_pictures(scene, ref_image, antialiased=args.antialiased)
        del ref_image
        for name, given in (("gsplat ref", None), ("gsplat core", lists)):
            theirs = run_gsplat(scene, given, antialiased=args.antialiased)
            timings[name] = report(name, measure(scene, theirs, args.repeats, warm_up=0))
        ratios = ratios_of(timings)
    ratios["2 threads vs 1, forward, wall"] = one.forward_wall / two.forward_wall
    ratios["2 threads vs 1, forward+backward, wall"] = one.both_wall / two.both_wall
    for name in list(ratios)[-3:]:
        print(f"{name:36s} {ratios[name]:7.2f}x")
    if args.json:
        result = {
            "scene": args.scene,
            "antialiased": args.antialiased,
            "gaussians": len(scene.means),
            "pairs_per_pixel": pairs / (scene.width * scene.height),
            "repeats": args.repeats,
            "cpu": torch.backends.cpu.get_cpu_capability(),
            "machine": platform.machine(),
            "torch": torch.__version__,
            "timings_ms": {name: asdict(timing) for name, timing in timings.items()},
            "ratios": ratios,
        }
        args.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
