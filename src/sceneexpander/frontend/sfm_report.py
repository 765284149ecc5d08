"""From a finished mapping to the result other rooms see: view 0's frame, unit scale, pixels of the given images, report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from sceneexpander.frontend.bundle import LOG_FOCAL, SHIFT_X, SHIFT_Y
from sceneexpander.frontend.distortion import Distortion
from sceneexpander.frontend.evidence import ViewEvidence
from sceneexpander.frontend.features import Features
from sceneexpander.frontend.lenses import LensPlan
from sceneexpander.frontend.mapping import Mapping
from sceneexpander.frontend.placement import Placement
from sceneexpander.frontend.sfm_types import FocalSource, PairReport, SfmReport, SparseReconstruction, ViewReport
from sceneexpander.frontend.sparse_points import SparsePoints

_WORTH_SAYING = 0.03  # of the long side: a principal point nearer to the centre than this is like any other
_HINT_REJECTED = 0.15  # of the logarithm of the focal


def build_reconstruction(
    mapping: Mapping,
    placed: dict[int, Placement],
    features: Sequence[Features],
    pairs: tuple[PairReport, ...],
    focal_source: FocalSource,
    names: Sequence[str],
    scale_xy: np.ndarray,
    *,
    distortion: Distortion | None,
    plan: LensPlan,
    evidence: dict[int, ViewEvidence],
    doubts: dict[int, str],
    unrelated: int | None,
    notes: tuple[str, ...],
) -> SparseReconstruction:
    """Change frame, scale and pixels; write the report.

    Args:
        mapping: finished model; every view has some pose in it.
        placed: how the views outside the adjusted model were posed.
        features: of all views.
        pairs: for the report.
        focal_source: for the report.
        names: of the views.
        scale_xy: pixels of the given images per pixel of the feature images.
        distortion: what the features' pixels were straightened by.
        plan: which views share a lens, and what their files say.
        evidence: of views that the model adjusted.
        doubts: why a posed view is only roughly right.
        notes: about the set, from its matches.
        unrelated: the view that is the frame of reference and nothing else, since no other could be placed by it.
    """
    world_from_cam, points, scale = _normalised(mapping)
    rows, views = np.nonzero(mapping.active & mapping.registered)
    used = np.flatnonzero(mapping.valid)
    position = np.full(mapping.tracks.count, -1)
    position[used] = np.arange(len(used))
    sparse = SparsePoints(
        points_world=torch.from_numpy(points[used].astype(np.float32)),
        view_index=torch.from_numpy(views.astype(np.int64)),
        point_index=torch.from_numpy(position[rows].astype(np.int64)),
        pixel_xy=torch.from_numpy((mapping.tracks.pixel_xy[rows, views] * scale_xy).astype(np.float32)),
    )
    intrinsics = mapping.intrinsics * np.array([scale_xy[0], scale_xy[1], 1.0])[:, None]
    posed = mapping.registered.copy()
    for view, how in placed.items():
        posed[view] = how.loose
    errors = np.where(mapping.active & mapping.registered, mapping.errors_px(), np.nan) * float(scale_xy.mean())
    angles = mapping.angles_deg()[used]
    report = SfmReport(
        views=tuple(
            _view_report(
                v,
                names[v],
                mapping,
                placed.get(v),
                features,
                errors,
                distortion,
                plan,
                focal_source,
                evidence.get(v),
                doubts.get(v, ""),
                related=v != unrelated,
            )
            for v in range(len(names))
        ),
        pairs=pairs,
        focal_px=float(intrinsics[0, 0, 0]),
        focal_ratio=float(mapping.intrinsics[0, 0, 0] / mapping.shift_unit_px[0, 0]),
        focal_source=focal_source,
        focal_sigma=float(mapping.lens_sigma[mapping.lens_of[0], LOG_FOCAL]),
        points=len(used),
        median_angle_deg=float(np.median(angles)) if len(used) else float("nan"),
        mean_error_px=float(np.nanmean(errors)) if len(rows) else float("nan"),
        scale=scale,
        notes=(*notes, *_notes(mapping, focal_source)),
    )
    return SparseReconstruction(
        world_from_cam=torch.from_numpy(world_from_cam.astype(np.float32)),
        intrinsics_px=torch.from_numpy(intrinsics.astype(np.float32)),
        posed=torch.from_numpy(posed),
        sparse=sparse,
        distortion=None if distortion is None else distortion.scaled(scale_xy),
        report=report,
    )


def _normalised(mapping: Mapping) -> tuple[np.ndarray, np.ndarray, float]:
    """(world_from_cam, points, scale): view 0's camera frame, median depth of the points it sees 1."""
    first_rotation, first_translation = mapping.rotations[0], mapping.translations[0]
    points = mapping.points @ first_rotation.T + first_translation
    rotations = mapping.rotations @ first_rotation.T  # cam_from_view0
    translations = mapping.translations - rotations @ first_translation
    depths = [
        (points[rows] @ rotations[view].T + translations[view])[:, 2]
        for view in np.flatnonzero(mapping.registered)
        if len(rows := np.flatnonzero(mapping.active[:, view] & mapping.valid))
    ]
    seen_first = np.flatnonzero(mapping.active[:, 0] & mapping.valid & mapping.registered[0])
    scale = 1.0
    if len(seen_first):
        scale = 1.0 / float(np.median(points[seen_first, 2]))
    elif depths:
        scale = 1.0 / float(np.median(np.concatenate(depths)))
    world_from_cam = np.tile(np.eye(4), (len(rotations), 1, 1))
    world_from_cam[:, :3, :3] = rotations.transpose(0, 2, 1)
    world_from_cam[:, :3, 3] = -np.einsum("vji,vj->vi", rotations, translations) * scale
    world_from_cam[0] = np.eye(4)  # exactly, not to rounding
    return world_from_cam, points * scale, scale


