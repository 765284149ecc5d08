"""How an inserted picture goes with the scene so far: its camera, and where the scene from there agrees, contradicts it, or ends.

A requested object that stands in front of photographed surfaces counts as a contradiction, too: no photo shows it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.artifacts.agreement import MisalignmentReport
from sceneexpander.frontend.bundle import LOG_FOCAL
from sceneexpander.frontend.resection import ResectedView, Sighting, resect
from sceneexpander.generation.protocol import SceneSoFar
from sceneexpander.generation.registration import Registration, photo_points, register
from sceneexpander.ingest.fit import FittedPicture
from sceneexpander.ingest.load import image_tensor
from sceneexpander.splatting.render import render

SAME_COLOUR = 0.12  # mean absolute RGB difference of cells that show the same; predicted scenes are off by half of it
_CELL_PX = 4  # cells are compared with their neighbours, too: what is off by as much is displaced, not another thing
_SEEN = 0.5  # of what covers a pixel
_FEWEST_CELLS = 12
_STRETCHES = np.linspace(-0.12, 0.12, 13)
_CLEARLY = 0.03  # of the matches' cost: less is no reason for another lens
_FIXED = 1e-4  # of the logarithm: a focal that does not move
_INLIERS_FOR_STRETCH = 40  # one more unknown wants more points than a camera alone
_TINTS = {"contradicted": (0.9, 0.1, 0.1), "new": (0.15, 0.35, 0.95)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Misaligned:
    """The report, its map (1: nothing contradicts the pixel, 0: the scene shows something else), and a picture to look at.

    ``overlay``: the inserted picture; the scene from its camera; the first tinted red where they contradict, blue where it is new. Map and
    overlay are None without a camera.
    """

    report: MisalignmentReport
    support: Float[Tensor, "height width"] | None = None
    overlay: Float[Tensor, "3 overlay_height overlay_width"] | None = None


@torch.no_grad()
def report_misalignment(picture: FittedPicture, so_far: SceneSoFar, *, seed: int) -> Misaligned:
    """Pose a fitted picture against the scene so far and compare."""
    registered, stretch = explain_matches(register(picture, photo_points(so_far), so_far, seed=seed))
    if registered.found is None:
        return Misaligned(report=MisalignmentReport(inliers=registered.inliers, matches=registered.matched))
    found = registered.found
    views = so_far.views
    camera = registered.camera(found, views.height, views.width)
    seen = render(so_far.reconstruction.gaussians, camera)
    own, cover = image_tensor(picture.image), seen.alpha[0] >= _SEEN
    scene = (seen.rgb[0] / seen.alpha[0].clamp(min=_SEEN)).clamp(0, 1)
    gains = tone_gains(own, scene, cover)
    wrong = find_contradicted(own, (scene * gains[:, None, None]).clamp(0, 1), cover)
    report = MisalignmentReport(
        inliers=registered.inliers,
        matches=registered.matched,
        reprojection_px=float(np.median(registered.errors_px(found)[found.inlier])),
        world_from_cam=tuple(tuple(row) for row in camera.world_from_cam[0].tolist()),
        focal_factor=float(np.exp(found.lens[LOG_FOCAL])),
        stretch=stretch,
        gains=tuple(gains.tolist()),
        supported=float((cover & ~wrong).float().mean()),
        contradicted=float(wrong.float().mean()),
        new=float((~cover).float().mean()),
    )
    tinted = own.clone()
    for name, where in (("contradicted", wrong), ("new", ~cover)):
        tint = torch.tensor(_TINTS[name])[:, None, None]
        tinted = torch.where(where, 0.5 * own + 0.5 * tint, tinted)
    overlay = torch.cat([own, seen.rgb[0].clamp(0, 1), tinted], dim=-1)
    return Misaligned(report=report, support=(~wrong).float(), overlay=overlay)


def tone_gains(
    own: Float[Tensor, "3 height width"], scene: Float[Tensor, "3 height width"], cover: Bool[Tensor, "height width"]
) -> Float[Tensor, "3"]:
    """By what the scene's colours are multiplied to have the picture's exposure and white balance: median ratio of pixels that both show.

    Of ratios, not the ratio of medians: an object that only one of them shows must not change the tone of the rest.
    """
    if int(cover.sum()) < _FEWEST_CELLS * _CELL_PX**2:
        return torch.ones(3)
    return (own[:, cover] / scene[:, cover].clamp(min=1e-3)).median(1).values.clamp(0.25, 4)


def find_contradicted(
    own: Float[Tensor, "3 height width"], scene: Float[Tensor, "3 height width"], cover: Bool[Tensor, "height width"]
) -> Bool[Tensor, "height width"]:
    """Where the scene shows something else than the picture: cells whose colour no neighbouring cell of the scene has.

    Single cells are no evidence: a cell counts with the majority of those around it.
    """
    height, width = cover.shape
    size = height // _CELL_PX, width // _CELL_PX
    pool = torch.nn.functional.adaptive_avg_pool2d
    mine, theirs, seen = pool(own, size), pool(scene * cover, size), pool(cover[None].float(), size)
    inside = seen > 0.5
    theirs = torch.where(inside, theirs / seen.clamp(min=0.5), torch.inf)
    around = torch.nn.functional.pad(theirs, (1, 1, 1, 1), value=torch.inf)
    shifted = torch.stack(
        [around[:, y : y + size[0], x : x + size[1]] for y in range(3) for x in range(3)]
    )  # (9, 3, row, column)
    off = (shifted - mine).abs().mean(1).amin(0)
    wrong = (inside[0] & (off > SAME_COLOUR)).numpy().astype(np.uint8)
    kept = torch.from_numpy(cv2.medianBlur(wrong, 3)).float()[None, None]
    return (torch.nn.functional.interpolate(kept, size=(height, width), mode="nearest")[0, 0] > 0.5) & cover


def explain_matches(registered: Registration) -> tuple[Registration, float | None]:
    """(the registration through the lens that explains the matches without more freedom than they ask for, the stretch).

    The photos' own focal length is kept unless another one explains clearly more: before a wall focal and distance are one. The stretch is
    how much wider the picture is than a camera would draw it, at the same height: the focal across is tried with factors on the one down,
    and what leaves least unexplained of all matches tells. None with too few points.
    """
    found = registered.found
    if found is None:
        return registered, None
    sighting = registered.sighting
    fixed = replace(sighting, log_focal_low=-_FIXED, log_focal_high=_FIXED)
    photos_own = resect(fixed, [0.0])
    if photos_own is not None and photos_own.cost <= found.cost + _CLEARLY:
        sighting, found = fixed, photos_own
    if int(found.inlier.sum()) < _INLIERS_FOR_STRETCH:
        return _through(registered, sighting, found), None
    focal = float(found.lens[LOG_FOCAL])
    # Posed anew each time: the pose found without a stretch has bent itself to it.
    tried = [resect(_stretched(sighting, stretch), [focal]) for stretch in _STRETCHES]
    stretch = _lowest(_STRETCHES, np.array([np.inf if view is None else view.cost for view in tried]))
    wider = _stretched(sighting, stretch)
    refound = resect(wider, [focal])
    if refound is not None and refound.cost < found.cost - _CLEARLY:
        return _through(registered, wider, refound), stretch
    return _through(registered, sighting, found), 0.0


def _stretched(sighting: Sighting, stretch: float) -> Sighting:
    start = sighting.start.copy()
    start[0, 0] *= 1 + stretch
    return replace(sighting, start=start)


def _through(registered: Registration, sighting: Sighting, found: ResectedView) -> Registration:
    return replace(registered, sighting=sighting, found=found, inliers=int(found.inlier.sum()))


def _lowest(places: Float[np.ndarray, " place"], costs: Float[np.ndarray, " place"]) -> float:
    """Where a sampled curve is lowest, between its samples: of the parabola through the lowest three."""
    best = int(costs.argmin())
    if best in (0, len(costs) - 1) or not np.isfinite(costs[best - 1 : best + 2]).all():
        return float(places[best])
    before, here, after = costs[best - 1 : best + 2]
    bend = before + after - 2 * here
    step = 0.5 * (before - after) / bend if bend > 1e-12 else 0.0
    return float(places[best] + step * (places[1] - places[0]))
