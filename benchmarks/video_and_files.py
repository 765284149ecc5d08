"""How long a person waits for what can be looked at: a navigation in three videos, and scenes as files.

    python benchmarks/video_and_files.py [--frames 60] [--threads 2]

The video: 300 k Gaussians (scene M of ``splat_scene.py``), 512x384, colour, depth and provenance, stills and PLY included.
The files: a million Gaussians of SH degree 0 and 3, written and read again. Wall time, and in brackets the CPU
time of the process: the machine may be shared.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from splat_scene import make_scene
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.geometry.camera import camera_vector_from_pose
from sceneexpander.geometry.gaussians import Gaussians, sh_from_rgb
from sceneexpander.geometry.rigid import look_at
from sceneexpander.rendering.config import RenderConfig
from sceneexpander.rendering.produce import produce_renders
from sceneexpander.splatting.ply import read_ply, write_ply
from sceneexpander.splatting.spz import read_spz, write_spz

HEIGHT, WIDTH = 384, 512
MILLION = 1_000_000


def reconstruction() -> Reconstruction:
    """Two captured cameras, an inserted one, and scene M's Gaussians."""
    scene = make_scene("M")
    count = len(scene.means)
    eyes = torch.tensor([[-0.4, 0.0, 0.0], [0.4, 0.0, 0.0], [0.9, -0.2, 0.3]])
    poses = look_at(eyes, torch.tensor([0.0, 0.0, 4.0]), torch.tensor([0.0, -1.0, 0.0]))
    intrinsics = scene.intrinsics.repeat(3, 1, 1)
    maps = torch.full((3, HEIGHT, WIDTH), 4.0)
    source = torch.arange(count) * 2 // count
    return Reconstruction(
        method="backbone",
        model="benchmark",
        weights_sha256="0" * 64,
        view_ids=("left", "right", "new"),
        generated=torch.tensor([False, False, True]),
        posed=torch.ones(3, dtype=torch.bool),
        camera_vector=camera_vector_from_pose(poses, intrinsics, HEIGHT, WIDTH),
        world_from_cam=poses,
        intrinsics_px=intrinsics,
        depth=maps,
        depth_conf=maps,
        normals=torch.tensor([0.0, 0, -1]).expand(3, HEIGHT, WIDTH, 3).clone(),
        normals_conf=maps,
        gaussians=Gaussians(
            means=scene.means,
            quat_wxyz=scene.quats,
            scales=scene.scales,
            opacities=scene.opacities,
            sh=sh_from_rgb(scene.colours)[:, None],
            source_view=source,
            generated=source == 1,
        ),
    )


def million(coefficients: int) -> Gaussians:
    """Random Gaussians."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(MILLION, *shape, generator=generator)

    return Gaussians(
        means=normal(3),
        quat_wxyz=normal(4),
        scales=torch.exp(normal(3) - 4),
        opacities=torch.sigmoid(normal()),
        sh=0.3 * normal(coefficients, 3),
        source_view=torch.arange(MILLION) % 7,
        generated=torch.arange(MILLION) % 7 == 6,
    )


def timed(work: Callable[[], object]) -> str:
    """Seconds of the clock and, in brackets, of the CPU."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return f"{time.perf_counter() - wall:.2f} s ({time.process_time() - cpu:.2f} s)"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shown = reconstruction()
        (folder / "renders").mkdir()
        spent = timed(lambda: produce_renders(shown, shown, RenderConfig(frames=args.frames), folder / "renders"))
        print(f"{args.frames} frames of {len(shown.gaussians)} Gaussians at {WIDTH}x{HEIGHT}: {spent}", flush=True)
        for path in sorted((folder / "renders").glob("*.mp4")):
            print(f"  {path.name}: {path.stat().st_size / 1e6:.1f} MB")
        for coefficients in (1, 16):
            scene = million(coefficients)
            for suffix, write, read in (("ply", write_ply, read_ply), ("spz", write_spz, read_spz)):
                path = folder / f"scene.{suffix}"
                written, took = timed(partial(write, scene, path)), timed(partial(read, path))
                size = path.stat().st_size / 1e6
                about = f"1 M Gaussians, {coefficients:2d} coefficients, {suffix}, {size:3.0f} MB"
                print(f"{about}: written in {written}, read in {took}", flush=True)


if __name__ == "__main__":
    main()
