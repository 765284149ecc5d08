"""Small scenes to obtain pictures for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.scene import RoundSpec, Scene
from sceneexpander.artifacts.views import ViewRecord, ViewSet
from sceneexpander.generation import GenerationContext, SceneSoFar
from sceneexpander.geometry.camera import camera_vector_from_pose, unproject_to_world
from sceneexpander.geometry.gaussians import SH_DC, Gaussians

HEIGHT, WIDTH = 56, 84


def photo(path: Path, seed: int, size: tuple[int, int] = (168, 252), **options: object) -> Path:
    """A picture of soft patches of colour."""
    path.parent.mkdir(parents=True, exist_ok=True)
    coarse = np.random.default_rng(seed).integers(0, 255, (5, 7, 3), dtype=np.uint8)
    Image.fromarray(coarse).resize(size[::-1], Image.Resampling.BICUBIC).save(path, **options)
    return path


def context_of(scene: Scene, folder: Path, number: int = 1, *, spec: RoundSpec | None = None) -> GenerationContext:
    """A round of a scene; its cache lies beside the scene's folder."""
    return GenerationContext(
        scene_folder=folder,
        scene=scene.name,
        round_number=number,
        spec=scene.round_spec(number) if spec is None else spec,
        captured=scene.views,
        cache=folder.parent / "generated",
    )


def flat_scene(views: ViewSet, *, distance: float = 2.0, apart: float = 0.2) -> SceneSoFar:
    """What would be reconstructed if the views were taken side by side, looking at a wall that shows the first of them."""
    count, height, width = len(views), views.height, views.width
    poses = torch.eye(4).repeat(count, 1, 1)
    poses[:, 0, 3] = torch.arange(count) * apart
    focal = float(width)
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]]).repeat(count, 1, 1)
    depth = torch.full((count, height, width), distance)
    points = unproject_to_world(depth[:1], intrinsics[:1], poses[:1]).reshape(-1, 3)
    colours = views.images[0].permute(1, 2, 0).reshape(-1, 3)
    size = distance / focal
    gaussians = Gaussians(
        means=points,
        quat_wxyz=torch.tensor([1.0, 0, 0, 0]).repeat(len(points), 1),
        scales=torch.full((len(points), 3), 0.6 * size),
        opacities=torch.full((len(points),), 0.99),
        sh=((colours - 0.5) / SH_DC)[:, None],
        generated=torch.zeros(len(points), dtype=torch.bool),
        source_view=torch.zeros(len(points), dtype=torch.int32),
    )
    normals = torch.zeros(count, height, width, 3)
    normals[..., 2] = -1
    reconstruction = Reconstruction(
        method="captured",
        model="none",
        weights_sha256="0",
        view_ids=views.view_ids,
        generated=views.generated,
        posed=torch.ones(count, dtype=torch.bool),
        camera_vector=camera_vector_from_pose(poses, intrinsics, height, width),
        world_from_cam=poses,
        intrinsics_px=intrinsics,
        depth=depth,
        depth_conf=torch.ones(count, height, width),
        normals=normals,
        normals_conf=torch.ones(count, height, width),
        gaussians=gaussians,
    )
    return SceneSoFar(views=views, reconstruction=reconstruction)


def made_views(images: torch.Tensor, detail_images: torch.Tensor) -> ViewSet:
    """Views of given pictures, named ``0.png``, ``1.png``, ..."""
    records = tuple(
        ViewRecord(
            view_id=f"{index:03d}_{index}",
            name=f"{index}.png",
            original_height=int(images.shape[-2]),
            original_width=int(images.shape[-1]),
            sha256=f"{index}" * 64,
            stored_from_original=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
        )
        for index in range(len(images))
    )
    return ViewSet(records=records, images=images, detail_images=detail_images)


@pytest.fixture
def so_far() -> SceneSoFar:
    """Three flat views side by side."""
    images = torch.rand(3, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    return flat_scene(made_views(images, images), apart=0.2)


@pytest.fixture
def context(so_far: SceneSoFar, tmp_path: Path) -> GenerationContext:
    """A round from ``so_far`` that says motion and object apart."""
    spec = RoundSpec(prompt="x", motion="move right 30 %", new_object="a bench")
    return context_of(Scene(name="s", views=so_far.views, rounds=(spec,)), tmp_path / "scene")
