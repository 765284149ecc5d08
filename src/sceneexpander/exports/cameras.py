"""Cameras for other programs: JSON, CSV, nerfstudio's transforms.json and COLMAP's model, with the pictures that belong to them.

Pixels have their origin at the corner of the first pixel in all of these formats, as here. COLMAP stores ``cam_from_world`` with OpenCV
axes; transforms.json stores ``world_from_cam`` with OpenGL axes (x right, y up, z backwards).
"""

from __future__ import annotations

import csv
import io
import shutil
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from torch import Tensor

from sceneexpander.artifacts.source_type import MADE_BY_MODEL, source_type_xmp
from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.exports.points import Points, points_of_depth
from sceneexpander.exports.scene import ExportScene, ExportView
from sceneexpander.files import write_bytes_atomic
from sceneexpander.geometry.rigid import quat_wxyz_from_rotation, rigid_inverse

ABOUT = "about.json"  # the statement, in folders of formats without a place for it
_OPENGL_FROM_OPENCV = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
_XMP_CHUNK = "XML:com.adobe.xmp"  # where PNG keeps XMP
_PINHOLE = 1  # COLMAP's number of the camera model fx fy cx cy
_POINTS = 50_000
_CSV_FIELDS = (
    "view", "name", "generated", "width", "height", "fx", "fy", "cx", "cy",
    *(f"m{row}{column}" for row in range(3) for column in range(4)),
)  # fmt: skip


def write_cameras_json(scene: ExportScene, path: Path) -> None:
    """Cameras of all views that have one."""
    cameras = [
        {
            "view": view.view_id,
            "name": view.name,
            "generated": view.generated,
            "width": view.width,
            "height": view.height,
            "world_from_cam": view.world_from_cam.tolist(),
            "intrinsics_px": view.intrinsics_px.tolist(),
        }
        for view in scene.views
    ]
    content = {"about": scene.statement, "statement": scene.statement.sentence(), "cameras": cameras}
    write_json_atomic(path, content)


def write_cameras_csv(scene: ExportScene, path: Path) -> None:
    """One row per view; lines that begin with # say what the numbers mean. m00 to m23 are the rows of ``world_from_cam``."""
    text = io.StringIO()
    for line in (*scene.statement.lines(), "m00 to m23: the first three rows of world_from_cam"):
        text.write(f"# {' '.join(line.split())}\n")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(_CSV_FIELDS)
    for view in scene.views:
        k = view.intrinsics_px
        lens = [float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])]
        pose = view.world_from_cam[:3].flatten().tolist()
        facts = [view.view_id, view.name, int(view.generated), view.width, view.height]
        table.writerow([*facts, *map(repr, (*lens, *pose))])
    write_bytes_atomic(path, text.getvalue().encode())


