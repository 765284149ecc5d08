"""Whether a candidate view can be inserted at all, told before anything is adapted (beyond the paper).

The paper chooses candidates by eye, and shows one severe inconsistency that its adaptation could not mend. What can be measured
without truth: whether the front-end found a camera for the candidate, how much of it overlaps with the captured views, whether its
depth and its colours agree with them there, and how far it moved the captured cameras when everything was estimated together.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.geometry.agreement import agreement
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gauge import posed_in_both, poses_relative_to
from sceneexpander.geometry.lookup import sample_at
from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.rigid import rotation_angle_deg
from sceneexpander.insertion.protocol import RoundInputs
from sceneexpander.insertion.realign import Realign, anchored_depth, realign


@dataclass(frozen=True, slots=True, kw_only=True)
class AcceptanceLimits:
    """Beyond which a candidate is refused. Set by hand; docs/ablation.md says how well they tell."""

    min_overlap: float = 0.05
    max_depth_conflict: float = 0.12
    max_colour_conflict: float = 0.16
    max_cameras_moved_deg: float = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Acceptance:
    """What was measured, and why the candidate is refused (empty: it is accepted).

    ``overlap``: share of its pixels that a captured view sees, too. Over those: ``depth_conflict``, the median absolute log ratio of
    its depth and the captured one; ``colour_conflict``, the median absolute colour difference, each channel's mean difference taken
    out. ``cameras_moved_deg``: largest turn of a captured camera by its presence. None where there is nothing to measure.
    """

    posed: bool
    overlap: float
    depth_conflict: float | None
    colour_conflict: float | None
    cameras_moved_deg: float
    reasons: tuple[str, ...]

    @property
    def accepted(self) -> bool:
        """Whether nothing speaks against it."""
        return not self.reasons


def judge_round(inputs: RoundInputs) -> Acceptance | None:
    """Whether the inserted view of a round fits the scene, see `judge_candidate`; None if the front-end did not run for it."""
    priors = inputs.joint_priors
    if priors.world_from_cam is None or priors.intrinsics_px is None or priors.depth is None:
        return None
    return judge_candidate(
        inputs.state.priors,
        priors,
        inputs.anchors,
        inputs.state.views.images,
        inputs.inserted.view.images[0],
        AcceptanceLimits(),
    )


@torch.no_grad()
def judge_candidate(
    captured: Priors,
    joint: Priors,
    anchors: Anchors,
    images: Float[Tensor, "captured 3 height width"],
    inserted: Float[Tensor, "3 height width"],
    limits: AcceptanceLimits,
) -> Acceptance:
    """Judge the view that ``joint`` has beyond ``captured``. Both need poses, intrinsics and depth; ``inserted`` is its picture."""
    held, _ = realign(captured, joint, anchors, images, inserted, Realign.HOLD, generator=torch.Generator())
    poses, intrinsics, depth = held.world_from_cam, held.intrinsics_px, held.depth
    before, after = captured.world_from_cam, joint.world_from_cam
    if poses is None or intrinsics is None or depth is None or before is None or after is None:
        raise ValueError("a candidate can only be judged where the front-end has run")
    count = len(images)
    posed = held.posed is None or bool(held.posed[-1])
    both = posed_in_both(captured, joint, count)
    cameras = Cameras(poses, intrinsics, *images.shape[2:])
    points = cameras[-1].unproject(depth[-1:])[0]
    photos = torch.arange(count, device=poses.device)
    if captured.posed is not None and bool(captured.posed.any()):
        photos = photos[captured.posed]
    found = agreement(points, anchored_depth(captured, anchors)[photos], cameras[photos])
    overlap = float(found.seen.float().mean())
    depth_conflict = float(found.conflict[found.seen].abs().median()) if posed and bool(found.seen.any()) else None
    colour_conflict = (
        _colour_conflict(points[found.seen], cameras[photos], images[photos], inserted[:, found.seen])
        if posed
        else None
    )
    measured = Acceptance(
        posed=posed,
        overlap=overlap,
        depth_conflict=depth_conflict,
        colour_conflict=colour_conflict,
        cameras_moved_deg=_turned_deg(before[both], after[:count][both]),
        reasons=(),
    )
    return Acceptance(
        posed=posed,
        overlap=overlap,
        depth_conflict=depth_conflict,
        colour_conflict=colour_conflict,
        cameras_moved_deg=measured.cameras_moved_deg,
        reasons=tuple(_reasons(measured, limits)),
    )


@torch.no_grad()
def captured_moved(
    anchors: Anchors,
    depth: Float[Tensor, "captured height width"],
    posed: Bool[Tensor, "captured"] | None = None,
) -> float:
    """How far the insertion moves what the model says of the captured views: mean |log ratio| of depth to anchored depth.

    This is what Algorithm 1 can repair, since its anchors are the depth before the insertion.

    Args:
        anchors: of the captured views.
        depth: what the unadapted model predicts for them beside the inserted view, in the same gauge.
        posed: views whose camera is an estimate; the others take no part, unless there is nothing else.
    """
    change = (depth / anchors.depth).log().abs().mean((-2, -1))
    return float((change[posed] if posed is not None and bool(posed.any()) else change).mean())


def _turned_deg(before: Tensor, after: Tensor) -> float:
    """Largest turn of a camera against the first of them; of fewer than two nothing is known."""
    if len(before) < 2:
        return 0.0
    was, now = poses_relative_to(before, 0), poses_relative_to(after, 0)
    return float(rotation_angle_deg(now[:, :3, :3], was[:, :3, :3]).max())


def _colour_conflict(
    points: Float[Tensor, "point 3"],
    captured: Cameras,
    images: Float[Tensor, "view 3 height width"],
    own: Float[Tensor, "3 point"],
) -> float | None:
    """Median over points of the inserted view of the colour difference to the captured view that fits best there."""
    if not len(points):
        return None
    best = torch.full_like(own[0], torch.inf)
    found = captured.project(points)
    for picture, grid, inside in zip(images, found.grid, found.in_frame, strict=True):
        if not bool(inside.any()):
            continue
        difference = sample_at(picture[None], grid[None])[0] - own
        difference = difference - difference[:, inside].mean(1, keepdim=True)
        best = torch.where(inside, torch.minimum(best, difference.abs().mean(0)), best)
    known = best[best.isfinite()]
    return float(known.median()) if len(known) else None


def _reasons(measured: Acceptance, limits: AcceptanceLimits) -> list[str]:
    found = []
    if not measured.posed:
        found.append("no camera could be found for it")
    if measured.overlap < limits.min_overlap:
        found.append(f"only {measured.overlap:.0%} of it overlap with the captured views")
    if measured.depth_conflict is not None and measured.depth_conflict > limits.max_depth_conflict:
        found.append(f"its depth contradicts the captured views (by {measured.depth_conflict:.0%})")
    if measured.colour_conflict is not None and measured.colour_conflict > limits.max_colour_conflict:
        found.append(f"its colours contradict the captured views (by {measured.colour_conflict:.2f})")
    if measured.cameras_moved_deg > limits.max_cameras_moved_deg:
        found.append(f"it turns a captured camera by {measured.cameras_moved_deg:.1f} degrees")
    return found
