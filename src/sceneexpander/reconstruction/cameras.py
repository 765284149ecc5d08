"""From what the front-end found to what is kept of it: views without distortion, and a report for people."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from jaxtyping import UInt8
from torch import Tensor

from sceneexpander.artifacts.cameras import CameraReport, ViewCamera
from sceneexpander.artifacts.views import ViewSet, to_bytes
from sceneexpander.errors import UserError
from sceneexpander.frontend.distortion import Distortion
from sceneexpander.frontend.sfm_types import SparseReconstruction

_log = logging.getLogger(__name__)


def straighten_views(views: ViewSet, distortion: Distortion | None) -> ViewSet:
    """The views as pinhole cameras show them, which is what reconstructors and renderers take; unchanged if no lens bends anything.

    Pixels of the frame that the lens did not show become invalid.
    """
    if distortion is None or not distortion.k.any():
        return views
    images, seen = distortion.straightened(views.images)
    height, width = views.images.shape[-2:]
    detail_height, detail_width = views.detail_images.shape[-2:]
    detail, _ = distortion.scaled(np.array([detail_width / width, detail_height / height])).straightened(
        views.detail_images
    )
    valid = None
    if views.valid is not None or not bool(seen.all()):
        shown, _ = distortion.straightened(views.validity()[:, None].to(images.dtype))
        valid = seen & (shown[:, 0] > 0.5)
    records = tuple(
        replace(record, distortion=(float(k[0]), float(k[1])))
        for record, k in zip(views.records, distortion.k, strict=True)
    )
    photos = None
    if views.photos is not None:
        photos = tuple(_straightened_photo(views, view, distortion) for view in range(len(views)))
    return ViewSet(records=records, images=images, detail_images=detail, valid=valid, photos=photos)


def _straightened_photo(
    views: ViewSet, view: int, distortion: Distortion
) -> UInt8[Tensor, "3 photo_height photo_width"]:
    """One at a time: as floating point numbers, all of them at once would not fit in memory."""
    photo = views.photo(view)
    finer = np.array([photo.shape[-1] / views.width, photo.shape[-2] / views.height])
    own = replace(distortion, intrinsics=distortion.intrinsics[[view]], k=distortion.k[[view]])
    return to_bytes(own.scaled(finer).straightened(photo[None])[0][0])


def report_cameras(views: ViewSet, found: SparseReconstruction) -> CameraReport:
    """What people should know about the cameras of these views."""
    cameras = tuple(
        ViewCamera(
            view_id=record.view_id,
            name=record.name,
            generated=record.generated,
            posed=own.registered,
            rough=own.loose,
            reason=own.reason,
            warnings=own.warnings,
            focal_ratio=own.focal_ratio,
            focal_source=str(own.focal_source),
            distortion=own.distortion,
            inliers=own.inliers,
            error_px=float(own.mean_error_px) if np.isfinite(own.mean_error_px) else None,
        )
        for record, own in zip(views.records, found.report.views, strict=True)
    )
    return CameraReport(views=cameras, notes=found.report.notes)


def announce_cameras(report: CameraReport, *, strict: bool) -> None:
    """Say in one line how many photos are used and, one line each, what is not as it should be.

    Raises:
        UserError: ``strict`` and something is not as it should be.
    """
    problems = report.problems()
    _log.log(logging.WARNING if problems else logging.INFO, "%s", report.summary())
    if strict and problems:
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise UserError(
            f"{problems[0]}{more}", where="cameras", fix="take the photo out, or set frontend.strict=false to go on"
        )
    for line in report.remarks():
        _log.warning("%s", line)
