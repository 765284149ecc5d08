"""Reconstructors of others, given the same pictures as ours: one pass over all views, the inserted one last, nothing adapted.

Each runs at its own working resolution and multiple of pixels. The stored pictures are resized for it, never cropped, and what it predicts
is brought back to the stored grid; so all methods are evaluated on the same picture area at one size, each in its own gauge. The
resizing may change the aspect by half a patch (at most 2 % at the released resolutions).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.unavailable import Unavailable
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.errors import UserError
from sceneexpander.geometry.camera import camera_vector_from_pose, resize_intrinsics
from sceneexpander.geometry.priors import Priors
from sceneexpander.inference.artefact import as_reconstruction
from sceneexpander.inference.config import NEEDS_CHECKPOINT, RivalConfig
from sceneexpander.models.derived import with_depth
from sceneexpander.models.protocol import Head, Prediction, Reconstructor, as_module
from sceneexpander.models.registry import build_reconstructor

EDGE = 1.05  # ratio of depths in a 3 x 3 window above which nothing is interpolated across it


def reconstruct_rival(
    method: str, config: RivalConfig, views: ViewSet, priors: Priors, *, device: str = "cpu"
) -> Reconstruction | Unavailable:
    """What a rival makes of the views, or why there is nothing.

    Args:
        method: name of the rival, which is also that of its reconstructor.
        config: its section.
        views: all views, the inserted one last.
        priors: the geometric front-end's estimate; read only with ``priors=front_end``.
        device: where it runs.

    Raises:
        UserError: weights that are missing or do not fit, or priors that were asked for and do not exist.
    """
    if config.weights is None:
        return Unavailable(method=method, model=method, reason=NEEDS_CHECKPOINT)
    given = Priors()
    if config.priors == "front_end":
        if priors.world_from_cam is None:
            raise UserError(
                "the front-end did not run", where=f"rivals.{method}.priors", fix="use model.priors=front_end"
            )
        if priors.posed is not None and not bool(priors.posed[0]):
            return Unavailable(method=method, model=method, reason="needs a known camera of the first view as prior")
        given = priors
    built = build_reconstructor(
        method, variant=config.variant, weights=config.weights, allow_download=config.allow_download
    )
    as_module(built.model).to(device)
    return rival_reconstruction(
        built.model,
        views,
        given,
        method=method,
        weights_sha256=built.weights.sha256,
        long_side_px=config.long_side_px,
        device=device,
    )


@torch.no_grad()
def rival_reconstruction(
    model: Reconstructor,
    views: ViewSet,
    priors: Priors,
    *,
    method: str,
    weights_sha256: str,
    long_side_px: int,
    device: str = "cpu",
) -> Reconstruction:
    """Run a reconstructor at its own resolution and bring what it predicts to the stored one."""
    size = working_size(views.height, views.width, long_side_px, model.size_multiple)
    source = views.detail_images if max(size) > max(views.height, views.width) else views.images
    prediction = model.predict(
        resized_pictures(source, *size).to(device),
        resized_priors(priors, *size).to(device),
        heads=frozenset({Head.CAMERA, Head.DEPTH}),
    )
    stored = at_stored_size(prediction, views.images.to(device), views.generated.to(device))
    return as_reconstruction(stored, views, Priors(), method=method, model=model.name, weights_sha256=weights_sha256)


def working_size(height: int, width: int, long_side_px: int, multiple: int) -> tuple[int, int]:
    """(rows, columns) nearest to the picture's shape with that long side, in whole multiples."""
    scale = long_side_px / max(height, width)
    rows, columns = (max(1, round(side * scale / multiple)) * multiple for side in (height, width))
    return rows, columns


def resized_pictures(
    images: Float[Tensor, "view 3 height width"], height: int, width: int
) -> Float[Tensor, "view 3 new_height new_width"]:
    """Bicubic with antialiasing, in [0, 1]."""
    if tuple(images.shape[-2:]) == (height, width):
        return images
    return functional.interpolate(images, size=(height, width), mode="bicubic", antialias=True).clamp(0, 1)


def resized_priors(priors: Priors, height: int, width: int) -> Priors:
    """Priors of the stored pictures for pictures of another size; evidence is left out."""
    depth, intrinsics = priors.depth, priors.intrinsics_px
    if depth is None:
        return replace(priors, evidence=None)
    old_height, old_width = depth.shape[-2:]
    if intrinsics is not None:
        intrinsics = resize_intrinsics(intrinsics, width / old_width, height / old_height)
    # Zero means missing and must not be mixed with its neighbours.
    nearest = functional.interpolate(depth[:, None], size=(height, width), mode="nearest-exact")[:, 0]
    return replace(priors, depth=nearest, intrinsics_px=intrinsics, evidence=None)


def at_stored_size(
    prediction: Prediction, images: Float[Tensor, "view 3 height width"], generated: Tensor
) -> Prediction:
    """A prediction of cameras and depth on the grid of the stored pictures, with normals and Gaussians made there."""
    if prediction.depth is None or prediction.depth_conf is None:
        raise ValueError("a rival must predict depth and its confidence")
    height, width = images.shape[-2:]
    rows, columns = prediction.depth.shape[-2:]
    intrinsics = resize_intrinsics(prediction.intrinsics_px, width / columns, height / rows)
    whole = replace(
        prediction,
        intrinsics_px=intrinsics,
        camera_vector=camera_vector_from_pose(prediction.world_from_cam, intrinsics, height, width),
    )
    depth = resized_depth(prediction.depth, height, width)
    conf = functional.interpolate(prediction.depth_conf[:, None], size=(height, width), mode="nearest-exact")[:, 0]
    heads = frozenset({Head.DEPTH, Head.NORMALS, Head.GAUSSIANS})
    return with_depth(whole, depth, conf, images=images, heads=heads, generated=generated)


def resized_depth(
    depth: Float[Tensor, "view height width"], height: int, width: int
) -> Float[Tensor, "view new_height new_width"]:
    """z-depth (> 0) on another grid: linear in its inverse, which is exact on planes; nearest across edges, which have no middle."""
    if tuple(depth.shape[-2:]) == (height, width):
        return depth
    padded = functional.pad(depth[:, None], (1, 1, 1, 1), mode="replicate")
    ratio = functional.max_pool2d(padded, 3, stride=1) * functional.max_pool2d(1 / padded, 3, stride=1)

    def nearest(plane: Tensor) -> Tensor:
        return functional.interpolate(plane, size=(height, width), mode="nearest-exact")[:, 0]

    smooth = 1 / functional.interpolate(1 / depth[:, None], size=(height, width), mode="bilinear")[:, 0]
    return torch.where(nearest(ratio) > EDGE, nearest(depth[:, None]), smooth)
