"""What every viewer needs to know about a reconstruction's cameras, and where several reconstructions of one place meet."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.geometry.similarity import Similarity, align_poses
from sceneexpander.geometry.trajectory import focus_depth, mean_up

_FRUSTUM_SHARE = 0.35  # length of a drawn frustum, share of the distance between neighbouring cameras
_FRUSTUM_LIMITS = (0.02, 0.12)  # of the distance to what is seen, so that it neither vanishes nor fills the picture


@dataclass(frozen=True, slots=True, kw_only=True)
class ShownCameras:
    """The cameras of a reconstruction, in its own world frame (OpenCV axes, scene units)."""

    view_ids: tuple[str, ...]
    generated: Bool[Tensor, " view"]
    posed: Bool[Tensor, " view"]
    world_from_cam: Float[Tensor, "view 4 4"]
    intrinsics_px: Float[Tensor, "view 3 3"]
    focus: Float[Tensor, " view"]  # median z-depth around the middle of the view, what one turns around
    height: int
    width: int

    @classmethod
    def of(cls, reconstruction: Reconstruction) -> ShownCameras:
        """The cameras of a reconstruction."""
        height, width = reconstruction.depth.shape[1:]
        return cls(
            view_ids=reconstruction.view_ids,
            generated=reconstruction.generated,
            posed=reconstruction.posed,
            world_from_cam=reconstruction.world_from_cam,
            intrinsics_px=reconstruction.intrinsics_px,
            focus=focus_depth(reconstruction.depth),
            height=height,
            width=width,
        )

    def captured(self) -> list[int]:
        """Indices of the captured views whose cameras were really estimated; all views if there are none."""
        real = (self.posed & ~self.generated).nonzero()[:, 0].tolist()
        return real or list(range(len(self.view_ids)))

    def transformed(self, target_from_source: Similarity) -> ShownCameras:
        """The same cameras in another frame."""
        return ShownCameras(
            view_ids=self.view_ids,
            generated=self.generated,
            posed=self.posed,
            world_from_cam=target_from_source.poses(self.world_from_cam),
            intrinsics_px=self.intrinsics_px,
            focus=self.focus * target_from_source.scale,
            height=self.height,
            width=self.width,
        )


def up_direction(cameras: ShownCameras) -> Float[Tensor, 3]:
    """Where up is, as a unit vector of the world frame, by the captured cameras."""
    return mean_up(cameras.world_from_cam[cameras.captured()])


def frustum_length(cameras: ShownCameras) -> float:
    """How long to draw a camera, scene units: neighbours stay apart, and none hides the scene."""
    posed = cameras.posed.nonzero()[:, 0].tolist() or [0]
    low, high = (share * float(cameras.focus[posed].median()) for share in _FRUSTUM_LIMITS)
    centres = cameras.world_from_cam[posed, :3, 3]
    if len(posed) < 2:
        return high
    apart = torch.cdist(centres, centres).fill_diagonal_(torch.inf).min(1).values.median()
    return min(max(_FRUSTUM_SHARE * float(apart), low), high)


def alignment(source: ShownCameras, target: ShownCameras) -> Similarity:
    """``target_from_source`` by the captured cameras that both have; the identity if they share none.

    Methods reconstruct one place each in its own gauge (scale and frame drift a little). Brought together, a switch between them shows
    what differs in the scene, not that its camera jumped.
    """
    place = {target.view_ids[i]: i for i in target.captured()}
    pairs = [(i, place[source.view_ids[i]]) for i in source.captured() if source.view_ids[i] in place]
    if pairs:
        poses_s, poses_t = (
            source.world_from_cam[[i for i, _ in pairs]],
            target.world_from_cam[[i for _, i in pairs]],
        )
        if not torch.equal(poses_s, poses_t):
            try:
                return align_poses(poses_s, poses_t)
            except ValueError:  # one camera, or all in one place: nothing tells the scale
                return align_poses(poses_s, poses_t, scale=1.0)
    return Similarity(scale=1.0, rotation=torch.eye(3), translation=torch.zeros(3))
