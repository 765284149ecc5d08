"""Photos that no method has seen, at cameras that are found in each method's own scene afterwards.

Methods differ in frame, scale and shape, so a held-out photo has no camera of its own in them. It gets one like this:

- The capture came with cameras and the method kept them: the photo's own given camera.
- Otherwise its matches with captured photos become points at the depth that the method's Gaussians show there, and its pose is found from
  those (P3P inside MAGSAC, robust refinement), with the lens that the method gives a photo of the same lens.

Nothing of the scene is changed for it, and its colours take no part in the pose. A method whose surfaces lie apart gives points that no
camera sees together: then the photo has no camera there, which is said and counted, and no mean is taken over the others.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.artifacts.held_out import HeldOut, TiePoints
from sceneexpander.artifacts.metrics import ViewMetrics
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.catalogue import Views, metric_named
from sceneexpander.catalogue.metrics import metrics_named
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.image import psnr
from sceneexpander.evaluation.likeness import PSNR_CAP_DB, compare_pictures
from sceneexpander.evaluation.measure import (
    FEWEST_PIXELS,
    Measure,
    SeenView,
    UnseenView,
    Values,
    known_values,
    shows_enough,
)
from sceneexpander.frontend.resection import Sighting, resect, solve_pose
from sceneexpander.frontend.sfm_types import REFERENCE_LONG_SIDE_PX, SfmConfig
from sceneexpander.frontend.twoview import homogeneous_rays
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.rigid import rotation_angle_deg, transform_points
from sceneexpander.geometry.similarity import align_poses
from sceneexpander.splatting import render

Show = Callable[[str, Float[Tensor, "3 height width"]], None]
_log = logging.getLogger(__name__)
_THRESHOLDS = SfmConfig()  # those of a view that joins a scene
_KEPT_DEG, _KEPT_SHARE = 0.1, 1e-3  # given cameras were kept if all are as near as this; the second over their extent
_FOCAL_FACTORS = tuple(
    math.log(factor) for factor in (0.5, 0.63, 0.8, 1.0, 1.25, 1.6, 2.0)
)  # tried where no lens is known


@torch.no_grad()
def measure_held_out(
    reconstruction: Reconstruction,
    held_out: HeldOut,
    seen: Sequence[SeenView],
    config: EvaluateConfig,
    measures: Sequence[Measure],
    show: Show | None = None,
) -> tuple[ViewMetrics, ...]:
    """One row per held-out photo; without a camera its values are empty.

    Args:
        reconstruction: what is measured.
        held_out: the photos, matched.
        seen: the reconstruction's views, drawn at their own cameras.
        config: settings.
        measures: asked about every photo that has a camera.
        show: is given the id of every photo that has a camera and what is seen from there.

    Raises:
        ValueError: the photos are of another size than the reconstruction, or a measure answers with numbers of other views.
    """
    if held_out.views is None:
        return ()
    views = held_out.views
    if reconstruction.depth.shape[1:] != views.images.shape[2:]:
        raise ValueError(
            f"held-out photos have {views.height, views.width} pixels, not {reconstruction.depth.shape[1:]}"
        )
    rows = []
    for number, record in enumerate(views.records):
        camera = pose_held_out(reconstruction, held_out, number, seen)
        values: dict[str, float] = {}
        if camera is None:
            _log.warning("%s: the held-out photo has no camera in the scene of %s", record.name, reconstruction.method)
        else:
            drawn = render(reconstruction.gaussians, camera)
            if show is not None:
                show(record.view_id, drawn.rgb[0])
            view = UnseenView(
                picture=views.images[number],
                photo=views.photo(number),
                valid=None if views.valid is None else views.valid[number],
                render=drawn,
                config=config,
            )
            if not shows_enough(view):
                _log.warning("%s: too little of the held-out photo shows the place: no numbers", record.name)
            else:
                for measure in measures:
                    values |= known_values(measure, measure.of_held_out(view))
            for name in values:
                if metric_named(name).scope.views is not Views.HELD_OUT:
                    raise ValueError(f"{name!r} is not a metric of held-out photos")
        rows.append(ViewMetrics(view_id=record.view_id, generated=False, posed=camera is not None, values=values))
    return tuple(rows)


def pose_held_out(
    reconstruction: Reconstruction, held_out: HeldOut, number: int, seen: Sequence[SeenView]
) -> Cameras | None:
    """The camera (stored pixels) of one held-out photo in a reconstruction's own frame; None: not to be found."""
    assert held_out.views is not None  # noqa: S101 - by the caller
    record = held_out.views.records[number]
    height, width = reconstruction.depth.shape[1:]
    places = {view_id: index for index, view_id in enumerate(reconstruction.view_ids)}
    lens = _lens_of(reconstruction, held_out, number, places)
    given = _given_pose(reconstruction, held_out, record.view_id, places)
    if given is not None and lens is not None:
        return Cameras(given[None], lens[None], height, width)
    by_index = {view.index: view for view in seen}
    points, pixels = _points(reconstruction, held_out.ties_of(record.view_id), places, by_index)
    unit = max(height, width) / REFERENCE_LONG_SIDE_PX
    threshold, noise = _THRESHOLDS.register_px * unit, _THRESHOLDS.robust_px * unit
    if lens is not None:
        found = solve_pose(points, pixels, lens.double().numpy(), threshold_px=threshold, robust_px=noise, seed=0)
        if found is None:
            return None
        rotation, translation, inlier = found
    else:
        sighting = Sighting(
            points=points,
            pixel_xy=pixels,
            start=_typical_lens(reconstruction),
            shift_unit_px=np.array([width, height], np.float64),
            log_focal_low=_FOCAL_FACTORS[0],
            log_focal_high=_FOCAL_FACTORS[-1],
            threshold_px=threshold,
            noise_px=noise,
            seed=0,
        )
        resected = resect(sighting, _FOCAL_FACTORS)
        if resected is None:
            return None
        rotation, translation, inlier = resected.rotation, resected.translation, resected.inlier
        lens = torch.from_numpy(sighting.through(resected.lens)).to(reconstruction.intrinsics_px)
    count = int(inlier.sum())
    if count < max(_THRESHOLDS.min_register_inliers, _THRESHOLDS.min_register_share * len(points)):
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ translation
    return Cameras(torch.from_numpy(pose)[None].to(reconstruction.world_from_cam), lens[None], height, width)


