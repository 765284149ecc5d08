"""Iterations per second of the per-scene 3DGS optimisation at 256 x 192 pixels.

    python benchmarks/optimisation.py [--gaussians 50000] [--steps 60] [--threads 2] [--sh-degree 0]

A made scene: six views of a textured box, one Gaussian drawn at every place, started from spoiled colours. Whole steps are timed (picture,
loss with SSIM, gradients, optimiser, gathering for the densification, which itself is off so that the number stays).
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from dataclasses import replace

import torch

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.geometry.camera import camera_vector_from_pose, intrinsics_from_parts
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians, sh_from_rgb
from sceneexpander.geometry.rigid import look_at
from sceneexpander.optimisation.config import DensityConfig, OptimiseConfig
from sceneexpander.optimisation.optimise import optimise
from sceneexpander.splatting import render

HEIGHT, WIDTH, VIEWS, FOCAL = 192, 256, 6, 220.0
WARM_UP = 5


def room(count: int) -> Gaussians:
    """Gaussians on the inside of a box of 4 x 3 x 4 units around the origin, as large as their spacing."""
    generator = torch.Generator().manual_seed(0)
    half = torch.tensor([2.0, 1.5, 2.0])
    points = (torch.rand(count, 3, generator=generator) * 2 - 1) * half
    wall = torch.randint(0, 3, (count,), generator=generator)
    sign = torch.randint(0, 2, (count,), generator=generator) * 2.0 - 1
    points[torch.arange(count), wall] = sign * half[wall]
    area = 2 * 4 * (4 * 3 + 4 * 3 + 4 * 4) / 4
    scales = torch.full((count, 3), 0.6 * (area / count) ** 0.5)
    rgb = 0.5 + 0.4 * torch.sin(points * torch.tensor([5.0, 7.0, 6.0]))
    return Gaussians(
        means=points,
        quat_wxyz=torch.tensor([1.0, 0, 0, 0]).expand(count, 4).clone(),
        scales=scales,
        opacities=torch.full((count,), 0.8),
        sh=sh_from_rgb(rgb)[:, None],
        source_view=torch.zeros(count, dtype=torch.int64),
        generated=torch.zeros(count, dtype=torch.bool),
    )


def scene(count: int) -> tuple[Reconstruction, torch.Tensor]:
    """(what to start from, pictures)."""
    gaussians = room(count)
    angle = torch.linspace(-0.5, 0.5, VIEWS)
    eyes = torch.stack([0.6 * torch.sin(angle), 0 * angle, -1.4 + 0 * angle], -1)
    targets = torch.stack([1.5 * torch.sin(2 * angle), 0 * angle, 2 + 0 * angle], -1)
    poses = look_at(eyes, targets, torch.tensor([0.0, -1.0, 0.0]))
    one = torch.ones(VIEWS)
    intrinsics = intrinsics_from_parts(FOCAL * one, FOCAL * one, one * WIDTH / 2, one * HEIGHT / 2)
    seen = render(gaussians, Cameras(poses, intrinsics, HEIGHT, WIDTH))
    depth = seen.depth.clamp(min=0.1)
    normals = torch.zeros(VIEWS, HEIGHT, WIDTH, 3)
    normals[..., 2] = -1
    start = Reconstruction(
        method="made",
        model="made",
        weights_sha256="",
        view_ids=tuple(f"v{i}" for i in range(VIEWS)),
        generated=torch.zeros(VIEWS, dtype=torch.bool),
        posed=torch.ones(VIEWS, dtype=torch.bool),
        camera_vector=camera_vector_from_pose(poses, intrinsics, HEIGHT, WIDTH),
        world_from_cam=poses,
        intrinsics_px=intrinsics,
        depth=depth,
        depth_conf=torch.ones_like(depth),
        normals=normals,
        normals_conf=torch.ones_like(depth),
        gaussians=replace(gaussians, sh=0.2 * gaussians.sh),
    )
    return start, seen.rgb.clamp(0, 1)


def main() -> None:
    """Time and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--sh-degree", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    start, images = scene(options.gaussians)
    config = OptimiseConfig(
        steps=WARM_UP + options.steps, sh_degree=options.sh_degree, density=DensityConfig(every=10**9)
    )
    wall, cpu = [time.perf_counter()], [time.process_time()]

    def on_step(step: int, loss: float) -> None:
        wall.append(time.perf_counter())
        cpu.append(time.process_time())

    result = optimise(start, images, config, method="made", seed=0, on_step=on_step)
    seconds = [b - a for a, b in zip(wall[WARM_UP:], wall[WARM_UP + 1 :], strict=False)]
    used = (cpu[-1] - cpu[WARM_UP]) / options.steps
    print(
        f"{options.gaussians} Gaussians, {WIDTH}x{HEIGHT}, SH degree {options.sh_degree}, {options.threads} threads of "
        f"{os.cpu_count()} cores, torch {torch.__version__}: median {1000 * statistics.median(seconds):.0f} ms a step, "
        f"{1 / statistics.median(seconds):.1f} steps per second ({1000 * used:.0f} ms of CPU time a step); "
        f"loss {result.losses[0]:.4f} to {result.losses[-1]:.4f}"
    )


if __name__ == "__main__":
    main()
