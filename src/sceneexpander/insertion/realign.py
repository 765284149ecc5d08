"""Where the inserted view stands, before the adaptation starts (beyond the paper).

What the geometric front-end says about captured and inserted views together differs from what it said about the captured ones alone: a
generated view takes part in its bundle adjustment and its matching. Here the captured views get back exactly what was known before
the insertion, the inserted view follows by the similarity between the two, and (`Realign.REFINE`) its camera is refined until the captured
scene, seen from it, looks like its picture; its depth follows in scale.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gauge import posed_in_both
from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.rigid import rigid_from_twist, rotation_angle_deg
from sceneexpander.geometry.similarity import align_views

_POINTS = 6000
_BLURS_PX = (6.0, 3.0, 1.5)  # coarse to fine
_STEPS = 12  # Gauss-Newton steps per blur
_COLOUR_SCALE = 0.08  # colour difference beyond which a point counts less and less (Cauchy)
_DIFFERENCE = 1e-3  # of a twist, for derivatives
_FEWEST = 200  # points in frame: with fewer nothing is refined
_OCCLUDED = 1.15  # a captured point this much behind the inserted view's own depth is taken to be hidden


class Realign(StrEnum):
    """What happens to the front-end's estimate before the adaptation: nothing; captured views keep what was known of them before
    the insertion and the inserted one follows; the inserted camera is also refined against the captured scene; or whichever of
    the first two shows the captured photos better."""

    NONE = "none"
    HOLD = "hold"
    REFINE = "refine"
    CHOOSE = "choose"


@dataclass(frozen=True, slots=True, kw_only=True)
class RealignReport:
    """What was done: the camera's turn (degrees) and shift (in median depths) by the refinement, and the colour error around it.

    ``scale`` is the factor on the inserted view's depth. Errors are means of the robust cost over the same points; a refinement
    that does not lower it is not ``accepted`` and changes nothing.
    """

    turned_deg: float
    shifted: float
    scale: float
    error_before: float
    error_after: float
    points: int
    accepted: bool


def realign(
    captured: Priors,
    joint: Priors,
    anchors: Anchors,
    images: Float[Tensor, "captured 3 height width"],
    inserted: Float[Tensor, "3 height width"],
    mode: Realign,
    *,
    generator: torch.Generator,
) -> tuple[Priors, RealignReport | None]:
    """(priors of the captured views as before the insertion, then the realigned inserted one; report of the refinement or None).

    Args:
        captured: priors of the captured views alone.
        joint: priors of the captured views, then the inserted one.
        anchors: the captured views' anchored depth and cameras.
        images, inserted: the pictures.
        mode: how much to do; `Realign.NONE` returns ``joint`` itself. (`Realign.CHOOSE` needs a model: see `Camera`.)
        generator: which points are used.
    """
    if mode is Realign.NONE or captured.world_from_cam is None:
        return joint, None
    held = _held(captured, joint)
    posed = held.posed is None or bool(held.posed[-1])
    if mode is Realign.HOLD or not posed:
        return held, None
    return _refined(held, anchors, images, inserted, generator)


def anchored_depth(captured: Priors, anchors: Anchors) -> Float[Tensor, "captured height width"]:
    """The anchors' depth in the scale of the captured views' priors: a model may have chosen another."""
    if captured.depth is None:
        return anchors.depth
    depth = captured.depth[: len(anchors.depth)]
    known = depth > 0
    return anchors.depth * float((depth[known] / anchors.depth[known]).median()) if bool(known.any()) else anchors.depth


def _parts(priors: Priors) -> tuple[Tensor, Tensor, Tensor]:
    if priors.world_from_cam is None or priors.intrinsics_px is None or priors.depth is None:
        raise ValueError("realignment needs priors with poses, intrinsics and depth")
    return priors.world_from_cam, priors.intrinsics_px, priors.depth


def _held(captured: Priors, joint: Priors) -> Priors:
    """The captured views' priors followed by the inserted view's, brought into their frame and scale.

    Placeholders of cameras take no part in that; if no captured view has a camera on both sides, all do.
    """
    poses, intrinsics, depth = _parts(captured)
    joint_poses, joint_intrinsics, joint_depth = _parts(joint)
    count = len(poses)
    both = posed_in_both(captured, joint, count)
    similarity = align_views(joint_poses[:count], joint_depth[:count], poses, depth, posed=both)
    last_depth = joint_depth[count:] * similarity.scale
    return replace(
        captured,
        world_from_cam=torch.cat([poses, similarity.poses(joint_poses[count:])]),
        intrinsics_px=torch.cat([intrinsics, joint_intrinsics[count:]]),
        depth=torch.cat([depth, last_depth]),
        evidence=None
        if captured.evidence is None or joint.evidence is None
        else torch.cat([captured.evidence, joint.evidence[count:]]),
        posed=None
        if captured.posed is None or joint.posed is None
        else torch.cat([captured.posed, joint.posed[count:]]),
    )


def _refined(
    held: Priors,
    anchors: Anchors,
    images: Float[Tensor, "captured 3 height width"],
    inserted: Float[Tensor, "3 height width"],
    generator: torch.Generator,
) -> tuple[Priors, RealignReport | None]:
    """Direct image alignment of the inserted camera with the captured points, then the scale of its depth."""
    poses, intrinsics, depth = _parts(held)
    count = len(images)
    cameras = Cameras(poses, intrinsics, *images.shape[2:])
    seen = torch.arange(count, device=poses.device)
    if held.posed is not None and bool(held.posed[:count].any()):
        seen = seen[held.posed[:count]]  # where the points of a placeholder are means nothing
    own = anchored_depth(held, anchors)
    points = cameras[seen].unproject(own[seen]).reshape(-1, 3)
    colours = images[seen].movedim(1, -1).reshape(-1, 3)
    chosen = torch.randperm(len(points), generator=generator)[: 4 * _POINTS].to(points.device)
    points, colours = points[chosen], colours[chosen]
    given = cameras[-1]
    there, found = given.look_up(points, depth[-1:, None])
    visible = found.in_frame[0] & (found.depth[0] < there[0, 0] * _OCCLUDED)  # not clearly behind its own depth
    points, colours = points[visible][:_POINTS], colours[visible][:_POINTS]
    if len(points) < _FEWEST:
        return held, None
    camera = given
    before = _cost(points, colours, camera, inserted)
    for blur in _BLURS_PX:
        blurred = _blur_picture(inserted, blur)
        for _ in range(_STEPS):
            camera = _gauss_newton(points, colours, camera, blurred)
    after = _cost(points, colours, camera, inserted)
    accepted = bool(torch.isfinite(camera.world_from_cam).all()) and after < before
    factor = _depth_factor(points, camera, depth[-1]) if accepted else 1.0
    median = float(own.median())
    turn = rotation_angle_deg(camera.world_from_cam[0, :3, :3], poses[-1, :3, :3])
    report = RealignReport(
        turned_deg=float(turn) if accepted else 0.0,
        shifted=float((camera.centres - given.centres).norm()) / median if accepted else 0.0,
        scale=factor,
        error_before=before,
        error_after=after,
        points=len(points),
        accepted=accepted,
    )
    if not accepted:
        return held, report
    moved = replace(
        held,
        world_from_cam=torch.cat([poses[:-1], camera.world_from_cam]),
        depth=torch.cat([depth[:-1], depth[-1:] * factor]),
    )
    return moved, report


def _residual(
    points: Float[Tensor, "point 3"],
    colours: Float[Tensor, "point 3"],
    camera: Cameras,
    picture: Float[Tensor, "3 height width"],
) -> Float[Tensor, "point 3"]:
    """Colour differences, each colour's mean taken out: exposure and colour cast are no misalignment."""
    there, _ = camera.look_up(points, picture[None])
    difference = there[0].T - colours
    return difference - difference.mean(0, keepdim=True)