def _view_report(
    view: int,
    name: str,
    mapping: Mapping,
    placement: Placement | None,
    features: Sequence[Features],
    errors: np.ndarray,
    distortion: Distortion | None,
    plan: LensPlan,
    focal_source: FocalSource,
    evidence: ViewEvidence | None,
    doubt: str,
    *,
    related: bool,
) -> ViewReport:
    """One line of the report."""
    inliers = int((mapping.active[:, view] & mapping.valid).sum()) if mapping.registered[view] else 0
    lens = mapping.lenses.resolved[mapping.lens_of[view]]
    shift = (float(lens[SHIFT_X]), float(lens[SHIFT_Y]))
    k = (0.0, 0.0) if distortion is None else (float(distortion.k[view, 0]), float(distortion.k[view, 1]))
    shared = mapping.lenses.focal_of[mapping.lens_of[view]] == mapping.lens_of[mapping.main]
    ratio = float(mapping.intrinsics[view, 0, 0] / mapping.shift_unit_px[view, 0])
    return ViewReport(
        view=view,
        name=name,
        registered=related and (placement is None or placement.loose),
        loose=(placement is not None and placement.loose) or bool(doubt),
        reason=doubt if placement is None else placement.reason,
        features=features[view].count,
        inliers=inliers if placement is None else placement.inliers,
        mean_error_px=float(np.nanmean(errors[:, view])) if inliers else float("nan"),
        placed_like=None if placement is None else placement.like,
        focal_ratio=ratio,
        focal_source=focal_source if shared else _own_source(mapping, view, plan),
        distortion=k,
        centre_shift=shift,
        warnings=_view_warnings(mapping, view, ratio, shift, shared=bool(shared), plan=plan),
        agreeing=float("nan") if evidence is None else evidence.agreeing,
        rotation_gap_deg=float("nan") if evidence is None else evidence.rotation_gap_deg,
        direction_sigma_deg=float("nan") if evidence is None else evidence.direction_sigma_deg,
    )


def _own_source(mapping: Mapping, view: int, plan: LensPlan) -> FocalSource:
    """Where the focal of a lens beside the main one came from."""
    if mapping.registered[view]:
        return FocalSource.REFINED
    return FocalSource.HINT if np.isfinite(plan.focal_hints[plan.lens_of[view]]) else FocalSource.ASSUMED


def _view_warnings(
    mapping: Mapping, view: int, ratio: float, shift: tuple[float, float], *, shared: bool, plan: LensPlan
) -> tuple[str, ...]:
    """What is odd about a view that the model adjusted."""
    if not mapping.registered[view] or plan.generated[view]:
        return ()
    said = []
    main_ratio = float(mapping.intrinsics[mapping.main, 0, 0] / mapping.shift_unit_px[mapping.main, 0])
    if not shared and plan.lens_of[view] == plan.main:
        said.append(
            f"its focal length is {ratio / main_ratio:.2f} times that of the others, as far as the pictures tell"
        )
    if max(abs(shift[0]), abs(shift[1])) > _WORTH_SAYING:
        said.append(
            f"it was cropped: the optical axis lies {shift[0]:+.0%}, {shift[1]:+.0%} of the long side off the centre"
        )
    hint = float(plan.focal_hints[plan.lens_of[view]])
    if np.isfinite(hint) and abs(np.log(ratio / hint)) > _HINT_REJECTED:
        said.append(
            f"its file says a focal length of {_in_mm(hint):.0f} mm (35 mm equivalent), the pictures say {_in_mm(ratio):.0f} mm:"
            " the pictures are believed"
        )
    elif np.isfinite(hint) and shared and mapping.rival_log_focal is not None:
        rival = ratio * float(np.exp(mapping.rival_log_focal - mapping.log_focal[mapping.main]))
        said.append(
            f"its file says a focal length of {_in_mm(hint):.0f} mm (35 mm equivalent), the pictures go better with"
            f" {_in_mm(rival):.0f} mm: the file is believed"
        )
    return tuple(said)


def _in_mm(ratio: float) -> float:
    """35 mm equivalent of a focal over the long side, for pictures of 4:3 (the equivalent is by the diagonal)."""
    return ratio * float(np.hypot(36.0, 24.0)) / 1.25


def _notes(mapping: Mapping, source: FocalSource) -> tuple[str, ...]:
    """What a person should know about the whole set."""
    notes = []
    if not mapping.valid.any():
        notes.append("no point could be triangulated: the views share no matches with parallax")
    if source is FocalSource.SWEPT:
        notes.append("the focal is the best of a few plausible values: too few views to refine it")
    if source is FocalSource.HINT:
        notes.append("the focal is the one that the files say: too few views to check it, and directions depend on it")
    if source is FocalSource.LINES:
        notes.append("the focal is the one that straight lines in the pictures agree on: too few views to refine it")
    if source is FocalSource.TURNED:
        notes.append("the focal is the one at which the camera only turned: without parallax there is no depth")
    if source is FocalSource.ASSUMED:
        notes.append("the focal is assumed: there is too little parallax to estimate it from")
    return tuple(notes)
