"""Writes the bundled scene folder: captured photos, the inserted view, and the truth about both.

Layout::

    scene.yaml                  name, source, licence, rounds (prompt, motion, object, inserted)
    captured/view_01.jpg ...    captured photos
    inserted/round_1.png        the inserted view, misaligned in a known way
    truth/cameras.json          poses (relative to captured view 0), intrinsics, sizes
    truth/misalignment.json     everything that was done to the inserted view
    truth/clean.png             the inserted view as a consistent photograph would be
    truth/new_region.png        255 where the clean inserted view shows what no captured view sees
    truth/object.png            255 where the clean inserted view shows the requested object
    truth/depth/view_01.png ... z-depth of the captured views, 16-bit, millimetres, 0 = no truth
    truth/depth/inserted.png    the same for the clean inserted view, in the new region only
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from sceneexpander.files import directory_being_written
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.synthetic import courtyard
from sceneexpander.synthetic.degrade import auto_exposure, encode_radiance
from sceneexpander.synthetic.misalign import MisalignedView, Misalignment, misalign
from sceneexpander.synthetic.render import RenderedViews, pose_and_intrinsics, render_world

Array = NDArray[Any]  # float32

DEPTH_UNITS_PER_M = 1000.0
JPEG_QUALITY = 92
#: Relative depth difference up to which two views are taken to see the same point.
SAME_POINT = 0.02
MISALIGNMENT = Misalignment(
    rotation_deg=1.2,
    translation_fraction=0.015,
    deform_fraction=0.012,
    warp_fraction=0.012,
    exposure_stops=0.12,
    white_balance=0.035,
)
_SEED = 7
#: The automatic exposure burns out sunlit plaster a little.
_EXPOSURE = 0.85


@dataclass(frozen=True, slots=True, kw_only=True)
class BundledScene:
    """Everything that goes into the folder, rendered. Poses are in the first captured view's frame."""

    captured: RenderedViews
    captured_images: Array
    clean: RenderedViews
    clean_image: Array
    inserted: MisalignedView
    new_region: NDArray[np.bool_]
    object_mask: NDArray[np.bool_]
    world_from_cam: NDArray[np.float64]
    intrinsics_px: NDArray[np.float64]


def unseen_by(depth: Array, camera: Cameras, depths: Array, others: Cameras) -> NDArray[np.bool_]:
    """(H,W): pixels of one camera's view whose surface point is in no picture of ``others`` unhidden. Sky counts as unseen."""
    height, width = depth.shape
    pose, intrinsics = pose_and_intrinsics(camera)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    solid = np.isfinite(depth)
    z = np.where(solid, depth, 1.0).astype(np.float64)
    cam = np.stack(
        [(x - intrinsics[0, 2]) / intrinsics[0, 0] * z, (y - intrinsics[1, 2]) / intrinsics[1, 1] * z, z], -1
    )
    points = cam @ pose[:3, :3].T + pose[:3, 3]
    seen = np.zeros(depth.shape, dtype=np.bool_)
    for index, other_depth in enumerate(depths):
        other, lens = pose_and_intrinsics(others[index])
        local = (points - other[:3, 3]) @ other[:3, :3]
        ahead = np.maximum(local[..., 2], 1e-6)
        u = local[..., 0] / ahead * lens[0, 0] + lens[0, 2]
        v = local[..., 1] / ahead * lens[1, 1] + lens[1, 2]
        inside = solid & (local[..., 2] > 1e-3) & (u >= 0) & (u < others.width) & (v >= 0) & (v < others.height)
        column, row = np.clip(u, 0, others.width - 1).astype(int), np.clip(v, 0, others.height - 1).astype(int)
        seen |= inside & (ahead < other_depth[row, column] * (1 + SAME_POINT) + 0.02)
    return ~seen


def render_bundled(height: int, width: int, *, supersample: float, ambient_samples: int) -> BundledScene:
    """Render the courtyard: eight captured views, the clean and the misaligned inserted view."""
    cameras, intended = courtyard.captured_cameras(height, width), courtyard.inserted_camera(height, width)
    options: dict[str, Any] = {
        "supersample": supersample,
        "ambient_samples": ambient_samples,
        "light_samples": 2 if ambient_samples else 1,
    }
    without, with_well = courtyard.courtyard_world(well=False), courtyard.courtyard_world(well=True)
    captured = render_world(without, cameras, **options)
    exposure = _EXPOSURE * auto_exposure(captured.radiance)
    clean = render_world(with_well, intended, **options)
    inserted = misalign(
        with_well, intended, MISALIGNMENT, np.random.default_rng(_SEED),
        exposure=exposure, fixed=(courtyard.WELL,), together=courtyard.HOUSE_PARTS, **options,
    )  # fmt: skip
    well_id = with_well.object_names.index(courtyard.WELL)
    poses = cameras.followed_by(intended).world_from_cam.numpy()
    every = np.concatenate([poses, inserted.world_from_used_cam[None]])
    # The new object is new even where its pixels hide something that was captured.
    object_mask = clean.object_id[0] == well_id
    unseen = unseen_by(clean.depth[0], intended, captured.depth, cameras)
    return BundledScene(
        captured=captured,
        captured_images=encode_radiance(captured.radiance, exposure),
        clean=clean,
        clean_image=encode_radiance(clean.radiance[0], exposure),
        inserted=inserted,
        new_region=unseen | object_mask,
        object_mask=object_mask,
        world_from_cam=np.linalg.inv(poses[0]) @ every,
        intrinsics_px=intended.intrinsics_px[0].numpy(),
    )


