"""Cameras as one value: poses, intrinsics and the size of the pictures that they take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.geometry.camera import resize_intrinsics, unproject_to_world
from sceneexpander.geometry.lookup import grid_of_pixels, sample_at
from sceneexpander.geometry.rigid import rigid_inverse, transform_points
from sceneexpander.geometry.similarity import Similarity

_NEAREST = 1e-6  # depth below which a point has no place in a view


@dataclass(frozen=True, slots=True, kw_only=True)
class Projection:
    """Where points of the world are in the pictures of cameras."""

    grid: Float[Tensor, "camera point 2"]  # for `sample_at`: from -1 to 1 between the outer edges of the frame
    depth: Float[Tensor, "camera point"]  # positive; behind the camera a tiny one
    in_frame: Bool[Tensor, "camera point"]


@dataclass(frozen=True, slots=True)
class Cameras:
    """Pinhole cameras whose pictures have one size.

    Attributes:
        world_from_cam: poses, OpenCV axes.
        intrinsics_px: pixels of pictures of this size, origin at the top-left corner of the top-left pixel.
        height: rows of each picture.
        width: columns of each picture.

    Raises:
        ValueError: poses or intrinsics of another shape, or not the same number of both.
    """

    world_from_cam: Float[Tensor, "camera 4 4"]
    intrinsics_px: Float[Tensor, "camera 3 3"]
    height: int
    width: int

    def __post_init__(self) -> None:
        poses, intrinsics = tuple(self.world_from_cam.shape), tuple(self.intrinsics_px.shape)
        if len(poses) != 3 or poses[1:] != (4, 4):
            raise ValueError(f"world_from_cam has shape {poses}, expected (views, 4, 4)")
        if intrinsics != (poses[0], 3, 3):
            raise ValueError(f"intrinsics_px has shape {intrinsics}, expected {(poses[0], 3, 3)}")

    @property
    def cam_from_world(self) -> Float[Tensor, "camera 4 4"]:
        """Inverse poses."""
        return rigid_inverse(self.world_from_cam)

    @property
    def centres(self) -> Float[Tensor, "camera 3"]:
        """Where the cameras stand, world frame."""
        return self.world_from_cam[:, :3, 3]

    def __len__(self) -> int:
        return len(self.world_from_cam)

    def __getitem__(self, which: int | slice | Sequence[int] | Tensor) -> Cameras:
        """Some of the cameras; a single index gives one camera and not none."""
        if isinstance(which, int):
            which = [which]
        return Cameras(self.world_from_cam[which], self.intrinsics_px[which], self.height, self.width)

    def to(self, device: torch.device | str) -> Cameras:
        """The same on a device."""
        return Cameras(self.world_from_cam.to(device), self.intrinsics_px.to(device), self.height, self.width)

    def double(self) -> Cameras:
        """The same in double precision."""
        return Cameras(self.world_from_cam.double(), self.intrinsics_px.double(), self.height, self.width)

    def followed_by(self, others: Cameras) -> Cameras:
        """These cameras, then others of the same picture size.

        Raises:
            ValueError: another size.
        """
        if (self.height, self.width) != (others.height, others.width):
            raise ValueError(f"cameras of {self.height, self.width} and {others.height, others.width} pixels")
        return Cameras(
            torch.cat([self.world_from_cam, others.world_from_cam]),
            torch.cat([self.intrinsics_px, others.intrinsics_px]),
            self.height,
            self.width,
        )

    def find_repeats(self) -> list[int]:
        """For each camera the index of the first that is the same to the last bit, its own where it is the first."""
        rows = torch.cat([self.world_from_cam.flatten(1), self.intrinsics_px.flatten(1)], 1)
        _, group = torch.unique(rows, dim=0, return_inverse=True)
        first: dict[int, int] = {}
        return [first.setdefault(number, index) for index, number in enumerate(group.tolist())]

    def resized(self, height: int, width: int) -> Cameras:
        """The same cameras with larger or smaller pictures."""
        intrinsics = resize_intrinsics(self.intrinsics_px, width / self.width, height / self.height)
        return Cameras(self.world_from_cam, intrinsics, height, width)

    def brought(self, target_from_world: Similarity) -> Cameras:
        """The same cameras in another frame; the depths that they see change by its scale."""
        return Cameras(target_from_world.poses(self.world_from_cam), self.intrinsics_px, self.height, self.width)

    def project(self, points_world: Float[Tensor, "point 3"]) -> Projection:
        """Where every camera sees every point."""
        points = transform_points(self.cam_from_world, points_world.expand(len(self), -1, -1))
        depth = points[..., 2].clamp(min=_NEAREST)
        pixel = (points @ self.intrinsics_px.transpose(-1, -2))[..., :2] / depth[..., None]
        grid = grid_of_pixels(pixel, self.height, self.width)
        in_frame = (points[..., 2] > _NEAREST) & (grid.abs() < 1).all(-1)
        # Far outside coordinates would overflow the sampler's integers.
        return Projection(grid=grid.clamp(-2, 2), depth=depth, in_frame=in_frame)

    def unproject(self, depth: Float[Tensor, "camera height width"]) -> Float[Tensor, "camera height width 3"]:
        """World points of the pixels' centres at these z-depths."""
        return unproject_to_world(depth, self.intrinsics_px, self.world_from_cam)

    def look_up(
        self,
        points_world: Float[Tensor, "point 3"],
        content: Float[Tensor, "camera channel height width"],
        mode: str = "bilinear",
    ) -> tuple[Float[Tensor, "camera channel point"], Projection]:
        """What maps of the cameras hold where points project; out of frame the border is repeated."""
        found = self.project(points_world)
        return sample_at(content, found.grid, mode), found
