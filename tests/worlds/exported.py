"""A finished scene on disk, small and with known geometry: a wall of Gaussians before three cameras, the third of them generated."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from sceneexpander.artifacts.inserted import InsertedView, Provenance
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.scene import KnownCameras, RoundSpec, Scene
from sceneexpander.artifacts.views import ViewRecord, ViewSet
from sceneexpander.geometry.camera import camera_vector_from_pose, unproject_to_world
from sceneexpander.geometry.gaussians import Gaussians, sh_from_rgb
from sceneexpander.geometry.rigid import look_at

HEIGHT, WIDTH, FINER = 24, 32, 2
DEPTH = 4.0
VIEWS = ("000_left", "001_right", "r1_new")
GENERATED = 2


def poses() -> Tensor:
    """Three cameras that look at the plane z = `DEPTH`, none of them axis-aligned but the first."""
    eyes = torch.tensor([[0.0, 0.0, 0.0], [0.5, 0.1, 0.0], [-0.4, -0.2, 0.3]])
    targets = torch.tensor([[0.0, 0.0, DEPTH], [0.1, 0.0, DEPTH], [0.2, 0.1, DEPTH]])
    return look_at(eyes, targets, torch.tensor([0.0, -1.0, 0.0]))


def reconstruction(sh_coefficients: int = 4) -> Reconstruction:
    """One Gaussian per pixel, on the plane."""
    world_from_cam = poses()
    lens = torch.tensor([[30.0, 0, 17.0], [0, 31.0, 11.5], [0, 0, 1]]).expand(3, 3, 3).clone()
    rays = unproject_to_world(torch.ones(3, HEIGHT, WIDTH), lens, world_from_cam) - world_from_cam[:, None, None, :3, 3]
    depth = (DEPTH - world_from_cam[:, 2, 3])[:, None, None] / rays[..., 2]
    means = unproject_to_world(depth, lens, world_from_cam).reshape(-1, 3)
    generator = torch.Generator().manual_seed(3)
    count = len(means)
    means[:, 2] += 0.01 * torch.randn(count, generator=generator)  # no two at one depth, whose order would be chance
    colours = torch.stack([means[:, 0].sin() * 0.3 + 0.5, means[:, 1].cos() * 0.3 + 0.5, means[:, 0] * 0 + 0.4], -1)
    sh = torch.cat([sh_from_rgb(colours)[:, None], 0.2 * torch.randn(count, 15, 3, generator=generator)], 1)
    confidence = torch.rand(3, HEIGHT, WIDTH, generator=generator) + 1
    return Reconstruction(
        method="sceneexpander",
        model="test",
        weights_sha256="0" * 64,
        view_ids=VIEWS,
        generated=torch.tensor([False, False, True]),
        posed=torch.ones(3, dtype=torch.bool),
        camera_vector=camera_vector_from_pose(world_from_cam, lens, HEIGHT, WIDTH),
        world_from_cam=world_from_cam,
        intrinsics_px=lens,
        depth=depth,
        depth_conf=confidence,
        normals=torch.tensor([0.0, 0, -1]).expand(3, HEIGHT, WIDTH, 3).clone(),
        normals_conf=confidence,
        gaussians=Gaussians(
            means=means,
            quat_wxyz=torch.tensor([1.0, 0.2, -0.1, 0.3]).expand(count, 4).clone(),
            scales=torch.tensor([0.08, 0.08, 0.02]).expand(count, 3).clone(),
            opacities=torch.full((count,), 0.95),
            sh=sh[:, :sh_coefficients],
            source_view=torch.arange(3).repeat_interleave(HEIGHT * WIDTH),
            generated=(torch.arange(3) == GENERATED).repeat_interleave(HEIGHT * WIDTH),
        ),
    )


def views(ids: tuple[str, ...], *, generated: bool) -> ViewSet:
    """Pictures of noise, finer ones of the same framing beside them."""
    generator = torch.Generator().manual_seed(len(ids))
    fine = torch.rand(len(ids), 3, HEIGHT * FINER, WIDTH * FINER, generator=generator)
    records = tuple(
        ViewRecord(
            view_id=view,
            name=f"{view}.jpg",
            original_height=HEIGHT * FINER,
            original_width=WIDTH * FINER,
            sha256=f"{index:064d}",
            stored_from_original=((0.5, 0.0, 0.0), (0.0, 0.5, 0.0)),
            generated=generated,
            round=int(generated),
        )
        for index, view in enumerate(ids)
    )
    photos = tuple((picture * 255).to(torch.uint8) for picture in fine)
    return ViewSet(records=records, images=fine[..., ::FINER, ::FINER], detail_images=fine, photos=photos)


def save_finished(folder: Path, known: KnownCameras | None = None) -> Path:
    """What the pipeline leaves of one round."""
    Scene(
        name="wall",
        views=views(VIEWS[:GENERATED], generated=False),
        rounds=(RoundSpec(prompt="a well"),),
        known=known,
    ).save(folder / "scene")
    how = Provenance(
        backend="openai",
        prompt="a well behind\nthe wall, größer",
        source="some-model",
        sha256="a" * 64,
        digital_source_type="trainedAlgorithmicMedia",
    )
    inserted = InsertedView(round=1, view=views(VIEWS[GENERATED:], generated=True), chosen=0, provenance=(how,))
    inserted.save(folder / "round_1" / "inserted")
    reconstruction().save(folder / "round_1" / "sceneexpander" / "reconstruction")
    return folder