def _lens_of(
    reconstruction: Reconstruction, held_out: HeldOut, number: int, places: Mapping[str, int]
) -> Float[Tensor, "3 3"] | None:
    like = held_out.lens_of[number] if held_out.lens_of else ""
    return reconstruction.intrinsics_px[places[like]].cpu() if like in places else None


def _typical_lens(reconstruction: Reconstruction) -> Float[np.ndarray, "3 3"]:
    """Median focal of the photos, centred."""
    captured = reconstruction.intrinsics_px[~reconstruction.generated].double().cpu()
    height, width = reconstruction.depth.shape[1:]
    lens = np.diag([float(captured[:, 0, 0].median()), float(captured[:, 1, 1].median()), 1.0])
    lens[:2, 2] = width / 2, height / 2
    return lens


def _given_pose(
    reconstruction: Reconstruction, held_out: HeldOut, view_id: str, places: Mapping[str, int]
) -> Float[Tensor, "4 4"] | None:
    """The photo's given pose, where the reconstruction kept those of the captured photos."""
    if held_out.given_world_from_cam is None or view_id not in held_out.given:
        return None
    both = [
        (places[other], row)
        for row, other in enumerate(held_out.given)
        if other in places and bool(reconstruction.posed[places[other]])
    ]
    if len(both) < 2:
        return None
    own = reconstruction.world_from_cam[[index for index, _ in both]].double().cpu()
    given = held_out.given_world_from_cam[[row for _, row in both]].double()
    try:
        to_own = align_poses(given, own)
    except ValueError:
        return None  # all from one place: no scale
    moved = to_own.poses(given)
    extent = float((own[:, :3, 3] - own[:, :3, 3].mean(0)).norm(dim=-1).max())
    apart = float((moved[:, :3, 3] - own[:, :3, 3]).norm(dim=-1).max())
    turned = float(rotation_angle_deg(moved[:, :3, :3], own[:, :3, :3]).max())
    if apart > _KEPT_SHARE * extent or turned > _KEPT_DEG:
        return None
    pose = held_out.given_world_from_cam[held_out.given.index(view_id)].double()
    return to_own.poses(pose[None])[0].to(reconstruction.world_from_cam)


def _points(
    reconstruction: Reconstruction,
    ties: Sequence[TiePoints],
    places: Mapping[str, int],
    seen: Mapping[int, SeenView],
) -> tuple[Float[np.ndarray, "point 3"], Float[np.ndarray, "point 2"]]:
    """What captured photos show in common with a held-out one, at the depth that the Gaussians show there."""
    points, pixels = [np.zeros((0, 3))], [np.zeros((0, 2))]
    for tie in ties:
        index = places.get(tie.captured)
        if index is None or index not in seen or not bool(reconstruction.posed[index]):
            continue
        view = seen[index]
        depth, alpha = view.render.depth[0].cpu(), view.render.alpha[0].cpu()
        column, row = tie.captured_xy.floor().long().unbind(-1)
        row, column = row.clamp(0, depth.shape[0] - 1), column.clamp(0, depth.shape[1] - 1)
        there = alpha[row, column] > view.config.coverage_alpha
        lens = reconstruction.intrinsics_px[index].double().cpu().numpy()
        rays = torch.from_numpy(homogeneous_rays(tie.captured_xy[there].double().numpy(), lens))
        in_camera = rays * depth[row, column][there].double()[:, None]
        points.append(transform_points(reconstruction.world_from_cam[index].double().cpu(), in_camera).numpy())
        pixels.append(tie.held_out_xy[there].double().numpy())
    return np.concatenate(points), np.concatenate(pixels)


class Unseen(Measure):
    """Held-out photos at the stored size: all that they show, and what of it the scene covers."""

    metrics = metrics_named(
        "psnr_held_out_db", "ssim_held_out", "st_lpips_held_out", "held_out_covered", "psnr_held_out_covered_db"
    )

    def of_held_out(self, view: UnseenView) -> Values:
        """What the scene does not cover is black in the first three."""
        rgb, alpha = view.render.rgb[0], view.render.alpha[0]
        counted: Bool[Tensor, "height width"] = (
            torch.ones_like(alpha, dtype=torch.bool) if view.valid is None else view.valid
        )
        covered = (alpha > view.config.coverage_alpha) & counted
        like = compare_pictures(rgb, view.picture, view.valid, perceptual=view.config.st_lpips)
        return {
            "psnr_held_out_db": like.psnr_db,
            "ssim_held_out": like.ssim,
            "st_lpips_held_out": like.st_lpips,
            "held_out_covered": float(covered[counted].double().mean()),
            "psnr_held_out_covered_db": (
                min(psnr(rgb, view.picture, covered), PSNR_CAP_DB) if int(covered.sum()) >= FEWEST_PIXELS else None
            ),
        }
