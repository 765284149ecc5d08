"""A flight through one reconstruction, as videos of colour, depth and provenance, and every view seen again."""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.renders import Renders
from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.artifacts.views import save_png, to_bytes
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.rendering.config import RenderConfig
from sceneexpander.rendering.tour import Tour, plan_tour
from sceneexpander.splatting import RasterSettings, Render, render
from sceneexpander.splatting.ply import write_ply
from sceneexpander.splatting.spz import write_spz
from sceneexpander.splatting.video import colourise_depth, depth_range, open_video, tint_generated

logger = logging.getLogger(__name__)

LAYERS = ("rgb", "depth", "provenance")
_COVERED = 0.5  # alpha from which a pixel's depth means something


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
    """Fill ``folder`` and return what is in it. Arguments as in `plan_tour`; ``on_frame`` hears how many frames are done."""
    tour = plan_tour(reconstruction, reference, config)
    with _one_torch_thread() as threads:
        see = _Eye(reconstruction, config, device, threads)
        stills = _film(tour, see, config, folder, on_frame)
        views = _see_again(reconstruction, see, folder)
    write_ply(reconstruction.gaussians, folder / "gaussians.ply")
    if config.spz:
        cut = write_spz(reconstruction.gaussians, folder / "gaussians.spz")
        if cut:
            logger.warning("gaussians.spz: values of %d Gaussians were cut to the range of the format", cut)
    _save_trajectory(tour, config, folder / "trajectory.json")
    renders = Renders(
        method=reconstruction.method,
        frames=config.frames,
        fps=config.fps,
        height=tour.cameras.height,
        width=tour.cameras.width,
        videos={name: f"{name}.mp4" for name in LAYERS},
        stills=stills,
        views=views,
        inserted_frame=tour.inserted_frame,
        inserted_camera=tour.inserted_camera,
        gaussians=len(reconstruction.gaussians),
        scene="gaussians.ply",
        world_from_cam=tour.cameras.world_from_cam,
        intrinsics_px=tour.cameras.intrinsics_px,
    )
    renders.save(folder)
    return renders


@contextlib.contextmanager
def _one_torch_thread() -> Iterator[int]:
    """Gives the number of threads that torch had, and leaves it one.

    The rasteriser and the encoders have threads of their own. What torch does in between is small, and its team, which spins while it
    waits, multiplies the time of a video on a machine that has other work.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield threads
    finally:
        torch.set_num_threads(threads)


class _Eye:
    """Renders one reconstruction."""

    def __init__(
        self, reconstruction: Reconstruction, config: RenderConfig, device: torch.device | str, threads: int
    ) -> None:
        self._gaussians = reconstruction.gaussians.to(device)
        self._background = torch.full((3,), config.background, device=device)
        self._settings = RasterSettings(threads=threads)
        self._device = device

    def __call__(self, camera: Cameras) -> Render:
        return render(self._gaussians, camera.to(self._device), background=self._background, settings=self._settings)


def _see_again(reconstruction: Reconstruction, see: _Eye, folder: Path) -> tuple[tuple[str, str], ...]:
    """Every view rendered at its own camera: (view, picture)."""
    (folder / "views").mkdir()
    cameras = reconstruction.cameras
    views = []
    for index, view in enumerate(reconstruction.view_ids):
        seen = see(cameras[index])
        views.append((view, f"views/{view}.png"))
        save_png(folder / "views" / f"{view}.png", seen.rgb[0])
    return tuple(views)


def _film(
    tour: Tour, see: _Eye, config: RenderConfig, folder: Path, on_frame: Callable[[int], None] | None
) -> tuple[tuple[int, dict[str, str]], ...]:
    """Render and encode frame by frame.

    Depths are kept to the end, because their colours need the range of the whole video; pictures until a path that returns has shown them
    again.
    """
    (folder / "stills").mkdir()
    kept = _stills(len(tour.cameras), tour.inserted_frame, config.stills)
    names = {index: {layer: f"stills/{layer}_{index:04d}.png" for layer in LAYERS} for index in kept}
    depths: list[Float[Tensor, "height width"]] = []
    first_of = tour.cameras.find_repeats()
    last_of = {first: index for index, first in enumerate(first_of)}
    again: dict[int, dict[str, UInt8[Tensor, "3 height width"]]] = {}
    with contextlib.ExitStack() as videos:
        encoders = {
            layer: videos.enter_context(open_video(folder / f"{layer}.mp4", config.fps, crf=config.crf))
            for layer in LAYERS
        }

        def show(
            layer: str, index: int, picture: Float[Tensor, "3 height width"] | UInt8[Tensor, "3 height width"]
        ) -> None:
            encoders[layer].add(picture)
            if index in names:
                save_png(folder / names[index][layer], picture)

        for index, first in enumerate(first_of):
            if first < index:
                depths.append(depths[first])
                for layer, picture in again[first].items():
                    show(layer, index, picture)
            else:
                seen = see(tour.cameras[index])
                rgb, alpha = seen.rgb[0].clamp(0, 1).cpu(), seen.alpha[0].cpu()
                drawn = {"rgb": rgb, "provenance": tint_generated(rgb, seen.generated[0].cpu() * alpha)}
                depths.append(torch.where(alpha > _COVERED, seen.depth[0].cpu(), 0.0))
                for layer, picture in drawn.items():
                    show(layer, index, picture)
                again[index] = {layer: to_bytes(picture) for layer, picture in drawn.items()}
            if last_of[first] == index:
                del again[first]
            if on_frame is not None:
                on_frame(index + 1)
        limits = depth_range(torch.stack(depths))
        for index, depth in enumerate(depths):
            show("depth", index, colourise_depth(depth, limits=limits))
    return tuple(names.items())


def _stills(frames: int, inserted_frame: int, count: int) -> list[int]:
    """Evenly spread frames, the one at the inserted camera among them."""
    spread = {math.floor(i * (frames - 1) / max(count - 1, 1)) for i in range(count)}
    return sorted(spread | {inserted_frame})


def _save_trajectory(tour: Tour, config: RenderConfig, path: Path) -> None:
    content = {
        "convention": "OpenCV axes, world_from_cam, intrinsics in pixels with the origin at the corner of the first pixel",
        "path": config.path,
        "fps": config.fps,
        "height": tour.cameras.height,
        "width": tour.cameras.width,
        "inserted_frame": tour.inserted_frame,
        "frames": [
            {"world_from_cam": pose.tolist(), "intrinsics_px": intrinsics.tolist()}
            for pose, intrinsics in zip(tour.cameras.world_from_cam, tour.cameras.intrinsics_px, strict=True)
        ],
    }
    write_json_atomic(path, content)