def write_nerfstudio(scene: ExportScene, folder: Path) -> None:
    """Fill a (scratch) folder: transforms.json, ``images/``, ``sparse_pc.ply``. Depths are not referred to."""
    _copy_pictures(scene, folder / "images")
    frames = []
    for view in scene.views:
        k = view.intrinsics_px
        frames.append(
            {
                "file_path": f"images/{view.view_id}.png",
                "transform_matrix": (view.world_from_cam @ _OPENGL_FROM_OPENCV).tolist(),
                "w": view.width,
                "h": view.height,
                "fl_x": float(k[0, 0]),
                "fl_y": float(k[1, 1]),
                "cx": float(k[0, 2]),
                "cy": float(k[1, 2]),
                "generated": view.generated,
            }
        )
    content = {
        "camera_model": "OPENCV",
        "frames": frames,
        "applied_transform": torch.eye(4)[:3].tolist(),
        "ply_file_path": "sparse_pc.ply",
        "convention": "transform_matrix is world_from_cam with OpenGL camera axes (x right, y up, z backwards)",
        "statement": scene.statement.sentence(),
        "about": scene.statement,
    }
    write_json_atomic(folder / "transforms.json", content)
    points = points_of_depth(scene, most=_POINTS)
    rows = np.empty(len(points.xyz), [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    rows["xyz"], rows["rgb"] = points.xyz.numpy(), points.rgb.numpy()
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {c}" for c in ("red", "green", "blue")),
    ]
    write_bytes_atomic(folder / "sparse_pc.ply", "\n".join([*header, "end_header\n"]).encode() + rows.tobytes())


def _copy_pictures(scene: ExportScene, folder: Path) -> None:
    folder.mkdir(parents=True)
    for view in scene.views:
        target = folder / f"{view.view_id}.png"
        if not view.generated:
            shutil.copyfile(view.picture, target)
            continue
        how = next((g.provenance for g in scene.statement.generated_views if g.view == view.view_id), None)
        kind = (how.digital_source_type if how else None) or MADE_BY_MODEL
        facts = PngInfo()
        facts.add_itxt(_XMP_CHUNK, source_type_xmp(kind, credit=how.source if how else "not recorded").decode())
        with Image.open(view.picture) as picture:
            picture.save(target, pnginfo=facts, compress_level=3)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Model:
    """COLMAP's three tables. Point i is observed by one view, at the pixel whose depth made it."""

    views: Sequence[ExportView]
    quat_wxyz: NDArray[np.float64]  # (view, 4), cam_from_world
    translation: NDArray[np.float64]  # (view, 3)
    lens: NDArray[np.float64]  # (view, 4): fx fy cx cy
    points: Points
    pixel: Float[Tensor, "point 2"]


def write_colmap(scene: ExportScene, folder: Path, *, text: bool) -> None:
    """Fill a (scratch) folder: ``sparse/0`` with cameras, images and points3D, ``images/`` and the statement.

    One PINHOLE camera per view. A point is a pixel of one view's depth and has that one observation as its track.
    """
    _copy_pictures(scene, folder / "images")
    write_json_atomic(folder / ABOUT, {"about": scene.statement, "statement": scene.statement.sentence()})
    write_colmap_model(scene, folder / "sparse" / "0", text=text)


def write_colmap_model(scene: ExportScene, folder: Path, *, text: bool) -> None:
    """The three files of `write_colmap` alone."""
    poses = torch.stack([rigid_inverse(view.world_from_cam) for view in scene.views])
    lenses = torch.stack([view.intrinsics_px for view in scene.views])
    points = points_of_depth(scene, most=_POINTS)
    # The track is in pixels of the picture that is exported, which may be finer than the depth.
    sizes = torch.tensor([[view.width, view.height] for view in scene.views], dtype=torch.float64)
    model = _Model(
        views=scene.views,
        quat_wxyz=quat_wxyz_from_rotation(poses[:, :3, :3]).numpy(),
        translation=poses[:, :3, 3].numpy(),
        lens=lenses[:, [0, 1, 0, 1], [0, 1, 2, 2]].numpy(),
        points=points,
        pixel=points.place * sizes[points.view],
    )
    folder.mkdir(parents=True, exist_ok=True)
    write = _write_text if text else _write_binary
    for name, content in write(model).items():
        write_bytes_atomic(folder / name, content)


def _own(model: _Model, index: int) -> NDArray[np.int64]:
    """Numbers (from 0) of a view's points."""
    return (model.points.view == index).nonzero()[:, 0].numpy()


def _write_text(model: _Model) -> dict[str, bytes]:
    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    points = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    slots = np.empty(len(model.points.xyz), np.int64)
    pixel = model.pixel.numpy()
    for index, view in enumerate(model.views):
        number = index + 1
        cameras.append(f"{number} PINHOLE {view.width} {view.height} {_join(model.lens[index])}")
        pose = _join([*model.quat_wxyz[index], *model.translation[index]])
        own = _own(model, index)
        slots[own] = np.arange(len(own))
        images += [f"{number} {pose} {number} {view.view_id}.png"]
        images += [" ".join(f"{x!r} {y!r} {point + 1}" for point, (x, y) in zip(own, pixel[own].tolist(), strict=True))]
    cloud = zip(model.points.xyz.tolist(), model.points.rgb.tolist(), model.points.view.tolist(), slots, strict=True)
    points += [f"{i + 1} {_join(xyz)} {r} {g} {b} 0 {v + 1} {s}" for i, (xyz, (r, g, b), v, s) in enumerate(cloud)]
    files = {"cameras.txt": cameras, "images.txt": images, "points3D.txt": points}
    return {name: ("\n".join(lines) + "\n").encode() for name, lines in files.items()}


def _join(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)


def _write_binary(model: _Model) -> dict[str, bytes]:
    count = len(model.views)
    cameras, images = [struct.pack("<Q", count)], [struct.pack("<Q", count)]
    slots = np.empty(len(model.points.xyz), np.int64)
    pixel = model.pixel.numpy()
    for index, view in enumerate(model.views):
        number = index + 1
        cameras.append(struct.pack("<iiQQ4d", number, _PINHOLE, view.width, view.height, *model.lens[index]))
        own = _own(model, index)
        slots[own] = np.arange(len(own))
        seen = np.empty(len(own), [("xy", "<f8", 2), ("point", "<i8")])
        seen["xy"], seen["point"] = pixel[own], own + 1
        images.append(struct.pack("<i7di", number, *model.quat_wxyz[index], *model.translation[index], number))
        images += [f"{view.view_id}.png".encode() + b"\0", struct.pack("<Q", len(own)), seen.tobytes()]
    kinds = [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8"), ("at", "<i4", 2)]
    rows = np.zeros(len(slots), kinds)
    rows["id"] = np.arange(1, len(slots) + 1)
    rows["xyz"], rows["rgb"], rows["track"] = model.points.xyz.numpy(), model.points.rgb.numpy(), 1
    rows["at"] = np.stack([model.points.view.numpy() + 1, slots], 1)
    return {
        "cameras.bin": b"".join(cameras),
        "images.bin": b"".join(images),
        "points3D.bin": struct.pack("<Q", len(slots)) + rows.tobytes(),
    }
