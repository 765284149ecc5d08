"""An entry against the truth: cameras, depth, normals, surfaces and pictures, in what was captured and in what was expanded.

One similarity brings the entry into the truth's frame: that of its captured cameras (`align_poses`: rotation by the views' orientations,
scale and place by least squares on their centres). Nothing else is fitted, neither per view nor per region.

The captured region is what the photographs show. The expanded region is what the consistent inserted picture shows and no photograph does,
seen from the intended camera and from two that no method is given. Surfaces that are in neither take no part, nor does the sky.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from sceneexpander.catalogue import Group, Metric, Region, Scope, Views
from sceneexpander.evaluation.image import WINDOW, ssim_map
from sceneexpander.expandbench.dataset import (
    CAPTURED_VIEWS,
    HELD_OUT,
    INTENDED,
    Seen,
    TrueDetail,
    TrueScene,
    grid_of,
)
from sceneexpander.expandbench.entries import Entry
from sceneexpander.expandbench.scenes import CAPTURED, VIEWS
from sceneexpander.geometry.camera import unproject_to_world
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.normals import normals_from_depth
from sceneexpander.geometry.rigid import rotation_angle_deg
from sceneexpander.geometry.similarity import Similarity, align_poses
from sceneexpander.splatting import render

COVERED = 0.5  # alpha from which on a pixel counts as drawn
BEST_PSNR_DB = 60.0  # more is not told apart in pictures of 8 bits
SMOOTHING = 2  # of normals, which are those of the depth for every entry
FLAT_DEG = 5.0  # where the true depth's own normal is off by more (edges, thin things), normals are not compared
GEOMETRY_VIEWS = {Seen.CAPTURED: CAPTURED_VIEWS, Seen.EXPANDED: VIEWS[CAPTURED:]}


def _metric(name: str, title: str, group: Group, better: str, *, unit: str = "", digits: int = 2) -> Metric:
    new = name.startswith(("expanded", "held_out_expanded", "inserted"))
    scope = Scope(
        views=Views.HELD_OUT if name.startswith("held_out") else Views.INSERTED if new else Views.CAPTURED,
        region=Region.NEW if new and not name.startswith("inserted") else Region.ALL,
    )
    return Metric(name=name, group=group, title=title, scope=scope, unit=unit, digits=digits, better=better)  # type: ignore[arg-type]


GEOMETRY = (
    _metric("captured_placed", "placed, captured", Group.GEOMETRY, "higher", unit="%", digits=0),
    _metric("captured_rotation_deg", "rotation, captured", Group.GEOMETRY, "lower", unit="°"),
    _metric("captured_centre_rel", "centre, captured", Group.GEOMETRY, "lower", unit="%"),
    _metric("inserted_rotation_deg", "rotation, inserted", Group.GEOMETRY, "lower", unit="°"),
    _metric("inserted_centre_rel", "centre, inserted", Group.GEOMETRY, "lower", unit="%"),
    _metric("captured_depth_abs_rel", "depth, captured", Group.GEOMETRY, "lower", unit="%"),
    _metric("expanded_depth_abs_rel", "depth, expanded", Group.GEOMETRY, "lower", unit="%"),
    _metric("captured_drawn", "drawn, captured", Group.GEOMETRY, "higher", unit="%", digits=1),
    _metric("expanded_drawn", "drawn, expanded", Group.GEOMETRY, "higher", unit="%", digits=1),
    _metric("captured_normal_deg", "normals, captured", Group.GEOMETRY, "lower", unit="°", digits=1),
    _metric("expanded_normal_deg", "normals, expanded", Group.GEOMETRY, "lower", unit="°", digits=1),
    _metric("captured_chamfer_rel", "chamfer, captured", Group.GEOMETRY, "lower", unit="%"),
    _metric("expanded_chamfer_rel", "chamfer, expanded", Group.GEOMETRY, "lower", unit="%"),
)
RENDERING = (
    _metric("captured_psnr_db", "PSNR, captured, given", Group.QUALITY, "higher", unit="dB"),
    _metric("held_out_captured_psnr_db", "PSNR, captured, held out", Group.QUALITY, "higher", unit="dB"),
    _metric("expanded_psnr_db", "PSNR, expanded, given", Group.QUALITY, "higher", unit="dB"),
    _metric("held_out_expanded_psnr_db", "PSNR, expanded, held out", Group.QUALITY, "higher", unit="dB"),
    _metric("captured_ssim", "SSIM, captured, given", Group.QUALITY, "higher", digits=3),
    _metric("held_out_captured_ssim", "SSIM, captured, held out", Group.QUALITY, "higher", digits=3),
    _metric("expanded_ssim", "SSIM, expanded, given", Group.QUALITY, "higher", digits=3),
    _metric("held_out_expanded_ssim", "SSIM, expanded, held out", Group.QUALITY, "higher", digits=3),
)
METRICS = (*GEOMETRY, *RENDERING)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Look:
    """What an entry shows at a true camera, lengths in metres of the truth. ``depth`` is 0 where nothing is drawn."""

    picture: Float[Tensor, "3 height width"] | None
    depth: Float[Tensor, "height width"] | None


def align_entry(entry: Entry, truth: TrueScene) -> Similarity:
    """From the entry's world to the truth's, by the captured cameras that have a place.

    Raises:
        ValueError: they do not determine it.
    """
    if int(entry.posed.sum()) < 2:
        raise ValueError(f"{int(entry.posed.sum())} of {CAPTURED} captured cameras placed, two are needed")
    return align_poses(entry.captured[entry.posed], truth.captured_poses[entry.posed])


def score(entry: Entry, truth: TrueScene) -> dict[str, float]:
    """Numbers by the names of `METRICS`; those are left out for which the entry has not all that they need.

    - ``captured_placed``: share of the photographs that have a place;
    - rotations and centres: mean over the captured cameras with a place, and of the inserted picture's camera against the *intended* one;
      centres in shares of the scene's size (median depth of the photographs);
    - ``depth_abs_rel``: mean |d - d*| / d* over the drawn pixels of a region, ``drawn`` their share;
    - ``normal_deg``: mean angle between normals of the depth and the true ones, away from edges;
    - ``chamfer_rel``: mean distance from the entry's visible surface points to the true ones and back, in shares of the scene's size,
      each cut at 1; nothing drawn counts 1;
    - PSNR (one mean square over a region, at most 60 dB) and SSIM: at the captured and the intended cameras ("given": methods had a
      picture from there or nearby) and at cameras that no method is given ("held out").

    Raises:
        ValueError: the captured cameras do not determine the similarity.
    """
    truth_from_entry = align_entry(entry, truth)
    looks = _look(entry, truth, truth_from_entry)
    found = _camera_errors(entry, truth, truth_from_entry)
    for region, names in GEOMETRY_VIEWS.items():
        views = [(looks[name], truth.views[name]) for name in names]
        if all(look.depth is not None for look, _ in views):
            found |= _geometry(views, region, truth.size_m)
    for prefix, region, names in (
        ("captured", Seen.CAPTURED, CAPTURED_VIEWS),
        ("held_out_captured", Seen.CAPTURED, HELD_OUT),
        ("expanded", Seen.EXPANDED, (INTENDED,)),
        ("held_out_expanded", Seen.EXPANDED, HELD_OUT),
    ):
        pictures = [(looks[name].picture, truth.views[name]) for name in names]
        whole = [(picture, view) for picture, view in pictures if picture is not None]
        if len(whole) == len(pictures):
            found |= _rendering(whole, region, prefix)
    return found


def _look(entry: Entry, truth: TrueScene, truth_from_entry: Similarity) -> dict[str, _Look]:
    if entry.gaussians is None:
        scale = truth_from_entry.scale
        depths = {name: depth * scale for name, depth in entry.depths.items()}
        return {name: _Look(picture=entry.renders.get(name), depth=depths.get(name)) for name in VIEWS}
    entry_from_truth = truth_from_entry.inverse()
    looks = {}
    for name, view in truth.views.items():
        pose = entry_from_truth.poses(view.world_from_cam[None]).float()
        seen = render(entry.gaussians, Cameras(pose, view.intrinsics_px[None].float(), *view.depth.shape))
        depth = torch.where(seen.alpha[0] > COVERED, seen.depth[0] * truth_from_entry.scale, 0.0)
        looks[name] = _Look(picture=seen.rgb[0].clamp(0, 1), depth=depth)
    return looks


def _camera_errors(entry: Entry, truth: TrueScene, truth_from_entry: Similarity) -> dict[str, float]:
    def errors(estimated: Tensor, true: Tensor) -> tuple[float, float]:
        placed = truth_from_entry.poses(estimated)
        turned = rotation_angle_deg(placed[:, :3, :3], true[:, :3, :3])
        away = (placed[:, :3, 3] - true[:, :3, 3]).norm(dim=-1) / truth.size_m
        return float(turned.mean()), float(away.mean())

    rotation, centre = errors(entry.captured[entry.posed], truth.captured_poses[entry.posed])
    found = {"captured_placed": float(entry.posed.double().mean())}
    found |= {"captured_rotation_deg": rotation, "captured_centre_rel": centre}
    if entry.inserted is not None:
        rotation, centre = errors(entry.inserted[None], truth.views[INTENDED].world_from_cam[None])
        found |= {"inserted_rotation_deg": rotation, "inserted_centre_rel": centre}
    return found


def _geometry(views: Sequence[tuple[_Look, TrueDetail]], region: Seen, size_m: float) -> dict[str, float]:
    errors, angles, own, true = [], [], [], []
    pixels = 0
    for look, view in views:
        assert look.depth is not None  # noqa: S101 - the caller has looked
        inside = view.seen == region
        drawn = inside & (look.depth > 0)
        pixels += int(inside.sum())
        errors.append(((look.depth - view.depth).abs() / view.depth)[drawn])
        angles.append(_normal_errors(look.depth, view, inside))
        grid = grid_of(region, view)
        own.append(_points(look.depth, view, grid & drawn))
        true.append(_points(view.depth, view, grid))
    prefix = region.name.lower()
    depth, angle = torch.cat(errors).double(), torch.cat(angles).double()
    found: dict[str, float] = {}
    if pixels:
        found[f"{prefix}_drawn"] = len(depth) / pixels
        found[f"{prefix}_chamfer_rel"] = chamfer(torch.cat(own), torch.cat(true), size_m)
    if len(depth):
        found[f"{prefix}_depth_abs_rel"] = float(depth.mean())
    if len(angle):
        found[f"{prefix}_normal_deg"] = float(angle.mean())
    return found


def _points(depth: Tensor, view: TrueDetail, where: Tensor) -> Float[Tensor, "point 3"]:
    return unproject_to_world(depth.double(), view.intrinsics_px, view.world_from_cam)[where]


def chamfer(own: Float[Tensor, "point 3"], true: Float[Tensor, "other 3"], size: float) -> float:
    """Mean of the mean nearest distances in both directions, in shares of ``size``, each distance cut at 1; 1 if either is empty."""
    if not len(own) or not len(true):
        return 1.0
    first, second = own.numpy(), true.numpy()
    there, back = cKDTree(second).query(first)[0], cKDTree(first).query(second)[0]
    return float(np.minimum(there / size, 1).mean() + np.minimum(back / size, 1).mean()) / 2


def _normal_errors(
    depth: Float[Tensor, "height width"], view: TrueDetail, inside: Bool[Tensor, "height width"]
) -> Float[Tensor, "pixel"]:
    """Angles in degrees at the pixels of ``inside`` whose surroundings are drawn, and flat in the truth."""
    reach = SMOOTHING + 1
    around = [_all_around(plane > 0, reach) for plane in (depth, view.depth)]
    flat = _angles(_normals(view.depth, view), view.normals) < FLAT_DEG
    keep = inside & around[0] & around[1] & flat
    return _angles(_normals(depth, view), view.normals)[keep]


def _normals(depth: Tensor, view: TrueDetail) -> Tensor:
    # Pixels without a surface get one far behind all others; those near them are not looked at.
    filled = torch.where(depth > 0, depth, depth.max() + 1)
    return normals_from_depth(filled[None], view.intrinsics_px[None].float(), smoothing=SMOOTHING)[0]


def _angles(first: Tensor, second: Tensor) -> Tensor:
    across = torch.linalg.cross(first, second, dim=-1).norm(dim=-1)
    return torch.rad2deg(torch.atan2(across, (first * second).sum(-1)))


def _all_around(mask: Bool[Tensor, "height width"], reach: int) -> Bool[Tensor, "height width"]:
    """Pixels all of whose neighbours within ``reach`` are in the mask."""
    window = 2 * reach + 1
    gaps = torch.nn.functional.max_pool2d((~mask)[None, None].float(), window, stride=1, padding=reach)
    return gaps[0, 0] == 0


def _rendering(pictures: Sequence[tuple[Tensor, TrueDetail]], region: Seen, prefix: str) -> Mapping[str, float]:
    squares, similar = [], []
    margin = WINDOW // 2
    for picture, view in pictures:
        inside = view.seen == region
        squares.append(((picture.double() - view.image.double()) ** 2)[:, inside].flatten())
        centres = inside[margin:-margin, margin:-margin]
        if bool(centres.any()):
            similar.append(ssim_map(picture, view.image)[:, centres].flatten())
    found = {}
    together = torch.cat(squares)
    if len(together):
        error = float(together.mean())
        best = 10 ** (-BEST_PSNR_DB / 10)
        found[f"{prefix}_psnr_db"] = -10 * math.log10(max(error, best))
    if similar:
        found[f"{prefix}_ssim"] = float(torch.cat(similar).mean())
    return found
