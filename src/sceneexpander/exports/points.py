"""Points of the views' depths, with the views' colours."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from sceneexpander.artifacts.views import to_bytes
from sceneexpander.exports.gltf import glb_bytes, load_trimesh
from sceneexpander.exports.scene import ExportScene, ExportView
from sceneexpander.files import complete_file
from sceneexpander.geometry.camera import pixel_centres, unproject_to_world

POINTS_GLB = 300_000
_LEAST_CONFIDENT = 0.1  # share of each view's pixels that are left out
_FRUSTUM = 0.06  # length of a drawn camera in the usual depth of its scene
_CAPTURED_RGBA, _GENERATED_RGBA = (70, 130, 230, 255), (245, 130, 30, 255)


@dataclass(frozen=True, slots=True, kw_only=True)
class Points:
    """Points of the world and where they were seen."""

    xyz: Float[Tensor, "point 3"]  # float64
    rgb: UInt8[Tensor, "point 3"]
    view: Int[Tensor, "point"]  # index into the exported views
    place: Float[Tensor, "point 2"]  # x, y in that view's picture, as shares of its width and height; float64
    generated: Bool[Tensor, "point"]


def points_of_depth(scene: ExportScene, *, most: int) -> Points:
    """An even choice of pixels of all views with a camera, without the least confident tenth of each view.

    Of a scene of captured or generated Gaussians alone, only views of that kind have points.
    """
    made = scene.reconstruction
    height, width = made.depth.shape[1:]
    wanted = {"all": (False, True), "generated": (True,), "captured": (False,)}[scene.statement.part]
    index_of = {view: index for index, view in enumerate(made.view_ids)}
    used = [(number, index_of[v.view_id]) for number, v in enumerate(scene.views) if v.generated in wanted]
    places = pixel_centres(height, width, like=made.depth.double()).reshape(-1, 2)
    places = places / places.new_tensor([width, height])
    generator = torch.Generator().manual_seed(0)
    chosen: list[tuple[Tensor, ...]] = []
    for number, index in used:
        confidence = made.depth_conf[index].flatten()
        sure = (confidence >= torch.quantile(confidence, _LEAST_CONFIDENT)).nonzero()[:, 0]
        pick = sure[torch.randperm(len(sure), generator=generator)[: most // len(used)]].sort().values
        pose, lens = made.world_from_cam[index].double(), made.intrinsics_px[index].double()
        # The exported pose, not its rounded copy: points project exactly where they came from.
        pose = scene.views[number].world_from_cam.to(pose)
        xyz = unproject_to_world(made.depth[index].double(), lens, pose).reshape(-1, 3)[pick]
        rgb = to_bytes(scene.images[index]).flatten(1).T[pick]
        view = torch.full((len(pick),), number)
        chosen.append((xyz, rgb, view, places[pick], torch.full((len(pick),), scene.views[number].generated)))
    if not chosen:
        none = torch.zeros(0, dtype=torch.float64)
        empty = none.reshape(0, 3)
        return Points(xyz=empty, rgb=empty.byte(), view=none.long(), place=none.reshape(0, 2), generated=none.bool())
    xyz, rgb, view, place, generated = (torch.cat(column) for column in zip(*chosen, strict=True))
    return Points(xyz=xyz, rgb=rgb, view=view, place=place, generated=generated)


def write_points(scene: ExportScene, path: Path) -> None:
    """Points and a small pyramid per camera (blue: captured, orange: generated) as GLB."""
    trimesh = load_trimesh()
    points = points_of_depth(scene, most=POINTS_GLB)
    content = trimesh.Scene()
    for name, keep in (("captured", ~points.generated), ("generated", points.generated)):
        if bool(keep.any()):
            cloud = trimesh.PointCloud(points.xyz[keep].numpy(), colors=points.rgb[keep].numpy())
            content.add_geometry(cloud, node_name=f"points_{name}", geom_name=f"points_{name}")
    size = _FRUSTUM * float(scene.reconstruction.depth.median())
    for view in scene.views:
        content.add_geometry(_pyramid(trimesh, view, size), node_name=f"camera_{view.view_id}")
    with complete_file(path) as scratch:
        scratch.write_bytes(glb_bytes(content, scene.statement))


def _pyramid(trimesh: Any, view: ExportView, size: float) -> Any:
    corners = torch.tensor([[0.0, 0], [view.width, 0], [view.width, view.height], [0, view.height]]).double()
    rays = torch.cat([corners, torch.ones(4, 1).double()], 1) @ torch.linalg.inv(view.intrinsics_px).T
    tips = torch.cat([torch.zeros(1, 3).double(), rays * size])
    placed = tips @ view.world_from_cam[:3, :3].T + view.world_from_cam[:3, 3]
    faces = [[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 3], [1, 3, 4]]
    colour = _GENERATED_RGBA if view.generated else _CAPTURED_RGBA
    return trimesh.Trimesh(placed.numpy(), np.array(faces), vertex_colors=[colour] * 5, process=False)
