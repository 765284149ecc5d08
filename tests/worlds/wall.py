"""A small made scene: three cameras before a coloured wall of Gaussians, with pictures that are its own renderings."""

from __future__ import annotations

import dataclasses

import torch

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import ViewRecord, ViewSet
from sceneexpander.geometry.camera import camera_vector_from_pose, intrinsics_from_parts, unproject_to_world
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians, concatenate, sh_from_rgb
from sceneexpander.geometry.rigid import look_at
from sceneexpander.splatting import render

HEIGHT, WIDTH = 28, 42
DEPTH = 3.0


def record(index: int, *, generated: bool = False) -> ViewRecord:
    return ViewRecord(
        view_id=f"{index:03d}",
        name=f"{index}.png",
        original_height=HEIGHT,
        original_width=WIDTH,
        sha256=f"hash{index}",
        stored_from_original=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
        generated=generated,
        round=int(generated),
    )


def colour_at(points: torch.Tensor) -> torch.Tensor:
    """A smooth pattern on the wall."""
    x, y = points[..., 0], points[..., 1]
    return torch.stack(
        [0.5 + 0.4 * torch.sin(3 * x), 0.5 + 0.4 * torch.cos(2 * y), 0.5 + 0.3 * torch.sin(2 * x + y)], -1
    )


def made_reconstruction(eyes_x: tuple[float, ...] = (0.0, 0.3, 2.2), generated_last: bool = True) -> Reconstruction:
    """Cameras at the given places looking straight at the wall z = 3; one Gaussian per pixel of each view."""
    count = len(eyes_x)
    eyes = torch.stack([torch.tensor([x, 0.0, 0.0]) for x in eyes_x])
    ahead = eyes + torch.tensor([0.0, 0.0, 1.0])
    poses = look_at(eyes, ahead, torch.tensor([0.0, -1.0, 0.0]))
    focal, one = torch.full((count,), 40.0), torch.ones(count)
    intrinsics = intrinsics_from_parts(focal, focal, one * WIDTH / 2, one * HEIGHT / 2)
    depth = torch.full((count, HEIGHT, WIDTH), DEPTH)
    generated = torch.zeros(count, dtype=torch.bool)
    generated[-1] = generated_last
    points = unproject_to_world(depth, intrinsics, poses).reshape(count, -1, 3)
    parts = []
    for view in range(count):
        number = points.shape[1]
        parts.append(
            Gaussians(
                means=points[view],
                quat_wxyz=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(number, 4).clone(),
                scales=torch.full((number, 3), 0.6 * DEPTH / 40),
                opacities=torch.full((number,), 0.9),
                sh=sh_from_rgb(colour_at(points[view]))[:, None, :],
                source_view=torch.full((number,), view),
                generated=torch.full((number,), bool(generated[view])),
            )
        )
    normals = torch.zeros(count, HEIGHT, WIDTH, 3)
    normals[..., 2] = -1
    return Reconstruction(
        method="sceneexpander",
        model="made",
        weights_sha256="0" * 64,
        view_ids=tuple(f"{i:03d}" for i in range(count)),
        generated=generated,
        posed=torch.ones(count, dtype=torch.bool),
        camera_vector=camera_vector_from_pose(poses, intrinsics, HEIGHT, WIDTH),
        world_from_cam=poses,
        intrinsics_px=intrinsics,
        depth=depth,
        depth_conf=torch.ones_like(depth),
        normals=normals,
        normals_conf=torch.ones_like(depth),
        gaussians=concatenate(parts),
    )


def own_pictures(reconstruction: Reconstruction) -> ViewSet:
    """What the reconstruction shows of itself, as its views."""
    seen = render(
        reconstruction.gaussians, Cameras(reconstruction.world_from_cam, reconstruction.intrinsics_px, HEIGHT, WIDTH)
    ).rgb.clamp(0, 1)
    flags = reconstruction.generated.tolist()
    return ViewSet(
        records=tuple(record(i, generated=flag) for i, flag in enumerate(flags)), images=seen, detail_images=seen
    )


def without_generated(reconstruction: Reconstruction) -> Reconstruction:
    """The captured views only, as the method ``captured``."""
    keep = [i for i, flag in enumerate(reconstruction.generated.tolist()) if not flag]
    names = ("generated", "posed", "camera_vector", "world_from_cam", "intrinsics_px", "depth", "depth_conf", "normals")
    return dataclasses.replace(
        reconstruction,
        method="captured",
        view_ids=tuple(reconstruction.view_ids[i] for i in keep),
        normals_conf=reconstruction.normals_conf[keep],
        gaussians=reconstruction.gaussians.select(~reconstruction.gaussians.generated),
        **{name: getattr(reconstruction, name)[keep] for name in names},
    )
