"""What other views say about each pixel's base depth: measured once per pair of views, whatever the pictures show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.lookup import sample_at
from sceneexpander.geometry.normals import viewing_rays
from sceneexpander.geometry.rigid import transform_points

CROSS_VIEW_CHANNELS = 6  # see `PairGeometry.compare`


@dataclass(frozen=True, slots=True, kw_only=True)
class Pairs:
    """One view's points in other views, and the other views' points in it."""

    grid: Float[Tensor, "other point 2"]  # where they project, for `grid_sample`
    in_frame: Bool[Tensor, "other point"]
    behind: Float[Tensor, "other point"]  # log ratio of their depth to what the other view has there, in [-1, 1]
    weight: Float[Tensor, "other point"]  # confidence of what the other view has there, 0 out of frame
    nearest: Float[Tensor, "other point"]  # log depth of the other's nearest confident point in each pixel, or infinite

    @classmethod
    def stacked(cls, parts: Sequence[Pairs]) -> Pairs:
        """Several others as one."""
        return cls(**{f.name: torch.cat([getattr(part, f.name) for part in parts]) for f in fields(cls)})

    def one(self, other: int) -> Pairs:
        """A single other view."""
        return Pairs(**{f.name: getattr(self, f.name)[other : other + 1] for f in fields(self)})


class PairGeometry:
    """Base depths of some views compared with one another; every pair is measured when it is first asked for, and kept.

    Args:
        log_depth: natural logarithm of the base depth, in the poses' scale.
        confident: share of confident pixels.
        cameras: at the resolution of the depth.
        posed: views whose pose is only a placeholder take no part.
    """

    def __init__(
        self,
        log_depth: Float[Tensor, "view height width"],
        confident: Float[Tensor, "view height width"],
        cameras: Cameras,
        posed: Bool[Tensor, "view"],
    ) -> None:
        points_cam = viewing_rays(cameras.intrinsics_px, cameras.height, cameras.width) * log_depth.exp()[..., None]
        self.points_world = transform_points(cameras.world_from_cam, points_cam.flatten(1, 2))
        self.cameras = cameras
        self.content = torch.stack([log_depth, confident], dim=1)
        self.posed: list[bool] = posed.tolist()
        centres = cameras.centres
        self.distances = (centres[:, None] - centres).square().sum(-1).tolist()
        self._known: dict[tuple[int, int], Pairs] = {}

    def neighbours(self, view: int, views: Sequence[int], most: int) -> list[int]:
        """Those of ``views`` that ``view`` is compared with: at most ``most``, nearest cameras first."""
        others = [other for other in views if other != view and self.posed[other]]
        if not self.posed[view]:
            return []
        return sorted(others, key=lambda other: self.distances[view][other])[:most]

    def pairs(self, view: int, others: Sequence[int]) -> Pairs:
        """The comparison of one view with others."""
        missing = [other for other in others if (view, other) not in self._known]
        if missing:
            found = self._measure(view, missing)
            for index, other in enumerate(missing):
                self._known[view, other] = found.one(index)
        return Pairs.stacked([self._known[view, other] for other in others])

    def _measure(self, view: int, others: Sequence[int]) -> Pairs:
        chosen = torch.tensor(others, device=self.points_world.device)
        seen, found = self.cameras[chosen].look_up(self.points_world[view], self.content[chosen])
        nearest = [
            splat_log_depth(
                self.points_world[other][self.content[other, 1].flatten() > 0.5], self.cameras[view]
            ).flatten()
            for other in others
        ]
        return Pairs(
            grid=found.grid,
            in_frame=found.in_frame,
            behind=(found.depth.log() - seen[:, 0]).clamp(-1, 1),
            weight=seen[:, 1] * found.in_frame,
            nearest=torch.stack(nearest),
        )

    def compare(
        self, images: Float[Tensor, "chosen 3 height width"], views: Sequence[int], *, most_views: int
    ) -> Float[Tensor, "chosen 6 height width"]:
        """What the other posed views say about each pixel's base depth; zeros where none says anything.

        Channels: (0) smallest colour difference to any other view at the reprojection; (1) share of the other views that
        have the point in frame; (2) how far behind, (3) how far in front of confident surfaces of other views it lies (mean
        log ratio over them); (4) log of the nearest confident surface of other views seen in this pixel / base depth; (5)
        whether there is one.

        Args:
            images: RGB of ``views``, at the resolution of the depth.
            views: which of the views take part.
            most_views: each view is compared with this many others at most, those with the nearest cameras.
        """
        height, width = self.content.shape[-2:]
        out = images.new_zeros(len(views), CROSS_VIEW_CHANNELS, height * width)
        place = {view: index for index, view in enumerate(views)}
        for index, view in enumerate(views):
            others = self.neighbours(view, views, most_views)
            if not others:
                continue
            pairs = self.pairs(view, others)
            seen = sample_at(images[[place[other] for other in others]], pairs.grid)
            colour = (seen - images[index].flatten(1)).abs().mean(1)
            out[index, 0] = torch.where(pairs.in_frame, colour, 1.0).amin(0) * pairs.in_frame.any(0)
            out[index, 1] = pairs.in_frame.float().mean(0)
            total = pairs.weight.sum(0).clamp(min=0.5)
            out[index, 2] = (pairs.weight * pairs.behind.clamp(min=0)).sum(0) / total
            out[index, 3] = (pairs.weight * (-pairs.behind).clamp(min=0)).sum(0) / total
            nearest = pairs.nearest.amin(0)
            found = nearest.isfinite()
            out[index, 4] = torch.where(found, (nearest - self.content[view, 0].flatten()).clamp(-1, 1), 0.0)
            out[index, 5] = found.float()
        return torch.unflatten(out, -1, (height, width))


def splat_log_depth(points_world: Float[Tensor, "point 3"], camera: Cameras) -> Float[Tensor, "height width"]:
    """Log depth of the nearest point that falls in each pixel of one camera, infinite where there is none."""
    height, width = camera.height, camera.width
    points = transform_points(camera.cam_from_world[0], points_world)
    depth = points[:, 2]
    pixel = (points @ camera.intrinsics_px[0].T)[:, :2] / depth.clamp(min=1e-6)[:, None]
    column, row = pixel.floor().long().unbind(-1)
    kept = (depth > 1e-6) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    nearest = depth.new_full((height * width,), torch.inf)
    index = (row * width + column)[kept]
    return nearest.scatter_reduce(0, index, depth[kept].log(), reduce="amin").view(height, width)
