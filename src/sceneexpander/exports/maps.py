"""Depth and normals of every view as pictures and as numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image

from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.artifacts.views import save_png
from sceneexpander.exports.scene import ExportScene
from sceneexpander.splatting.video import colourise_depth, depth_range

_LEVELS = 65535


def write_depth(scene: ExportScene, folder: Path) -> None:
    """Fill a (scratch) folder: for each view with a camera ``raw/ID.npy`` (float32), ``png/ID.png`` (16 bits), ``preview/ID.png``.

    A 16-bit level is ``depth_per_level`` long, the same for all views; its value is in ``about.json``.
    """
    made = scene.reconstruction
    names = [view.view_id for view in scene.views]
    index_of = {view: index for index, view in enumerate(made.view_ids)}
    depths = made.depth[[index_of[name] for name in names]]
    # Millimetres, as readers of 16-bit depth expect, where the unit is known to be the metre and 65 m are enough.
    largest = float(depths.max())
    step = 0.001 if scene.statement.metric and largest < 0.001 * _LEVELS else largest / _LEVELS
    for kind in ("raw", "png", "preview"):
        (folder / kind).mkdir(parents=True)
    limits = depth_range(depths)
    for name, depth in zip(names, depths, strict=True):
        np.save(folder / "raw" / f"{name}.npy", depth.numpy().astype(np.float32))
        levels = (
            (depth.double() / step).round().clamp(1, _LEVELS).numpy().astype(np.uint16)
        )  # 0 means "no depth" elsewhere
        Image.fromarray(levels).save(folder / "png" / f"{name}.png")
        save_png(folder / "preview" / f"{name}.png", colourise_depth(depth, limits=limits))
    convention = "z-depth at the pixel centres, in the export's unit; png: depth = level * depth_per_level"
    _write_about(scene, folder, {"convention": convention, "depth_per_level": step})


def write_normals(scene: ExportScene, folder: Path) -> None:
    """Fill a (scratch) folder: for each view with a camera ``raw/ID.npy`` (float32, unit) and ``png/ID.png`` (8 bits)."""
    made = scene.reconstruction
    index_of = {view: index for index, view in enumerate(made.view_ids)}
    for kind in ("raw", "png"):
        (folder / kind).mkdir(parents=True)
    for view in scene.views:
        normals = torch.nn.functional.normalize(made.normals[index_of[view.view_id]], dim=-1)
        np.save(folder / "raw" / f"{view.view_id}.npy", normals.numpy().astype(np.float32))
        save_png(folder / "png" / f"{view.view_id}.png", (normals.permute(2, 0, 1) + 1) / 2)
    convention = (
        "camera frame, OpenCV axes (x right, y down, z forward), towards the camera; png: normal = 2 * value / 255 - 1"
    )
    _write_about(scene, folder, {"convention": convention})


def _write_about(scene: ExportScene, folder: Path, more: dict[str, object]) -> None:
    views = [{"view": view.view_id, "name": view.name, "generated": view.generated} for view in scene.views]
    about = {"about": scene.statement, "statement": scene.statement.sentence(), "views": views}
    write_json_atomic(folder / "about.json", about | more)
