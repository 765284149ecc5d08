"""How long one waits for exports: a million Gaussians as PLY, and a COLMAP model of thirty views.

    python benchmarks/exports.py

Wall time, and in brackets the CPU time of the process: the machine may be shared. Pictures of the COLMAP export are 512x384 PNG files of
noise, which are copied, but for the generated one.
"""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path

import torch
from splat_scene import make_scene
from video_and_files import million, timed

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import save_png
from sceneexpander.exports.cameras import write_colmap, write_colmap_model
from sceneexpander.exports.scene import ExportScene, ExportView
from sceneexpander.exports.statement import Statement
from sceneexpander.geometry.camera import camera_vector_from_pose
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.geometry.rigid import look_at
from sceneexpander.splatting.ply import read_ply, write_ply

VIEWS, HEIGHT, WIDTH = 30, 384, 512


def thirty_views(folder: Path) -> ExportScene:
    """Cameras side by side before a plane, the last one generated."""
    generator = torch.Generator().manual_seed(0)
    ids = tuple(f"view_{index:02d}" for index in range(VIEWS))
    eyes = torch.stack([torch.linspace(-1, 1, VIEWS), torch.zeros(VIEWS), torch.zeros(VIEWS)], 1)
    poses = look_at(eyes, torch.tensor([0.0, 0.0, 4.0]), torch.tensor([0.0, -1.0, 0.0]))
    lens = make_scene("S").intrinsics.repeat(VIEWS, 1, 1)
    images = torch.rand(VIEWS, 3, HEIGHT, WIDTH, generator=generator)
    maps = torch.full((VIEWS, HEIGHT, WIDTH), 4.0)
    generated = torch.arange(VIEWS) == VIEWS - 1
    one = torch.ones(1, 3)
    gaussians = Gaussians(
        means=4 * one,
        quat_wxyz=torch.ones(1, 4),
        scales=0.1 * one,
        opacities=torch.ones(1),
        sh=one[:, None],
        source_view=torch.zeros(1, dtype=torch.long),
        generated=torch.zeros(1, dtype=torch.bool),
    )
    made = Reconstruction(
        method="sceneexpander",
        model="benchmark",
        weights_sha256="0" * 64,
        view_ids=ids,
        generated=generated,
        posed=torch.ones(VIEWS, dtype=torch.bool),
        camera_vector=camera_vector_from_pose(poses, lens, HEIGHT, WIDTH),
        world_from_cam=poses,
        intrinsics_px=lens,
        depth=maps,
        depth_conf=torch.rand(VIEWS, HEIGHT, WIDTH, generator=generator),
        normals=torch.tensor([0.0, 0, -1]).expand(VIEWS, HEIGHT, WIDTH, 3).clone(),
        normals_conf=maps,
        gaussians=gaussians,
    )
    views = []
    for index, view in enumerate(ids):
        save_png(folder / f"{view}.png", images[index])
        views.append(
            ExportView(
                view_id=view,
                name=view,
                generated=bool(generated[index]),
                picture=folder / f"{view}.png",
                height=HEIGHT,
                width=WIDTH,
                world_from_cam=poses[index].double(),
                intrinsics_px=lens[index].double(),
            )
        )
    statement = Statement(
        scene="benchmark",
        round=1,
        method="sceneexpander",
        part="all",
        gaussians=1,
        generated_gaussians=0,
        generated_views=(),
    )
    return ExportScene(reconstruction=made, views=tuple(views), images=images, statement=statement)


def main() -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for coefficients in (1, 4, 16):
            scene, path = million(coefficients), folder / "scene.ply"
            written, took = timed(partial(write_ply, scene, path)), timed(partial(read_ply, path))
            size = path.stat().st_size / 1e6
            print(
                f"PLY, 1 M Gaussians, {coefficients:2d} coefficients, {size:3.0f} MB: written in {written}, read in {took}"
            )
        views = thirty_views(folder)
        for kind, text in (("binary", False), ("text", True)):
            model = timed(partial(write_colmap_model, views, folder / f"{kind}_model", text=text))
            whole = timed(partial(write_colmap, views, folder / kind, text=text))
            print(f"COLMAP, {VIEWS} views, {kind}: model in {model}, with pictures in {whole}")


if __name__ == "__main__":
    main()