def _bytes(image: Array) -> NDArray[np.uint8]:
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)[..., ::-1]


def _millimetres(depth: Array, keep: NDArray[np.bool_]) -> NDArray[np.uint16]:
    usable = keep & np.isfinite(depth) & (depth * DEPTH_UNITS_PER_M < 65535)
    return np.where(usable, np.round(np.where(usable, depth, 0) * DEPTH_UNITS_PER_M), 0).astype(np.uint16)


def _cameras(scene: BundledScene, names: list[str]) -> dict[str, Any]:
    height, width = scene.captured.depth.shape[1:]
    views = [{"file": name, "world_from_cam": scene.world_from_cam[index].tolist()} for index, name in enumerate(names)]
    return {
        "schema": 1,
        "convention": "OpenCV camera axes; world = camera of captured view 0; metres; pixel centres at .5",
        "height": height,
        "width": width,
        "intrinsics_px": scene.intrinsics_px.tolist(),
        "captured": views,
        "inserted": {"file": "inserted/round_1.png", "world_from_cam": scene.world_from_cam[len(names)].tolist()},
        "depth": {"unit": "1/1000 m", "no_truth": 0},
    }


def _misalignment(scene: BundledScene, names: list[str]) -> dict[str, Any]:
    true, used = scene.world_from_cam[len(names)], scene.world_from_cam[len(names) + 1]
    return {
        "schema": 1,
        "world_from_true_cam": true.tolist(),
        "world_from_used_cam": used.tolist(),
        "true_from_used": (np.linalg.inv(true) @ used).tolist(),
        "new_region_share": float(scene.new_region.mean()),
        "object_share": float(scene.object_mask.mean()),
    } | scene.inserted.record()


def write_bundled(scene: BundledScene, folder: Path) -> None:
    """Write the folder (see the module docstring); an existing one is replaced only when the new one is complete."""
    with directory_being_written(folder) as scratch:
        for part in ("captured", "inserted", "truth/depth"):
            (scratch / part).mkdir(parents=True)
        names = [f"captured/view_{index + 1:02d}.jpg" for index in range(len(scene.captured_images))]
        for index, name in enumerate(names):
            _write(scratch / name, _bytes(scene.captured_images[index]))
            depth = _millimetres(scene.captured.depth[index], np.ones_like(scene.new_region))
            _write(scratch / f"truth/depth/view_{index + 1:02d}.png", depth)
        _write(scratch / "inserted/round_1.png", _bytes(scene.inserted.image))
        _write(scratch / "truth/clean.png", _bytes(scene.clean_image))
        _write(scratch / "truth/depth/inserted.png", _millimetres(scene.clean.depth[0], scene.new_region))
        _write(scratch / "truth/new_region.png", scene.new_region.astype(np.uint8) * 255)
        _write(scratch / "truth/object.png", scene.object_mask.astype(np.uint8) * 255)
        (scratch / "truth/cameras.json").write_text(json.dumps(_cameras(scene, names), indent=1) + "\n")
        (scratch / "truth/misalignment.json").write_text(json.dumps(_misalignment(scene, names), indent=1) + "\n")
        (scratch / "scene.yaml").write_text(yaml.safe_dump(_DESCRIPTION, sort_keys=False, width=120))


def _write(path: Path, pixels: NDArray[Any]) -> None:
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if path.suffix == ".jpg" else [cv2.IMWRITE_PNG_COMPRESSION, 9]
    done, coded = cv2.imencode(path.suffix, pixels, options)
    if not done:
        raise ValueError(f"cannot encode {path.name} ({pixels.dtype}, {pixels.shape})")
    path.write_bytes(coded.tobytes())


_DESCRIPTION: dict[str, Any] = {
    "name": "courtyard",
    "origin": "made for this project by scripts/make_courtyard.py; every surface is procedural",
    "licence": "same as this repository; no third-party material",
    "rounds": [
        {
            "prompt": courtyard.PROMPT,
            "motion": courtyard.MOTION,
            "object": courtyard.OBJECT,
            "inserted": "inserted/round_1.png",
        }
    ],
}
