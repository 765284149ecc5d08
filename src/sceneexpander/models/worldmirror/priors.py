"""Prior prompting: what is known about the views, normalised and encoded as tokens (worldmirror spec 5)."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sceneexpander.models.layers.block import Mlp
from sceneexpander.models.layers.quaternion import quat_xyzw_from_matrix

FAR = 1e6  # what infinities become
MANY_VIEWS = 10  # above this, the extent of the cameras is measured by quantiles
MANY_DEPTHS = 100  # above this, the range of a depth map is measured by quantiles


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchPriors:
    """Priors of B scenes of S views; whatever is None is not used.

    Poses are used raw: the network was trained with the first view at the identity. ``posed`` says which poses are real; a view
    without one gets the same zero token as when the prior is off, and does not count for the extent of the cameras.
    """

    world_from_cam: Float[Tensor, "batch view 4 4"] | None = None
    depth: Float[Tensor, "batch view depth_height depth_width"] | None = None
    intrinsics_px: Float[Tensor, "batch view 3 3"] | None = None
    posed: Bool[Tensor, "batch view"] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class NormalisedPriors:
    """Priors as the encoders see them; None where a prior is off."""

    pose: Float[Tensor, "batch view 7"] | None = None
    depth: Float[Tensor, "batch view height width"] | None = None
    ray: Float[Tensor, "batch view 4"] | None = None
    posed: Bool[Tensor, "batch view"] | None = None

    def select(self, views: slice) -> NormalisedPriors:
        """Some of the views, still normalised over all of them."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{name: None if value is None else value[:, views] for name, value in values.items()})


def normalise_priors(priors: BatchPriors, height: int, width: int) -> NormalisedPriors:
    """Normalise all given priors for images of ``height x width`` pixels."""
    pose = None if priors.world_from_cam is None else pose_vector(priors.world_from_cam, priors.posed)
    depth = None if priors.depth is None else normalised_depth(priors.depth, height, width)
    ray = None if priors.intrinsics_px is None else ray_vector(priors.intrinsics_px, height, width)
    return NormalisedPriors(pose=pose, depth=depth, ray=ray, posed=priors.posed)


def pose_vector(
    world_from_cam: Float[Tensor, "batch view 4 4"], posed: Bool[Tensor, "batch view"] | None = None
) -> Float[Tensor, "batch view 7"]:
    """``[translation in the unit cube, quaternion xyzw]`` of camera-to-world poses (worldmirror spec 5.1)."""
    pose = torch.nan_to_num(world_from_cam, nan=0.0, posinf=FAR, neginf=-FAR)
    translation = pose[..., :3, 3]
    scaled = []
    for index, cameras in enumerate(translation):
        known = cameras if posed is None or not bool(posed[index].any()) else cameras[posed[index]]
        low, high = _camera_extent(known)
        extent = torch.maximum(high - low, (high.abs() * 1e-6).clamp(min=1e-6))
        scale = extent.max().clamp(1e-6, 1e6) / 0.8
        scaled.append(((cameras - (low + high) / 2) / scale + 0.5).clamp(0, 1))
    return torch.cat([torch.stack(scaled), quat_xyzw_from_matrix(pose[..., :3, :3])], dim=-1)


def _camera_extent(cameras: Float[Tensor, "view 3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    if cameras.shape[0] <= MANY_VIEWS:
        return cameras.amin(0), cameras.amax(0)
    return torch.quantile(cameras, 0.05, dim=0), torch.quantile(cameras, 0.95, dim=0)


def normalised_depth(
    depth: Float[Tensor, "batch view depth_height depth_width"], height: int, width: int
) -> Float[Tensor, "batch view height width"]:
    """Depth maps at image size, each scaled to [0, 1] by its own range; missing pixels are 0 (worldmirror spec 5.2)."""
    if depth.shape[-2:] != (height, width):
        depth = F.interpolate(depth, size=(height, width), mode="bilinear", align_corners=False)
    depth = torch.nan_to_num(depth, nan=0.0, posinf=FAR, neginf=0.0)
    views = [_unit_range(view) for view in depth.flatten(0, 1)]
    return torch.stack(views).view(depth.shape)


def _unit_range(depth: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    known = depth[depth > 0]
    if known.numel() == 0:
        known = depth.flatten()
    if known.numel() > MANY_DEPTHS:
        low, high = torch.quantile(known, 0.01), torch.quantile(known, 0.99)
    else:
        low, high = known.amin(), known.amax()
    high = torch.where(high == low, low + 1, high)
    margin = ((high - low).abs() * 1e-6).clamp(min=1e-6)
    return ((depth - low) / (high - low + margin)).clamp(0, 1)


def ray_vector(
    intrinsics_px: Float[Tensor, "batch view 3 3"], height: int, width: int
) -> Float[Tensor, "batch view 4"]:
    """``[fx/W, fy/H, cx/W, cy/H]`` (worldmirror spec 5.3)."""
    fx, fy = intrinsics_px[..., 0, 0], intrinsics_px[..., 1, 1]
    cx, cy = intrinsics_px[..., 0, 2], intrinsics_px[..., 1, 2]
    return torch.stack([fx / width, fy / height, cx / width, cy / height], dim=-1)


class DepthEmbed(nn.Module):
    """Patches of a depth map -> tokens that are added to the patch tokens."""

    def __init__(self, patch: int, dim: int) -> None:
        super().__init__()
        self.patch = patch
        # The index 2 is the place of the MLP in the released sequential (unshuffle, permute, MLP, permute).
        self.proj = nn.ModuleDict({"2": Mlp(patch * patch, 4 * dim, dim)})

    def forward(self, depth: Float[Tensor, "batch view height width"]) -> Float[Tensor, "batch view patch dim"]:
        patches = F.pixel_unshuffle(depth[:, :, None], self.patch)
        return self.proj["2"](patches.flatten(3).transpose(2, 3))


def vector_encoder(inputs: int, dim: int) -> nn.Sequential:
    """Linear, SiLU, Linear: the encoder of the pose and of the ray vector."""
    return nn.Sequential(nn.Linear(inputs, dim), nn.SiLU(), nn.Linear(dim, dim))
