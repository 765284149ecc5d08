"""What the sparse front-end is given, checked and in the form its steps need: grey images and known cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.errors import UserError
from sceneexpander.frontend.features import grey_u8
from sceneexpander.frontend.sfm_types import REFERENCE_LONG_SIDE_PX, SfmConfig

_MASK_MARGIN_PX = 6  # at 768 px
_SAME_SPOT_PX = 3.0  # at 768 px: keypoints this near to those of an overlay go with them


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """Inputs in the form the steps need."""

    colours: Float[Tensor, "view 3 height width"]  # on the CPU
    greys: list[np.ndarray]
    shown: tuple[np.ndarray | None, ...]  # per view which feature pixels show the place; None: all
    names: tuple[str, ...]
    scale_xy: np.ndarray  # pixels of the given images per pixel of the feature images
    unit_px: float
    seed: int
    remarks: tuple[str, ...] = ()  # what was noticed of given cameras
    overlay: bool = False  # something is drawn over all pictures; ``shown`` leaves it out

    def without(self, spots_xy: np.ndarray) -> Setup:
        """The same with the spots of an overlay not shown."""
        masks = [
            np.ones(grey.shape, bool) if mask is None else mask
            for grey, mask in zip(self.greys, self.shown, strict=True)
        ]
        shown = tuple(without_spots(mask, spots_xy, self.unit_px) for mask in masks)
        return replace(self, shown=shown, overlay=True)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the feature images."""
        height, width = self.greys[0].shape
        return int(height), int(width)

    @property
    def long_side(self) -> int:
        """Longer side of the feature images in pixels."""
        return max(self.size)


def shown_pixels(valid: Tensor | None, greys: Sequence[np.ndarray], unit_px: float) -> tuple[np.ndarray | None, ...]:
    """Per view which feature pixels show the place (None: all), with a margin: the edge of a mask is no corner of the place."""
    if valid is None:
        return (None,) * len(greys)
    height, width = greys[0].shape
    reach = max(1, round(_MASK_MARGIN_PX * unit_px))
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    masks = []
    for mask in valid.cpu().numpy().astype(np.uint8):
        large = cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST)
        masks.append(cv2.erode(large, kernel, borderValue=1).astype(bool))
    return tuple(masks)


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownCameras:
    """Given cameras, in feature pixels; ``posed`` marks the views whose pose was given."""

    intrinsics: np.ndarray | None
    cam_from_world: np.ndarray  # identity where unknown
    posed: np.ndarray


def prepare(
    images: Tensor,
    feature_images: Tensor | None,
    config: SfmConfig,
    generator: torch.Generator,
    names: Sequence[str] | None,
    valid: Tensor | None = None,
) -> Setup:
    """Check shapes, make grey images and draw the seed."""
    if images.ndim != 4 or images.shape[1] != 3 or images.shape[0] < 1:
        raise ValueError(f"images must be (view, 3, height, width) with at least one view, are {tuple(images.shape)}")
    source = images if feature_images is None else feature_images
    if source.ndim != 4 or source.shape[:2] != images.shape[:2]:
        raise ValueError(f"feature_images {tuple(source.shape)} do not belong to images {tuple(images.shape)}")
    labels = tuple(f"view {i}" for i in range(images.shape[0])) if names is None else tuple(names)
    if len(labels) != images.shape[0]:
        raise ValueError(f"{len(labels)} names for {images.shape[0]} views")
    height, width = source.shape[2:]
    # Always one draw, so that the caller's stream does not depend on what was found.
    seed = int(torch.randint(0, 2**30, (1,), generator=generator).item())
    if valid is not None and valid.shape != (images.shape[0], *images.shape[2:]):
        raise ValueError(f"masks {tuple(valid.shape)} do not belong to images {tuple(images.shape)}")
    greys = [grey_u8(image) for image in source.detach().cpu().numpy()]
    return Setup(
        colours=source.detach().cpu(),
        greys=greys,
        shown=shown_pixels(valid, greys, max(height, width) / REFERENCE_LONG_SIDE_PX),
        names=labels,
        scale_xy=np.array([images.shape[3] / width, images.shape[2] / height]),
        unit_px=max(height, width) / REFERENCE_LONG_SIDE_PX,
        seed=seed,
    )


def without_spots(
    shown: Bool[np.ndarray, "height width"], spots_xy: Float[np.ndarray, "spot 2"], unit_px: float
) -> Bool[np.ndarray, "height width"]:
    """A mask with discs cut out around the spots of an overlay."""
    mask = shown.astype(np.uint8)
    radius = max(1, round(_SAME_SPOT_PX * unit_px))
    for x, y in np.unique(np.floor(spots_xy).astype(int), axis=0).tolist():
        cv2.circle(mask, (x, y), radius, 0, -1)
    return mask.astype(bool)


def known_cameras(setup: Setup, intrinsics_px: Tensor | None, world_from_cam: Tensor | None) -> KnownCameras:
    """Validate given cameras and bring them to feature pixels and ``cam_from_world``."""
    views = len(setup.greys)
    intrinsics = None
    if intrinsics_px is not None:
        intrinsics = intrinsics_px.detach().cpu().numpy().astype(np.float64)
        if intrinsics.shape != (views, 3, 3):
            raise ValueError(f"known_intrinsics_px must be ({views}, 3, 3), is {intrinsics.shape}")
        if not np.isfinite(intrinsics).all() or (intrinsics[:, [0, 1], [0, 1]] <= 0).any():
            raise UserError(
                "holds a focal length that is not positive", where="known intrinsics", fix="give pixels > 0"
            )
        intrinsics = intrinsics * np.array([1 / setup.scale_xy[0], 1 / setup.scale_xy[1], 1.0])[:, None]
    cam_from_world = np.tile(np.eye(4), (views, 1, 1))
    posed = np.zeros(views, bool)
    if world_from_cam is not None:
        given = world_from_cam.detach().cpu().numpy().astype(np.float64)
        if given.shape != (views, 4, 4):
            raise ValueError(f"known_world_from_cam must be ({views}, 4, 4), is {given.shape}")
        posed = np.asarray(np.isfinite(given).all((1, 2)))
        for view in np.flatnonzero(posed):
            rotation = given[view, :3, :3]
            if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-2 or np.linalg.det(rotation) < 0:
                raise UserError(
                    "is not a rigid pose",
                    where=f"known pose of {setup.names[view]}",
                    fix="give camera-to-world, OpenCV axes",
                )
            u, _, vt = np.linalg.svd(rotation)  # poses from text files are orthogonal to a few digits only
            cam_from_world[view, :3, :3] = (u @ vt).T
            cam_from_world[view, :3, 3] = -(u @ vt).T @ given[view, :3, 3]
        if posed.sum() == 1:
            posed[:] = False  # one pose alone says nothing: the world frame is the first view's anyway
            cam_from_world[:] = np.eye(4)
    return KnownCameras(intrinsics=intrinsics, cam_from_world=cam_from_world, posed=posed)
