"""Artefacts of random numbers."""

import torch

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import ViewRecord, ViewSet
from sceneexpander.geometry.gaussians import GaussianCounts
from tests.support.tiny_model import TinyReconstructor, tiny_images


def make_views(count: int, *, generated: bool = False, start: int = 0) -> ViewSet:
    images = (tiny_images(count, seed=start + 1) * 255).round() / 255  # as if read from 8-bit files
    records = tuple(
        ViewRecord(
            view_id=f"{start + i:03d}_view",
            name=f"photo {i}.JPG",
            original_height=120,
            original_width=160,
            sha256=f"{i:064x}",
            stored_from_original=((0.1, 0.0, -0.5), (0.0, 0.1, 0.25)),
            generated=generated,
            round=int(generated),
        )
        for i in range(count)
    )
    return ViewSet(records=records, images=images, detail_images=images)


def make_reconstruction() -> Reconstruction:
    with torch.no_grad():
        p = TinyReconstructor().predict(tiny_images(2), generated=torch.tensor([False, True]))
    return Reconstruction(
        method="backbone",
        model="tiny",
        weights_sha256="ab",
        view_ids=("000_a", "001_b"),
        generated=torch.tensor([False, True]),
        posed=torch.tensor([True, True]),
        camera_vector=p.camera_vector,
        world_from_cam=p.world_from_cam,
        intrinsics_px=p.intrinsics_px,
        depth=p.depth,
        depth_conf=p.depth_conf,
        normals=p.normals,
        normals_conf=p.normals_conf,
        gaussians=p.gaussians,
        counts=GaussianCounts(made=len(p.gaussians) + 5, merged=5, kept=len(p.gaussians)),
    )
