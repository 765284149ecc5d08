"""Taking photos out of a scene before anything is made of it, so that results can be measured on pictures that nothing has seen.

They are chosen here, once the photos are known to be different pictures of one size; of them nothing but that size and that they are no
copies takes part in anything.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch

from sceneexpander.artifacts.held_out import HeldOut
from sceneexpander.artifacts.scene import KnownCameras, Scene
from sceneexpander.errors import UserError, printable

AUTO_FROM = 5  # photos from which ``auto`` holds one out
_FEWEST_LEFT = 2


def choose_held_out(photos: int, wanted: int | Literal["auto"]) -> tuple[int, ...]:
    """Which photos are held out: evenly spread over their order, never the first, which is the scene's frame of reference.

    Args:
        photos: how many there are.
        wanted: how many to hold out; ``auto``: one of five or more, else none.

    Raises:
        UserError: fewer than two would be left.
    """
    count = int(photos >= AUTO_FROM) if wanted == "auto" else wanted
    if count and photos - count < _FEWEST_LEFT:
        raise UserError(
            f"is {count}, but the scene has {photos} photos and needs {_FEWEST_LEFT} to be made from",
            where="evaluate.hold_out",
            fix="hold fewer out, or add photos",
        )
    return tuple(1 + (2 * place + 1) * (photos - 1) // (2 * count) for place in range(count))


def hold_out(scene: Scene, wanted: int | Literal["auto"]) -> tuple[Scene, HeldOut]:
    """The scene without its held-out photos, which its notes name, and those. Raises as `choose_held_out`."""
    chosen = choose_held_out(len(scene.views), wanted)
    if not chosen:
        return scene, HeldOut()
    kept = [view for view in range(len(scene.views)) if view not in chosen]
    names = ", ".join(printable(scene.views.records[view].name) for view in chosen)
    given, poses = _given_poses(scene)
    return replace(
        scene,
        views=scene.views.select(kept),
        known=None if scene.known is None else _rows(scene.known, kept),
        notes=(*scene.notes, f"{names}: held out to measure results on, used for nothing else (evaluate.hold_out)"),
    ), HeldOut(views=scene.views.select(chosen), given=given, given_world_from_cam=poses)


def _given_poses(scene: Scene) -> tuple[tuple[str, ...], torch.Tensor | None]:
    """Ids and poses, in the capture's own world, of the photos that came with one."""
    known = scene.known
    if known is None or known.world_from_cam is None or known.capture_from_world is None:
        return (), None
    posed = torch.isfinite(known.world_from_cam).all(-1).all(-1)
    own = torch.tensor(known.capture_from_world, dtype=torch.float64)
    ids = tuple(view for view, has in zip(scene.views.view_ids, posed.tolist(), strict=True) if has)
    return ids, own @ known.world_from_cam[posed].double()


def _rows(known: KnownCameras, kept: list[int]) -> KnownCameras | None:
    """Of some photos: poses in the frame of the first of them that has one."""
    poses, intrinsics, depth = (
        None if value is None else value[kept] for value in (known.world_from_cam, known.intrinsics_px, known.depth)
    )
    capture_from_world = known.capture_from_world
    if poses is not None:
        posed = torch.isfinite(poses).all(-1).all(-1).nonzero()
        if len(posed):
            first = poses[int(posed[0])].double()
            poses = torch.linalg.solve(first, poses.double()).to(poses)
            if capture_from_world is not None:
                own = torch.tensor(capture_from_world, dtype=torch.float64) @ first
                capture_from_world = tuple(tuple(row) for row in own.tolist())
        else:
            poses = capture_from_world = None
    if intrinsics is not None and not torch.isfinite(intrinsics).any():
        intrinsics = None
    if poses is None and intrinsics is None and depth is None:
        return None
    return replace(
        known, world_from_cam=poses, intrinsics_px=intrinsics, depth=depth, capture_from_world=capture_from_world
    )
