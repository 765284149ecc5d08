"""From a prediction in memory to the artefact on disk."""

from __future__ import annotations

import logging

import torch
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.errors import UserError
from sceneexpander.geometry.gaussians import GaussianCounts
from sceneexpander.geometry.priors import Priors
from sceneexpander.models.protocol import Prediction

_log = logging.getLogger(__name__)


def as_reconstruction(
    prediction: Prediction, views: ViewSet, priors: Priors, *, method: str, model: str, weights_sha256: str
) -> Reconstruction:
    """A prediction with all heads, on the CPU. Cameras count as estimated unless ``priors`` say that a pose was a placeholder.

    Raises:
        ValueError: an output is missing.
        UserError: an output is not finite.
    """
    parts = {
        name: getattr(prediction, name) for name in ("depth", "depth_conf", "normals", "normals_conf", "gaussians")
    }
    missing = [name for name, value in parts.items() if value is None]
    if missing:
        raise ValueError(f"{model} gave no {', '.join(missing)}")
    _require_finite(prediction, views, method=method, model=model)
    kept = len(parts["gaussians"])
    counts = prediction.gaussian_counts or GaussianCounts(made=kept, kept=kept)
    _log.info("%s: %s", method, counts.line())
    posed = torch.ones(len(views), dtype=torch.bool) if priors.posed is None else priors.posed
    return Reconstruction(
        method=method,
        model=model,
        weights_sha256=weights_sha256,
        view_ids=views.view_ids,
        generated=views.generated,
        posed=posed.cpu(),
        camera_vector=prediction.camera_vector.cpu(),
        world_from_cam=prediction.world_from_cam.cpu(),
        intrinsics_px=prediction.intrinsics_px.cpu(),
        counts=counts,
        **{name: value.to("cpu") for name, value in parts.items() if value is not None},
    )


def _require_finite(prediction: Prediction, views: ViewSet, *, method: str, model: str) -> None:
    """Weights that left the range in which a network works show here first."""
    fix = "check the weights, or lower the learning rate of what changed them"
    for name in ("camera_vector", "world_from_cam", "intrinsics_px", "depth", "depth_conf", "normals", "normals_conf"):
        value: Tensor = getattr(prediction, name)
        broken = ~torch.isfinite(value).flatten(1).all(1)
        if bool(broken.any()):
            view = views.records[int(broken.nonzero()[0])].name
            raise UserError(f"{model} predicts a {name} that is not finite for {view}", where=method, fix=fix)
    gaussians = prediction.gaussians
    for name in ("means", "quat_wxyz", "scales", "opacities", "sh"):
        if not bool(torch.isfinite(getattr(gaussians, name)).all()):
            raise UserError(f"{model} predicts Gaussians whose {name} are not finite", where=method, fix=fix)
