"""What the metrics of one reconstruction cost, CPU and wall seconds each: ``python benchmarks/metrics.py [--views 9] [--side 518]``."""

from __future__ import annotations

import argparse
import time

import torch

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import ViewRecord, ViewSet
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.evaluate import MEASURES
from sceneexpander.evaluation.measure import Subject
from sceneexpander.evaluation.views import see_views
from sceneexpander.geometry.camera import camera_vector_from_pose, unproject_to_world
from sceneexpander.geometry.gaussians import Gaussians, sh_from_rgb
from sceneexpander.geometry.trajectory import navigation
from sceneexpander.synthetic import make_views


def made_scene(count: int, height: int, width: int) -> tuple[Reconstruction, ViewSet]:
    """A room, one Gaussian per pixel at its true depth; the last view is the inserted one."""
    made = make_views(3, views=count, height=height, width=width, kind="room", split="test")
    points = unproject_to_world(made.depth, made.intrinsics_px, made.world_from_cam)
    number = height * width
    size = (0.7 * made.depth / made.intrinsics_px[:, 0, 0, None, None]).reshape(-1, 1)
    generated = torch.zeros(count, dtype=torch.bool)
    generated[-1] = True
    gaussians = Gaussians(
        means=points.reshape(-1, 3),
        quat_wxyz=torch.tensor([1.0, 0, 0, 0]).expand(count * number, 4).clone(),
        scales=size.expand(-1, 3).clone(),
        opacities=torch.full((count * number,), 0.9),
        sh=sh_from_rgb(made.images.permute(0, 2, 3, 1).reshape(-1, 1, 3)),
        source_view=torch.arange(count).repeat_interleave(number),
        generated=generated.repeat_interleave(number),
    )
    records = tuple(
        ViewRecord(
            view_id=f"{index:03d}",
            name=f"{index}.png",
            original_height=height,
            original_width=width,
            sha256=str(index),
            stored_from_original=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
            generated=bool(generated[index]),
            round=int(generated[index]),
        )
        for index in range(count)
    )
    scene = Reconstruction(
        method="sceneexpander",
        model="made",
        weights_sha256="0" * 64,
        view_ids=tuple(record.view_id for record in records),
        generated=generated,
        posed=torch.ones(count, dtype=torch.bool),
        camera_vector=camera_vector_from_pose(made.world_from_cam, made.intrinsics_px, height, width),
        world_from_cam=made.world_from_cam,
        intrinsics_px=made.intrinsics_px,
        depth=made.depth,
        depth_conf=torch.ones_like(made.depth),
        normals=made.normals,
        normals_conf=torch.ones_like(made.depth),
        gaussians=gaussians,
    )
    return scene, ViewSet(records=records, images=made.images, detail_images=made.images)


def main() -> None:
    """Print a line per measure and the sum."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--views", type=int, default=9)
    parser.add_argument("--side", type=int, default=518)
    parser.add_argument("--frames", type=int, default=48, help="of the tour")
    given = parser.parse_args()
    height, width = round(given.side * 0.75 / 14) * 14, given.side
    scene, views = made_scene(given.views, height, width)
    config = EvaluateConfig(consistency_frames=8)
    path = navigation(scene.cameras, given.frames, range(given.views))
    total, wall = time.process_time(), time.perf_counter()
    started, began = total, wall
    with torch.no_grad():
        seen = see_views(scene, views, config)
    print(f"{time.process_time() - started:7.2f} {time.perf_counter() - began:7.2f}  drawing every view")
    subject = Subject(reconstruction=scene, views=views, round_number=1, config=config, seen=seen, navigation=path)
    for measure in MEASURES:
        started, began = time.process_time(), time.perf_counter()
        with torch.no_grad():
            for view in seen:
                measure.of_view(view)
        measure.of_scene(subject)
        print(f"{time.process_time() - started:7.2f} {time.perf_counter() - began:7.2f}  {type(measure).__name__}")
    print(
        f"{time.process_time() - total:7.2f} {time.perf_counter() - wall:7.2f}  in all, {torch.get_num_threads()} thread(s)"
    )


if __name__ == "__main__":
    main()