def _cost(points: Tensor, colours: Tensor, camera: Cameras, picture: Tensor) -> float:
    squared = _residual(points, colours, camera, picture).square().sum(-1) / _COLOUR_SCALE**2
    return float(torch.log1p(squared).mean())


def _gauss_newton(points: Tensor, colours: Tensor, camera: Cameras, picture: Tensor) -> Cameras:
    """One damped step on the six parameters of the camera (a small turn and shift in its own frame)."""

    def residual(twist: Tensor) -> Tensor:
        return _residual(points, colours, _moved(camera, twist), picture).flatten()

    # Central differences: twelve cheap look-ups, and bilinear samples have no forward derivative in torch.
    steps = _DIFFERENCE * torch.eye(6, dtype=points.dtype, device=points.device)
    jacobian = torch.stack([(residual(step) - residual(-step)) / (2 * _DIFFERENCE) for step in steps], dim=1)
    error = residual(torch.zeros_like(steps[0]))
    weight = 1 / (1 + error.square() / _COLOUR_SCALE**2)
    normal = jacobian.T @ (weight[:, None] * jacobian)
    damped = normal + 1e-3 * torch.diag(normal.diagonal().clamp(min=1e-8))
    twist = torch.linalg.solve(damped, -(jacobian.T @ (weight * error)))
    return _moved(camera, twist.clamp(-0.05, 0.05))


def _moved(camera: Cameras, twist: Float[Tensor, "6"]) -> Cameras:
    """The camera after a small rigid motion of the scene in its frame."""
    return replace(camera, world_from_cam=camera.world_from_cam @ rigid_from_twist(-twist))


def _blur_picture(picture: Tensor, sigma: float) -> Tensor:
    """Gaussian blur of a (3,H,W) picture whose border is repeated."""
    from kornia.filters import gaussian_blur2d  # takes as long to import as torch

    size = 2 * (int(3 * sigma) + 1) + 1
    return gaussian_blur2d(picture[None], (size, size), (sigma, sigma), border_type="replicate")[0]


def _depth_factor(points: Float[Tensor, "point 3"], camera: Cameras, depth: Float[Tensor, "height width"]) -> float:
    """Median ratio of the captured points' depth in the inserted camera to its own depth there."""
    there, found = camera.look_up(points, depth[None, None])
    inside = found.in_frame[0]
    if int(inside.sum()) < _FEWEST:
        return 1.0
    return float((found.depth[0] / there[0, 0])[inside].median())
