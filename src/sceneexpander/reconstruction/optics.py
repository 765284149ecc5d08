"""What is known of cameras before the pictures are asked, as the front-end takes it: what files say of lenses, and given cameras."""

from __future__ import annotations

from dataclasses import replace

import torch

from sceneexpander.artifacts.scene import KnownCameras
from sceneexpander.artifacts.views import ViewRecord, ViewSet
from sceneexpander.frontend.lenses import ViewOptics


def optics_of(views: ViewSet) -> tuple[ViewOptics, ...]:
    """Per view how its stored picture lies on the original, and what its file says of the lens."""
    return tuple(_optics(record) for record in views.records)


def known_of(views: ViewSet, known: KnownCameras | None) -> KnownCameras | None:
    """The known cameras with a row for every view: those that came later, after the views that the cameras belong to, have none.

    Their poses are not finite, which the front-end takes for unknown. Known intrinsics are kept as they are, so the front-end wants them
    of all views: one without, a generated picture or one of a partly calibrated capture, gets the others' focal lengths (in stored pixels)
    and its own centre.
    """
    if known is None:
        return None
    poses, intrinsics, depth = known.world_from_cam, known.intrinsics_px, known.depth
    if poses is not None:
        missing = poses.new_full((len(views) - len(poses), 4, 4), float("nan"))
        poses = torch.cat([poses, missing])
    if intrinsics is not None:
        given = torch.isfinite(intrinsics).all(-1).all(-1)
        focals = intrinsics[given][:, [0, 1], [0, 1]].median(dim=0).values
        rows = []
        for view, record in enumerate(views.records):
            if view < len(intrinsics) and bool(given[view]):
                rows.append(intrinsics[view])
                continue
            affine = intrinsics.new_tensor(record.stored_from_original)
            middle = intrinsics.new_tensor([record.original_width / 2, record.original_height / 2])
            row = torch.eye(3).to(intrinsics)
            row[[0, 1], [0, 1]], row[:2, 2] = focals, affine[:, :2] @ middle + affine[:, 2]
            rows.append(row)
        intrinsics = torch.stack(rows)
    if depth is not None:
        depth = torch.cat([depth, depth.new_zeros(len(views) - len(depth), *depth.shape[1:])])
    return replace(known, world_from_cam=poses, intrinsics_px=intrinsics, depth=depth)


def _optics(record: ViewRecord) -> ViewOptics:
    said, lens, focal_px = record.lens, "", None
    if said is not None and not record.generated:
        focal_px = said.focal_px
        long_side = max(record.original_height, record.original_width)
        # Photos of one lens at two zooms are not of one focal; two digits leave room for rounding in the files.
        ratio = "" if focal_px is None else f"{focal_px / long_side:.2f}"
        millimetres = "" if said.focal_mm is None else f"{said.focal_mm:.1f} mm"
        lens = " ".join(part for part in (said.camera, said.lens, millimetres, ratio) if part)
    return ViewOptics(
        original_size=(record.original_height, record.original_width),
        image_from_original=record.stored_from_original,
        lens=lens,
        focal_px=focal_px,
        generated=record.generated,
    )
