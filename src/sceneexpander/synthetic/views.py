"""Ready-made training and test samples: a few views of a random world, with exact truth."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.rigid import rigid_inverse
from sceneexpander.synthetic.degrade import auto_exposure, encode_radiance
from sceneexpander.synthetic.degrade import degrade as degrade_images
from sceneexpander.synthetic.render import render_world
from sceneexpander.synthetic.scenes import build_world, draw_kind
from sceneexpander.synthetic.textures import Split
from sceneexpander.synthetic.trajectories import CameraSet, choose_cameras
from sceneexpander.synthetic.world import World

DISCONNECTED_SHARE = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class SyntheticViews:
    """Views of a procedural scene, in the first view's camera frame (``world_from_cam[0]`` is the identity); metres.

    Attributes:
        images: RGB in [0,1].
        depth: z-depth at pixel centres; +inf for sky.
        valid: where there is a surface (depth finite).
        normals: camera frame, unit, facing the camera; 0 where not valid.
        world_from_cam: camera poses.
        intrinsics_px: in pixels of the images.
        object_id: which object each pixel shows, -1 for sky (numbers are per scene).
        kind: scene kind. seed: what it was made from. split: which textures it uses.
        disconnected: index of the view that shares nothing with the others, or None.
    """

    images: Float[Tensor, "view 3 height width"]
    depth: Float[Tensor, "view height width"]
    valid: Bool[Tensor, "view height width"]
    normals: Float[Tensor, "view height width 3"]
    world_from_cam: Float[Tensor, "view 4 4"]
    intrinsics_px: Float[Tensor, "view 3 3"]
    object_id: Int[Tensor, "view height width"]
    kind: str
    seed: int
    split: Split = "train"
    disconnected: int | None = None

    @property
    def cameras(self) -> Cameras:
        """Of all views."""
        height, width = self.images.shape[-2:]
        return Cameras(self.world_from_cam, self.intrinsics_px, height, width)


def _stream(seed: int, split: str, purpose: str, attempt: int = 0) -> np.random.Generator:
    """One random stream per purpose, so that a new draw in one place never shifts another."""
    return np.random.default_rng([seed, attempt, zlib.crc32(f"{split}:{purpose}".encode())])


def make_scene(
    seed: int, *, views: int, height: int, width: int, kind: str | None = None, split: Split = "train"
) -> tuple[World, CameraSet]:
    """The world and the cameras of `make_views`, unrendered."""
    for attempt in range(50):
        generator = _stream(seed, split, "world", attempt)
        world = build_world(generator, kind or draw_kind(generator), split=split)
        cameras_rng = _stream(seed, split, "cameras", attempt)
        lonely = bool(cameras_rng.random() < DISCONNECTED_SHARE)
        cameras = choose_cameras(world, views, height, width, cameras_rng, disconnected=lonely)
        if cameras is not None:
            return world, cameras
    raise ValueError(f"no camera set with {views} overlapping views found for seed {seed}, kind {kind}")


def make_views(
    seed: int,
    *,
    views: int,
    height: int,
    width: int,
    kind: str | None = None,
    supersample: float = 1.6,
    degrade: bool = True,
    split: Split = "train",
) -> SyntheticViews:
    """A deterministic sample: the same arguments give the same bits.

    Args:
        seed: any non-negative integer.
        views, height, width: how many pictures of which size.
        kind: one of `scenes.KINDS`; None draws one.
        supersample: colour samples per pixel side.
        degrade: photograph-like exposure, blur, noise and JPEG; without it colours agree between views.
        split: "test" uses textures (and worlds) that training never sees.

    Raises:
        ValueError: unknown kind, or no set of that many overlapping views in 50 worlds.
    """
    world, chosen = make_scene(seed, views=views, height=height, width=width, kind=kind, split=split)
    rendered = render_world(world, chosen.cameras, supersample=supersample, seed=seed)
    images = encode_radiance(rendered.radiance, auto_exposure(rendered.radiance)).transpose(0, 3, 1, 2)
    if degrade:
        images = degrade_images(images, _stream(seed, split, "degrade"))
    world_from_cam = chosen.cameras.world_from_cam
    relative = rigid_inverse(world_from_cam[:1]) @ world_from_cam
    relative[0] = torch.eye(4, dtype=relative.dtype)
    depth = torch.from_numpy(rendered.depth)
    return SyntheticViews(
        images=torch.from_numpy(np.ascontiguousarray(images)),
        depth=depth,
        valid=torch.isfinite(depth),
        normals=torch.from_numpy(rendered.normals),
        world_from_cam=relative.float(),
        intrinsics_px=chosen.cameras.intrinsics_px.float(),
        object_id=torch.from_numpy(rendered.object_id.astype(np.int64)),
        kind=world.kind,
        seed=seed,
        split=split,
        disconnected=chosen.disconnected,
    )
