"""The tour of one reconstruction, as videos of colour, depth and provenance, and every view seen again."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.renders import Renders
from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.artifacts.views import save_png
from sceneexpander.evaluation.views import same_place
from sceneexpander.geometry.camera import resize_intrinsics
from sceneexpander.geometry.trajectory import navigation, shortest_path_order
from sceneexpander.rendering.config import RenderConfig
from sceneexpander.splatting import RasterSettings, Render, render
from sceneexpander.splatting.ply import write_ply
from sceneexpander.splatting.video import colourise_depth, depth_range, tint_generated, write_video

_COVERED = 0.5  # alpha from which a pixel's depth means something
_EVEN = 2  # video codecs with subsampled colour need even sides


@dataclass(frozen=True, slots=True, kw_only=True)
class Tour:
    """Cameras of the video's frames in the reconstruction's own frame."""

    world_from_cam: Float[Tensor, "frame 4 4"]
    intrinsics_px: Float[Tensor, "frame 3 3"]
    height: int
    width: int
    inserted_frame: int
    inserted_camera: str


def plan_tour(reconstruction: Reconstruction, reference: Reconstruction, config: RenderConfig) -> Tour:
    """From the captured cameras into the inserted view and back.

    Args:
        reconstruction: whose scene is shown; its own cameras are used.
        reference: a reconstruction with the inserted view last. If ``reconstruction`` lacks that view (nothing was inserted yet), the
            camera comes from here, brought over by aligning the captured cameras of both.
        config: number of frames and size.
    """
    target = reference.view_ids[-1]
    place = {view: i for i, view in enumerate(reconstruction.view_ids)}
    # The order comes from the reference for all methods, so that their videos show the same tour.
    seen = [i for i, view in enumerate(reference.view_ids[:-1]) if view in place and bool(reference.posed[i])]
    order = shortest_path_order(reference.world_from_cam[[*seen, -1]], last=len(seen))
    there = [place[reference.view_ids[seen[i]]] for i in order[:-1]]
    poses, intrinsics = reconstruction.world_from_cam, reconstruction.intrinsics_px
    if target in place:
        origin, goal = reconstruction.method, place[target]
    else:
        origin, goal = reference.method, len(poses)
        poses = torch.cat([poses, same_place(reference.world_from_cam[-1:], reference, reconstruction)])
        intrinsics = torch.cat([intrinsics, reference.intrinsics_px[-1:]])
    path_poses, path_intrinsics = navigation(poses, intrinsics, config.frames, [*there, goal, *there[::-1]])
    inserted_frame = int((path_poses - poses[goal]).flatten(1).norm(dim=1).argmin())
    height, width = reconstruction.depth.shape[1:]
    height_px, width_px = (_EVEN * max(1, round(side * config.scale / _EVEN)) for side in (height, width))
    return Tour(
        world_from_cam=path_poses,
        intrinsics_px=resize_intrinsics(path_intrinsics, width_px / width, height_px / height),
        height=height_px,
        width=width_px,
        inserted_frame=inserted_frame,
        inserted_camera=origin,
    )


@torch.no_grad()
def produce_renders(
    reconstruction: Reconstruction,
    reference: Reconstruction,
    config: RenderConfig,
    folder: Path,
    *,
    device: torch.device | str = "cpu",
    on_frame: Callable[[int], None] | None = None,
) -> Renders:
    """Fill ``folder`` and return what is in it. Arguments as in `plan_tour`."""
    tour = plan_tour(reconstruction, reference, config)
    settings = RasterSettings(antialiased=config.antialiased)
    gaussians = reconstruction.gaussians.to(device)
    background = torch.full((3,), config.background, device=device)

    def see(pose: Tensor, intrinsics: Tensor, height: int, width: int) -> Render:
        return render(
            gaussians,
            pose[None].to(device),
            intrinsics[None].to(device),
            height,
            width,
            background=background,
            settings=settings,
        )

    frames = []
    for index, (pose, intrinsics) in enumerate(zip(tour.world_from_cam, tour.intrinsics_px, strict=True)):
        frames.append(see(pose, intrinsics, tour.height, tour.width))
        if on_frame is not None:
            on_frame(index + 1)
    layers = _layers(frames)
    videos = {name: f"{name}.mp4" for name in layers}
    for name, pictures in layers.items():
        write_video(pictures, folder / videos[name], config.fps)
    stills = _save_stills(layers, tour.inserted_frame, config.stills, folder)
    views = []
    height, width = reconstruction.depth.shape[1:]
    (folder / "views").mkdir()
    for index, view in enumerate(reconstruction.view_ids):
        seen = see(reconstruction.world_from_cam[index], reconstruction.intrinsics_px[index], height, width)
        views.append((view, f"views/{view}.png"))
        save_png(folder / "views" / f"{view}.png", seen.rgb[0])
    write_ply(reconstruction.gaussians, folder / "gaussians.ply")
    _save_trajectory(tour, config, folder / "trajectory.json")
    renders = Renders(
        method=reconstruction.method,
        frames=len(frames),
        fps=config.fps,
        height=tour.height,
        width=tour.width,
        videos=videos,
        stills=stills,
        views=tuple(views),
        inserted_frame=tour.inserted_frame,
        inserted_camera=tour.inserted_camera,
        gaussians=len(reconstruction.gaussians),
        scene="gaussians.ply",
        world_from_cam=tour.world_from_cam,
        intrinsics_px=tour.intrinsics_px,
    )
    renders.save(folder)
    return renders


def _layers(frames: list[Render]) -> dict[str, Float[Tensor, "frame 3 height width"]]:
    rgb = torch.cat([frame.rgb for frame in frames]).clamp(0, 1).cpu()
    alpha = torch.cat([frame.alpha for frame in frames]).cpu()
    depth = torch.cat([frame.depth for frame in frames]).cpu()
    generated = torch.cat([frame.generated for frame in frames]).cpu()
    covered = alpha > _COVERED
    return {
        "rgb": rgb,
        "depth": colourise_depth(depth, covered, limits=depth_range(depth, covered)),
        "provenance": tint_generated(rgb, generated * alpha),
    }


def _save_stills(
    layers: dict[str, Tensor], inserted_frame: int, count: int, folder: Path
) -> tuple[tuple[int, dict[str, str]], ...]:
    """Evenly spread frames, the one at the inserted camera among them."""
    total = next(iter(layers.values())).shape[0]
    spread = {math.floor(i * (total - 1) / max(count - 1, 1)) for i in range(count)}
    (folder / "stills").mkdir()
    stills = []
    for index in sorted(spread | {inserted_frame}):
        names = {name: f"stills/{name}_{index:04d}.png" for name in layers}
        for name, pictures in layers.items():
            save_png(folder / names[name], pictures[index])
        stills.append((index, names))
    return tuple(stills)


def _save_trajectory(tour: Tour, config: RenderConfig, path: Path) -> None:
    content = {
        "convention": "OpenCV axes, world_from_cam, intrinsics in pixels with the origin at the corner of the first pixel",
        "fps": config.fps,
        "height": tour.height,
        "width": tour.width,
        "inserted_frame": tour.inserted_frame,
        "frames": [
            {"world_from_cam": pose.tolist(), "intrinsics_px": intrinsics.tolist()}
            for pose, intrinsics in zip(tour.world_from_cam, tour.intrinsics_px, strict=True)
        ],
    }
    write_json_atomic(path, content)
