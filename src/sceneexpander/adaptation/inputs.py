"""What a round adapts to, and the views of one step made from it."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.adaptation.augmentation import draw_warp, warp_priors
from sceneexpander.adaptation.config import AdaptConfig
from sceneexpander.adaptation.losses import ViewGeometry
from sceneexpander.adaptation.objective import Grid
from sceneexpander.adaptation.sampling import Batch
from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.artifacts.store import sha256_of_tensors, to_plain
from sceneexpander.errors import UserError
from sceneexpander.geometry.gauge import priors_relative_to
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.geometry.lookup import warp_maps
from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.randomness import child_generator
from sceneexpander.models.protocol import (
    GEOMETRY_HEADS,
    Head,
    Prediction,
    PreparesInputs,
    Reconstructor,
    as_module,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptationInputs:
    """What a round adapts to: n captured views, one inserted view, and the frozen model's anchors on the captured ones.

    ``captured_priors`` describe the captured views alone, ``joint_priors`` the captured views followed by the inserted one; a
    step that does not see the inserted view uses the former, so that with p = 0 nothing of the inserted view reaches the student.
    `adapt` brings the latter to the former's frame and scale, in which the anchors are.
    Models without priors get None for both.

    ``support`` is 1 where nothing contradicts the inserted picture and 0 where the scene so far shows something else (of
    `sceneexpander.artifacts.inserted.InsertedView`); None: not known. Only `InsertedWeights.SUPPORTED` looks at it.
    """

    captured: Float[Tensor, "captured 3 height width"]
    inserted: Float[Tensor, "3 height width"]
    anchors: Anchors
    captured_priors: Priors | None
    joint_priors: Priors | None
    support: Float[Tensor, "height width"] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class StepViews:
    """The views of one step, ready for student and teacher alike."""

    images: Float[Tensor, "view 3 height width"]
    priors: Priors | None
    prepared: Any  # of models that prepare their inputs (`PreparesInputs`), else None
    grids: list[Grid | None]  # warps of the captured views

    def predict(self, model: Reconstructor, heads: frozenset[Head] = GEOMETRY_HEADS) -> Prediction:
        """The model's prediction for these views."""
        if self.prepared is not None and isinstance(model, PreparesInputs):
            return model.predict_prepared(self.prepared, heads=heads)
        return model.predict(self.images, self.priors, heads=heads)


class ViewSource:
    """Makes the views of every step; what does not depend on the step is done once."""

    def __init__(self, model: Reconstructor, inputs: AdaptationInputs, config: AdaptConfig, *, seed: int) -> None:
        self.model, self.inputs, self.config, self.seed = model, inputs, config, seed
        self._measured: dict[bool, Any] = {}  # by whether the inserted view is among them

    def views(self, batch: Batch, step: int) -> StepViews:
        """The views of a batch: captured ones augmented, the inserted one as it is."""
        height, width = self.inputs.captured.shape[-2:]
        grids = [
            draw_warp(self.config.augment, height, width, child_generator(self.seed, f"adapt/augment/{step}/{index}"))
            for index in batch.captured
        ]
        return self._with_priors(batch, grids)

    def plain_views(self, batch: Batch) -> StepViews:
        """The same views without augmentation."""
        return self._with_priors(batch, [None] * len(batch.captured))

    def _with_priors(self, batch: Batch, grids: list[Grid | None]) -> StepViews:
        """The batch's views; a captured one with a grid is warped, and what is known of its pixels with it."""
        count = self.inputs.captured.shape[0]
        chosen = list(batch.captured)
        stacked = self.inputs.captured[chosen]
        if batch.inserted:
            stacked = torch.cat([stacked, self.inputs.inserted[None]])
            chosen = [*chosen, count]
        source = self.inputs.joint_priors if batch.inserted else self.inputs.captured_priors
        if isinstance(self.model, PreparesInputs):
            if batch.inserted not in self._measured:
                views = count + batch.inserted
                self._measured[batch.inserted] = self.model.measure(source, views, *stacked.shape[-2:])
            prepared = self.model.prepare(stacked, self._measured[batch.inserted].select(chosen), grids)
            return StepViews(images=_warped(stacked, grids), priors=None, prepared=prepared, grids=grids)
        priors = None if source is None else warp_priors(source.select(chosen), grids)
        if priors is not None and chosen[0] != 0:
            priors = priors_relative_to(priors, 0)
        return StepViews(images=_warped(stacked, grids), priors=priors, prepared=None, grids=grids)


def _warped(images: Float[Tensor, "view 3 height width"], grids: list[Grid | None]) -> Tensor:
    """The pictures, the first of them warped where there is a grid."""
    images = images.clone()
    for view, grid in enumerate(grids):
        if grid is not None:
            images[view] = warp_maps(images[view], grid)
    return images


def geometry_of(prediction: Prediction) -> ViewGeometry:
    """The part of a prediction that the losses read."""
    if prediction.depth is None or prediction.normals is None:
        raise ValueError("the adaptation needs the depth and normal heads")
    return ViewGeometry(
        camera_vector=prediction.camera_vector,
        depth=prediction.depth,
        normals=prediction.normals,
        splats=None if prediction.gaussians is None else _splats_of(prediction.gaussians, prediction.depth),
    )


def _splats_of(gaussians: Gaussians, depth: Float[Tensor, "view height width"]) -> Float[Tensor, "view height width 4"]:
    """Opacities and log scales by pixel. Raises `UserError` for models that make another number of Gaussians."""
    if len(gaussians) != depth.numel():
        raise UserError(
            "needs a model with one Gaussian per pixel", where="adapt.alpha_gaussian", fix="use 0 with this one"
        )
    return torch.cat([gaussians.opacities[:, None], gaussians.scales.log()], dim=1).view(*depth.shape, 4)


def heads_of(config: AdaptConfig) -> frozenset[Head]:
    """What the losses read."""
    return GEOMETRY_HEADS | {Head.GAUSSIANS} if config.alpha_gaussian > 0 else GEOMETRY_HEADS


def run_key(model: Reconstructor, inputs: AdaptationInputs, config: AdaptConfig, seed: int) -> str:
    """Hash of everything that determines an adaptation: weights, views, anchors, priors, configuration, seed."""
    tensors: dict[str, Tensor] = {f"weights/{k}": v for k, v in as_module(model).state_dict().items()}
    tensors |= {"captured": inputs.captured, "inserted": inputs.inserted}
    if inputs.support is not None:
        tensors["support"] = inputs.support
    for label, value in (
        ("anchors", inputs.anchors),
        ("captured", inputs.captured_priors),
        ("joint", inputs.joint_priors),
    ):
        if value is not None:
            plain = {f.name: getattr(value, f.name) for f in value.__dataclass_fields__.values()}
            tensors |= {f"{label}/{k}": v for k, v in plain.items() if isinstance(v, Tensor)}
    settings = json.dumps({"config": to_plain(config), "seed": seed, "model": model.name}, sort_keys=True)
    return hashlib.sha256(f"{sha256_of_tensors(tensors)}:{settings}".encode()).hexdigest()
